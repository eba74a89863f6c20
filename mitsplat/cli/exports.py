"""Command that exports assets and frames of scenes to other programs.

The command imports its dependencies inside its function, so that all other commands start fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from mitsplat.cli.options import AllowOutside, FrameIndex, check_new
from mitsplat.errors import InputError


def export(
    source: Annotated[Path, typer.Argument(metavar="ASSET|SCENE", help="Asset folder or scene file (.yaml).")],
    frame: FrameIndex = 0,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Mitsuba scene (.xml), OpenUSD stage (.usd, .usda, .usdc, .usdz), MJCF, or the splats of ASSET as "
            "glTF (.glb).",
        ),
    ] = Path("scene.xml"),
    mjcf: Annotated[
        bool, typer.Option("--mjcf", help="Write the .xml file as an MJCF model for MuJoCo instead of a Mitsuba scene.")
    ] = False,
    spz: Annotated[
        bool, typer.Option("--spz", help="Compress the splats of a .glb file, which quantises them.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file, including manual changes.")
    ] = False,
    allow_outside: AllowOutside = False,
) -> None:
    """Export one frame of SCENE, or ASSET, to other programs.

    A Mitsuba scene can be edited and rendered with `mitsplat render`. A USD stage has splats, colliders, masses,
    friction, poses at rest, camera, lights and semantic labels. An MJCF model has the bodies and shapes for MuJoCo.
    A glTF file has the splats of ASSET alone. Whatever a format cannot hold is listed.
    """
    from mitsplat.usd.usd_layers import USD_SUFFIXES

    check_new(out, ".xml", *(() if mjcf else (*USD_SUFFIXES, ".glb")), overwrite=overwrite)
    to_gltf = out.suffix.lower() == ".glb"
    if spz and not to_gltf:
        raise InputError(f"--spz applies to .glb files (got {out})")
    if to_gltf and not source.is_dir():
        raise InputError(f"a .glb file holds the splats of an asset folder (got {source}): export a USD stage")
    files = out.with_name(f"{out.stem}_files")
    if files.exists() and not overwrite and not (files.is_dir() and not any(files.iterdir())):
        raise InputError(f"--out {out}: the folder {files} must not exist yet; --overwrite replaces its files")
    if source.is_dir():
        losses = _export_asset(source, out, mjcf=mjcf, spz=spz)
    else:
        losses = _export_scene(source, frame, out, mjcf=mjcf, allow_outside=allow_outside)
    for loss in losses:
        typer.echo(f"not exported: {loss}")
    typer.echo(f"{'asset' if source.is_dir() else 'scene'}: {out}")


def _export_asset(folder: Path, out: Path, *, mjcf: bool, spz: bool) -> Sequence[str]:
    """Export an asset, and return sentences on what the format cannot hold."""
    if out.suffix.lower() == ".xml" and not mjcf:
        raise InputError(f"--out of an asset must be a USD stage, .glb, or MJCF with --mjcf (got {out})")
    from mitsplat.asset import Asset

    asset = Asset.load(folder)
    if out.suffix.lower() == ".glb":
        from mitsplat.gltf_splats.splat_writing import export_asset_gltf

        return export_asset_gltf(asset, out, spz=spz)
    from mitsplat.usd.mjcf import export_asset_mjcf
    from mitsplat.usd.usd_export import export_asset_usd

    return (export_asset_mjcf if mjcf else export_asset_usd)(asset, out)


def _export_scene(path: Path, frame: int, out: Path, *, mjcf: bool, allow_outside: bool) -> Sequence[str]:
    """Export a frame of a scene, and return sentences on what the format cannot hold."""
    from mitsplat.scene.loading.scene_loading import load_scene

    scene = load_scene(path, allow_outside=allow_outside)
    if out.suffix.lower() == ".xml" and not mjcf:
        from mitsplat.frames.mitsuba_xml import export_xml

        export_xml(scene, frame, out)
        return () if scene.spec.background is None else ("the background image",)
    from mitsplat.usd.mjcf import export_scene_mjcf
    from mitsplat.usd.usd_export import export_scene_usd

    return (export_scene_mjcf if mjcf else export_scene_usd)(scene, frame, out)
