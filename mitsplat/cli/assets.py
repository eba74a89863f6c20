"""Commands that make assets from meshes and from splat files.

Each command imports its dependencies inside its function, so that all other commands start fast.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.console import select_device, stage_bar
from mitsplat.cli.options import (
    AssetFolder,
    ClassName,
    DeviceName,
    Faces,
    Kind,
    Metallic,
    Name,
    Roughness,
    Seed,
    given_options,
    refuse_options,
    uniform_material,
)
from mitsplat.errors import InputError

if TYPE_CHECKING:
    from mitsplat.bake.bake import BakeResult
    from mitsplat.importing.import_result import Imported
    from mitsplat.mesh_files.mesh_file import MeshFile

Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace an existing asset in the folder, including manual changes to its files."),
]


def bake(
    mesh: Annotated[
        Path,
        typer.Argument(
            metavar="MESH",
            help="STEP file, or mesh with its materials (.glb, .gltf, .3mf, .obj, .ply, .stl, .off or .dae).",
        ),
    ],
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    gaussians: Annotated[int, typer.Option(help="Target number of Gaussians.")] = 20000,
    units: Annotated[
        float | None,
        typer.Option(
            help="Metres per unit of the mesh, 0.001 for millimetres; by default stated by MESH (STEP, glTF, 3MF, DAE) "
            "or 1."
        ),
    ] = None,
    up: Annotated[
        Literal["y", "z"] | None,
        typer.Option(help="Axis of the mesh that points up; by default stated by MESH (glTF, 3MF, DAE) or z."),
    ] = None,
    density: Annotated[float, typer.Option(help="Mass density [kg/m^3].")] = 1000.0,
    friction: Annotated[float, typer.Option(help="Coulomb friction coefficient.")] = 0.5,
    colour: Annotated[
        str | None,
        typer.Option(help="Colour that replaces all colours and textures of the file: a CSS name or #rrggbb."),
    ] = None,
    roughness: Annotated[
        float | None,
        typer.Option(help="Roughness that replaces the file's values, 0 (mirror) to 1; makes matt parts glossy."),
    ] = None,
    metallic: Annotated[
        float | None, typer.Option(help="Metalness that replaces the file's values, 0 (dielectric) to 1 (metal).")
    ] = None,
    specular: Annotated[
        float | None,
        typer.Option(help="Reflectance of dielectric parts that replaces the file's values, 0 (matt) to 0.08."),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Maximum distance of facets from the surfaces of a STEP file [mm]; by default 1/2000 of the longest "
            "extent, which is half a pixel of a view that is 1000 pixels wide."
        ),
    ] = None,
    split: Annotated[
        bool, typer.Option("--split", help="Make one asset per part of a STEP file; equal parts are made once.")
    ] = False,
    any_size: Annotated[
        bool, typer.Option("--any-size", help="Also accept an object smaller than 1 mm or larger than 5 m.")
    ] = False,
    overwrite: Overwrite = False,
    device: DeviceName = "cpu",
    seed: Seed = 0,
) -> None:
    """Make an asset from MESH.

    The asset has Gaussians with the materials of MESH, a proxy mesh and convex collision pieces. The page report.html
    compares the mesh with the splats.
    """
    from mitsplat.bake.bake import BakeSettings, bake_asset
    from mitsplat.bake.bake_report import write_bake_report
    from mitsplat.bake.surface_materials import SurfaceFinish

    _check_folder(out, mesh, name, overwrite=overwrite)
    if units is not None and not 0 < units < math.inf:
        raise InputError(f"--units must be finite and > 0 (got {units})")
    if not 0 <= seed < 2**32:
        raise InputError(f"--seed must be 0 to {2**32 - 1} (got {seed})")
    if split and name is not None:
        raise InputError(f"--name applies to one asset, but --split names each by its part (got {name})")
    settings = BakeSettings(gaussians=gaussians, seed=seed)
    finish = SurfaceFinish(colour=colour, roughness=roughness, metallic=metallic, specular=specular)
    sources = _bake_sources(mesh, out, tolerance=tolerance, split=split)
    for folder in sources:
        _check_folder(folder, mesh, name, overwrite=overwrite)
    select_device(device)
    for folder, source in sources.items():
        with stage_bar() as progress:
            result = bake_asset(
                source,
                name=name or folder.resolve().name,
                class_name=class_name,
                kind=kind,
                settings=settings,
                metres_per_unit=units,
                up=up,
                density=density,
                friction=friction,
                finish=finish,
                any_size=any_size,
                progress=progress,
            )
        result.asset.save(folder)
        _print_bake(folder, result, write_bake_report(folder, result))


def _bake_sources(mesh: Path, out: Path, *, tolerance: float | None, split: bool) -> Mapping[Path, MeshFile | Path]:
    """Return the source of each asset by its folder: the mesh file, or the content of a STEP file or of its parts."""
    from mitsplat.mesh_files.step import STEP_SUFFIXES, read_step, separate_parts

    if mesh.suffix.lower() not in STEP_SUFFIXES:
        if tolerance is not None or split:
            raise InputError(f"--{'split' if split else 'tolerance'} applies to STEP files (got {mesh})")
        return {out: mesh}
    file = read_step(mesh, tolerance=tolerance, separate=split)
    typer.echo(f"facets: within {file.tolerance:.3g} mm of the surfaces")
    if not split:
        return {out: file}
    parts = separate_parts(file)
    for part, (_, count) in parts.items():
        typer.echo(f"part: {part} ({count} of {len(file.parts)} parts)")
    return {out / part: content for part, (content, _) in parts.items()}


def _print_bake(folder: Path, result: BakeResult, report: Path) -> None:
    """Print the properties of a baked asset and warnings."""
    from mitsplat.bake.size_checks import describe_size

    for warning in result.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(f"units of the mesh: {result.units}")
    if result.asset.mesh is not None:
        typer.echo(f"size: {describe_size(result.asset.mesh)}")
    typer.echo(f"report: {report}")
    typer.echo(f"asset: {folder} ({len(result.asset.splats)} Gaussians, {result.psnr:.1f} dB on unseen views)")


_FIXED_BY_COLLIDERS = frozenset(
    ("--up", "--size", "--units", "--crop", "--without-table", "--flat-base", "--scene", "--metallic", "--roughness")
)
"""Options of ``import`` without effect on a USD stage with colliders."""


def import_(
    context: typer.Context,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Splat file (.ply, .compressed.ply, .splat, .ksplat, .spz or .sog), glTF file with splats (.glb or "
            ".gltf), or OpenUSD stage (.usd, .usda, .usdc or .usdz).",
        ),
    ],
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    up: Annotated[
        Literal["auto", "x", "-x", "y", "-y", "z", "-z"],
        typer.Option(help="Axis of the file that points up; auto estimates it."),
    ] = "auto",
    size: Annotated[float | None, typer.Option(help="Longest extent of the asset [m]; sets the scale.")] = None,
    units: Annotated[float | None, typer.Option(help="Metres per unit of the file; alternative to --size.")] = None,
    crop: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="Crop box in the units and axes of the file; only Gaussians inside are used.",
        ),
    ] = None,
    without_table: Annotated[
        bool,
        typer.Option(
            "--without-table", help="Remove the flat surface that the object stands on, and everything below it."
        ),
    ] = False,
    flat_base: Annotated[
        bool, typer.Option("--flat-base", help="Cut off parts below the base, so that the object can stand.")
    ] = False,
    mass: Annotated[float | None, typer.Option(help="Mass [kg]; alternative to --density.")] = None,
    density: Annotated[float | None, typer.Option(help="Mass density [kg/m^3]; 1000 by default.")] = None,
    friction: Annotated[
        float | None, typer.Option(help="Coulomb friction coefficient; 0.5 if FILE states none.")
    ] = None,
    light: Annotated[
        Literal["uniform", "scene"] | None,
        typer.Option(
            help="Light in the captured colours. uniform: scenes relight the asset (default for objects); "
            "scene: scenes only add shadows (default for environments)."
        ),
    ] = None,
    metallic: Metallic = None,
    roughness: Roughness = None,
    faces: Faces = 10000,
    voxels: Annotated[int, typer.Option(help="Grid cells along the longest extent for the mesh reconstruction.")] = 192,
    scene: Annotated[
        Path | None, typer.Option(metavar="SCENE", help="Also write a starter scene file that contains the asset.")
    ] = None,
    overwrite: Overwrite = False,
    device: DeviceName = "cpu",
) -> None:
    """Make an asset from a splat file of another tool.

    Invisible, oversized and isolated Gaussians are removed, and the up axis is estimated. An object gets a mesh and
    convex collision pieces. The page report.html shows the result. Warnings are printed; `mitsplat check` runs more
    checks.

    USD and glTF files state their unit and up axis. If a USD stage also has colliders, the asset gets its splats
    unchanged, and its colliders, mass, friction and class. Everything else in the stage is listed.
    """
    from mitsplat.usd.usd_layers import is_usd

    _check_folder(out, file, name, overwrite=overwrite)
    stage = None
    if is_usd(file):
        from mitsplat.usd.stage_assets import read_stage_asset, with_values

        stage = read_stage_asset(file)
        if stage.asset is not None:
            ineffective = given_options(context) & _FIXED_BY_COLLIDERS
            refuse_options(ineffective, f"{file}, whose colliders state its geometry")
            asset = with_values(
                stage.asset, name, class_name, mass=mass, density=density, friction=friction, light=light
            )
            asset.save(out)
            typer.echo(f"Gaussians: {len(asset.splats)}; {len(asset.pieces)} convex pieces")
            typer.echo(f"asset: {out}")
            return
    from mitsplat.importing.import_report import check_scene_path, write_import_report, write_scene
    from mitsplat.importing.splat_import import ImportSettings, import_splats
    from mitsplat.reconstruct.surface import SurfaceSettings

    settings = ImportSettings(
        up=None if up == "auto" else up,
        units=units,
        size=size,
        crop=crop,
        without_table=without_table,
        flat_base=flat_base,
        surface=SurfaceSettings(voxels=voxels, faces=faces, blur=1.0),
        material=uniform_material(metallic, roughness),
    )
    if scene is not None:
        check_scene_path(scene, out, known=size is not None or units is not None)
    select_device(device)
    with stage_bar() as progress:
        result = import_splats(
            file,
            name=name or out.resolve().name,
            class_name=class_name,
            kind=kind,
            settings=settings,
            density=density,
            mass=mass,
            friction=0.5 if friction is None else friction,
            capture_light=light,
            stage=stage,
            progress=progress,
        )
    result.asset.save(out)
    _print_import(result)
    typer.echo(f"report: {write_import_report(out, result)}")
    typer.echo(f"asset: {out}")
    if scene is not None:
        write_scene(scene, out, result)
        typer.echo(f"scene: {scene}")


def _print_import(result: Imported) -> None:
    """Print the properties of an imported asset and warnings."""
    asset = result.asset
    typer.echo(f"up: {result.upright.reason}")
    typer.echo(f"Gaussians: {result.removed_of_all}")
    if result.training is not None:
        typer.echo(f"trained: {result.training}")
    if asset.mesh is not None:
        extents = " x ".join(f"{extent:.4g}" for extent in asset.mesh.extents)
        pieces = f", {len(asset.pieces)} convex pieces" if asset.pieces else ""
        unit = "m" if asset.units == "metre" else "units"
        typer.echo(f"extents: {extents} {unit}; {len(asset.mesh.faces)} faces{pieces}")
    for miss in result.misses:
        typer.echo(f"warning: {miss}")


def _check_folder(out: Path, source: Path, name: str | None, *, overwrite: bool) -> None:
    """Raise InputError if the asset folder cannot be created or if existing files would be lost."""
    for place in (out, *out.absolute().parents):
        if place.exists() and not place.is_dir():
            raise InputError(f"--out must be a folder (got {'' if place == out else f'{out} below '}the file {place})")
    if not (name or out.resolve().name):
        raise InputError(f"--out must be a folder with a name (got {out})")
    if source.resolve() in [(out / file).resolve() for file in _ASSET_FILES]:
        raise InputError(f"--out must not be the folder of the input {source}, which would be replaced (got {out})")
    if not overwrite and (there := [file for file in _ASSET_FILES if (out / file).exists()]):
        raise InputError(f"{out / there[0]}: already exists: choose another folder, or use --overwrite to replace it")


_ASSET_FILES = ("asset.yaml", "splats.ply", "materials.ply", "mesh.ply", "pieces.ply", "report.html")
"""Files of an asset folder."""
