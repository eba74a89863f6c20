"""Commands that make assets of meshes and of splats that were made elsewhere.

Commands import what they need inside of their functions, so that the start of every other one stays short.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from mitsplat.cli.options import (
    AssetFolder,
    ClassName,
    DeviceName,
    Faces,
    Kind,
    Name,
    Seed,
    ShDegree,
    stage_bar,
    take_device,
)
from mitsplat.errors import InputError

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace the asset that is in the folder, with what was changed in it.")
]


def bake(
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="Textured or coloured mesh that trimesh reads.")],
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    light: Annotated[Literal["uniform", "studio"], typer.Option(help="Light to bake under.")] = "uniform",
    gaussians: Annotated[int, typer.Option(help="Number of Gaussians aimed for.")] = 20000,
    sh_degree: ShDegree = 2,
    units: Annotated[float, typer.Option(help="Metres per unit of the mesh; 0.001 for millimetres.")] = 1.0,
    up: Annotated[Literal["y", "z"], typer.Option(help="Axis of the mesh that points up.")] = "z",
    density: Annotated[float, typer.Option(help="Mass density [kg/m^3].")] = 1000.0,
    friction: Annotated[float, typer.Option(help="Coulomb friction coefficient.")] = 0.5,
    colour: Annotated[
        str | None, typer.Option(help="Name or #rrggbb, instead of all colours and textures of the file.")
    ] = None,
    roughness: Annotated[
        float | None, typer.Option(help="0 (a mirror) to 1, instead of the file's; makes what is matt glossy.")
    ] = None,
    metallic: Annotated[float | None, typer.Option(help="0 to 1 (metal), instead of the file's.")] = None,
    specular: Annotated[
        float | None, typer.Option(help="Reflectance of what is no metal, 0 (matt) to 0.08, instead of the file's.")
    ] = None,
    any_size: Annotated[
        bool, typer.Option("--any-size", help="Bake an object of less than 1 mm or more than 5 m as well.")
    ] = False,
    overwrite: Overwrite = False,
    device: DeviceName = "cpu",
    seed: Seed = 0,
) -> None:
    """Turn MESH into an asset.

    It has Gaussians with baked radiance, a proxy mesh and convex pieces; report.html shows the mesh beside the splats.
    """
    from mitsplat.bake.bake import BakeSettings, bake_asset
    from mitsplat.bake.bake_report import write_bake_report
    from mitsplat.bake.surface_materials import SurfaceFinish

    _check_folder(out, mesh, name, overwrite=overwrite)
    if not 0 < units < math.inf:
        raise InputError(f"--units must be finite and > 0 (got {units})")
    if not 0 <= seed < 2**32:
        raise InputError(f"--seed must be 0 to {2**32 - 1} (got {seed})")
    settings = BakeSettings(gaussians=gaussians, sh_degree=sh_degree, seed=seed)
    finish = SurfaceFinish(colour=colour, roughness=roughness, metallic=metallic, specular=specular)
    take_device(device)
    with stage_bar() as progress:
        result = bake_asset(
            mesh,
            name=name or out.resolve().name,
            class_name=class_name,
            kind=kind,
            light=light,
            settings=settings,
            metres_per_unit=units,
            up=up,
            density=density,
            friction=friction,
            finish=finish,
            any_size=any_size,
            progress=progress,
        )
    result.asset.save(out)
    report = write_bake_report(out, result)
    for warning in result.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(f"report: {report}")
    typer.echo(f"asset: {out} ({len(result.asset.splats)} Gaussians, {result.psnr:.1f} dB on unseen views)")


def import_(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Splats (.ply, .compressed.ply, .splat, .ksplat, .spz or .sog).")
    ],
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    up: Annotated[
        Literal["auto", "x", "-x", "y", "-y", "z", "-z"], typer.Option(help="Axis of the file that points up.")
    ] = "auto",
    size: Annotated[float | None, typer.Option(help="Longest extent of what is kept [m].")] = None,
    units: Annotated[float | None, typer.Option(help="Metres per unit of the file, instead.")] = None,
    crop: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Keep the inside of this box, in the file's units and axes."),
    ] = None,
    without_table: Annotated[
        bool, typer.Option("--without-table", help="Remove the flat surface that the object stands on.")
    ] = False,
    flat_base: Annotated[
        bool, typer.Option("--flat-base", help="Cut off what hangs below the base, until the object stands.")
    ] = False,
    mass: Annotated[float | None, typer.Option(help="Mass [kg], instead of density.")] = None,
    density: Annotated[float | None, typer.Option(help="Mass density [kg/m^3]; 1000 if absent.")] = None,
    friction: Annotated[float, typer.Option(help="Coulomb friction coefficient.")] = 0.5,
    light: Annotated[
        Literal["uniform", "scene"] | None,
        typer.Option(help="Whether scenes light it anew, as objects by default, or only shadow it, as environments."),
    ] = None,
    faces: Faces = 10000,
    voxels: Annotated[int, typer.Option(help="Cells of the mesh's grid along the longest extent.")] = 192,
    scene: Annotated[
        Path | None, typer.Option(metavar="SCENE", help="Also write a scene file to begin with, that has it.")
    ] = None,
    overwrite: Overwrite = False,
    device: DeviceName = "cpu",
) -> None:
    """Make an asset of splats that were made elsewhere.

    What is invisible, too large or loose is removed, up is found, and an object gets a mesh and convex pieces;
    report.html shows it all. What is questionable is said; `check` says more.
    """
    from mitsplat.importing.import_report import check_scene_path, write_import_report, write_scene
    from mitsplat.importing.splat_import import ImportSettings, import_splats
    from mitsplat.reconstruct.surface import SurfaceSettings

    _check_folder(out, file, name, overwrite=overwrite)
    settings = ImportSettings(
        up=None if up == "auto" else up,
        units=units,
        size=size,
        crop=crop,
        without_table=without_table,
        flat_base=flat_base,
        surface=SurfaceSettings(voxels=voxels, faces=faces, blur=1.0),
    )
    if scene is not None:
        check_scene_path(scene, out, known=size is not None or units is not None)
    take_device(device)
    with stage_bar() as progress:
        result = import_splats(
            file,
            name=name or out.resolve().name,
            class_name=class_name,
            kind=kind,
            settings=settings,
            density=density,
            mass=mass,
            friction=friction,
            capture_light=light,
            progress=progress,
        )
    made = result.asset
    made.save(out)
    report = write_import_report(out, result)
    typer.echo(f"up: {result.upright.reason}")
    typer.echo(f"Gaussians: {result.removed_of_all}")
    if made.mesh is not None:
        extents = " x ".join(f"{extent:.4g}" for extent in made.mesh.extents)
        pieces = f", {len(made.pieces)} convex pieces" if made.pieces else ""
        typer.echo(
            f"extents: {extents} {'m' if made.units == 'metre' else 'units'}; {len(made.mesh.faces)} faces{pieces}"
        )
    for miss in result.misses:
        typer.echo(f"warning: {miss}")
    typer.echo(f"report: {report}")
    typer.echo(f"asset: {out}")
    if scene is not None:
        write_scene(scene, out, result)
        typer.echo(f"scene: {scene}")


def _check_folder(out: Path, source: Path, name: str | None, *, overwrite: bool) -> None:
    """Refuse, before work starts, a folder that cannot be made, or in which something would be lost."""
    for place in (out, *out.absolute().parents):
        if place.exists() and not place.is_dir():
            raise InputError(f"--out must be a folder (got {'' if place == out else f'{out} below '}the file {place})")
    if not (name or out.resolve().name):
        raise InputError(f"--out must be a folder with a name (got {out})")
    if source.resolve() in [(out / file).resolve() for file in _WRITTEN]:
        raise InputError(f"--out must not be a folder where {source} itself would be replaced (got {out})")
    if not overwrite and (there := [file for file in _WRITTEN if (out / file).exists()]):
        raise InputError(f"{out / there[0]}: is there already: choose another folder, or --overwrite replaces it")


_WRITTEN = ("asset.yaml", "splats.ply", "mesh.ply", "pieces.ply", "report.html")
"""Files of an asset's folder."""
