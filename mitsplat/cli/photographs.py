"""Commands that make assets from photographs or captures, in one call or stage by stage.

Each command imports its dependencies inside its function, so that all other commands start fast.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.captures import (
    Box,
    Frames,
    MaskModel,
    Masks,
    Photos,
    Picks,
    PicksNot,
    Poses,
    ScaleFrom,
    parse_distance,
    refuse_frames,
)
from mitsplat.cli.console import progress_bar, select_device, stage_bar
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
    ShDegree,
    parse_number,
    uniform_material,
)
from mitsplat.errors import InputError, PartialResultError

if TYPE_CHECKING:
    from mitsplat.fit.fit_folder import FitResult
    from mitsplat.reconstruct.pipeline.asset_pipeline import AssetResult

CaptureFolder = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder; an object needs masks.")]
Remove = Annotated[
    list[str] | None,
    typer.Option(
        "--remove",
        metavar="PHOTO:X,Y",
        help="Remove the object at this pixel, in CAPTURE/images, from an environment; repeatable.",
    ),
]
Size = Annotated[
    float | None,
    typer.Option(
        help="Longest edge of the smallest upright box around the object [m]; only for captures without a scale."
    ),
]
Lights = Annotated[
    Path | None,
    typer.Option(
        help="Lights of the photos in the frame of the capture, a file that `mitsplat lights` wrote; the materials of "
        "the object are then estimated."
    ),
]
Budget = Annotated[
    str | None,
    typer.Option(
        metavar="TIME", help="Time limit of the fit, such as 90s, 10min or 1h; the schedule is shortened to it."
    ),
]


def fit(
    capture: CaptureFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="Fit folder to write.")],
    gaussians: Annotated[int, typer.Option(help="Maximum number of Gaussians.")] = 30000,
    iterations: Annotated[int, typer.Option(help="Number of optimiser steps; each uses one photo.")] = 3000,
    budget: Budget = None,
    target_psnr: Annotated[
        float | None,
        typer.Option(help="Stop early at this PSNR [dB] on validation photos, which are then excluded from training."),
    ] = None,
    max_size: Annotated[
        int, typer.Option(help="Longest edge of the training images [px]; objects are cropped first.")
    ] = 800,
    sh_degree: ShDegree = 3,
    depths: Annotated[
        Path | None, typer.Option(help="Folder of depth maps, PHOTO.png (16-bit), .npy, .exr or .tiff.")
    ] = None,
    depth_kind: Annotated[
        Literal["inverse", "metric"],
        typer.Option(
            help="Content of the depth maps: inverse depth (as networks predict), or metric depth with 0 where unknown."
        ),
    ] = "inverse",
    depth_model: Annotated[
        Path | None, typer.Option(help="Depth network that computes the depth maps (.onnx, such as Depth Anything v2).")
    ] = None,
    device: DeviceName = "cpu",
    seed: Seed = 0,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite/--resume", help="Replace an existing fit of other inputs, or stop with an error."),
    ] = False,
) -> None:
    """Fit Gaussians to the photos of CAPTURE.

    Every eighth photo is held out to evaluate the result. An interrupted fit continues when the command runs again.
    """
    from mitsplat.capture.capture import Capture
    from mitsplat.fit.depth_network import model_maps
    from mitsplat.fit.depth_priors import find_maps
    from mitsplat.fit.fit_settings import FitProgress, FitSettings
    from mitsplat.fit.trainer import fit_capture

    if depths is not None and depth_model is not None:
        raise InputError("--depths and --depth-model both define the depth maps: give only one")
    mapped = depths is not None or depth_model is not None
    if depth_kind != "inverse" and not mapped:
        raise InputError(f"--depth-kind {depth_kind} needs depth maps: add --depths or --depth-model")
    settings = FitSettings(
        gaussians=gaussians,
        iterations=iterations,
        budget=None if budget is None else _parse_duration(budget),
        target_psnr=target_psnr,
        max_size=max_size,
        sh_degree=sh_degree,
        seed=seed,
    )
    loaded = Capture.load(capture)
    select_device(device)
    maps = None if depths is None else find_maps(depths, loaded.training, depth_kind)
    if depth_model is not None:
        with progress_bar("photos/s") as show:
            maps = model_maps(loaded.training, depth_model, out / "depths", depth_kind, progress=show)
    with stage_bar("steps/s") as show:

        def progress(now: FitProgress) -> None:
            checked = "" if now.validation is None else f" ({now.validation:.1f} set aside)"
            show(
                int(now.fraction * iterations),
                iterations,
                f"fitting: {now.psnr:.1f} dB{checked}, {now.gaussians} Gaussians",
            )

        result = fit_capture(loaded, out, settings, depths=maps, overwrite=overwrite, progress=progress)
    _print_fit(out, result, target_psnr)


def _print_fit(out: Path, result: FitResult, target_psnr: float | None) -> None:
    """Print the result of a fit.

    Raises:
        PartialResultError: If the fit does not reach the target (exit status 4).
    """
    for warning in result.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(
        f"splats: {out / 'splats.ply'} ({len(result.splats)} Gaussians; {len(result.held_out)} held-out photos: "
        f"{result.psnr:.2f} dB, SSIM {result.ssim:.3f})"
    )
    reached = result.validation_psnr
    if target_psnr is not None and reached is not None:
        typer.echo(f"target: {reached:.2f} dB on {len(result.validation)} validation photos")
        if reached < target_psnr:
            raise PartialResultError(
                f"{out}: PSNR must reach {target_psnr:.2f} dB (got {reached:.2f}); use more iterations or "
                "Gaussians, or more photos with overlap and even light"
            )


def mesh(
    capture: CaptureFolder,
    splats: Annotated[
        Path, typer.Argument(metavar="SPLATS", help="Folder of a fit, or a splat file in the frame of the capture.")
    ],
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    faces: Faces = 10000,
    voxels: Annotated[int, typer.Option(help="Grid cells along the longest extent for the mesh reconstruction.")] = 192,
    size: Size = None,
    take: Annotated[
        Path | None,
        typer.Option(
            "--import",
            metavar="MESH",
            help="Use this mesh instead of a reconstructed one; it is registered to the splats, and its pose is "
            "refined with the masks.",
        ),
    ] = None,
    normalisation: Annotated[
        Path | None,
        typer.Option(
            help="Text file with the matrix (3x4 or 4x4) that the mesh tool applied to the cameras; its "
            "inverse places the mesh."
        ),
    ] = None,
    units: Annotated[float | None, typer.Option(help="Metres per unit of the imported mesh.")] = None,
    refine: Annotated[
        bool,
        typer.Option(
            "--refine",
            help="Refine the mesh with the masks; the result is used only if it improves on validation photos.",
        ),
    ] = False,
    remove: Remove = None,
    metallic: Metallic = None,
    roughness: Roughness = None,
    lights: Lights = None,
    device: DeviceName = "cpu",
) -> None:
    """Make an asset from SPLATS that were fitted to CAPTURE.

    An object is isolated by its masks and its surface is reconstructed. Held-out photos check both, and the page
    report.html shows the result. An environment is kept whole, and its level surfaces are detected. The exit status is
    4 if a quality threshold is missed.
    """
    from mitsplat.capture.capture import Capture
    from mitsplat.mesh_files.mesh_reading import read_mesh
    from mitsplat.reconstruct.materials.capture_light import CaptureLight
    from mitsplat.reconstruct.pipeline.asset_pipeline import make_asset
    from mitsplat.reconstruct.reconstruct import AssetJob, ImportedMesh, ReconstructSettings
    from mitsplat.reconstruct.registration import invert_transform
    from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings
    from mitsplat.reconstruct.surface import SurfaceSettings

    if take is None and (normalisation is not None or units is not None):
        raise InputError("--normalisation and --units apply to an imported mesh: add --import")
    imported = None
    if take is not None:
        matrix = None if normalisation is None else invert_transform(normalisation)
        imported = ImportedMesh(read_mesh(take), matrix, units)
    surface = SurfaceSettings(voxels=voxels, faces=faces)
    job = AssetJob(
        name=name or out.resolve().name,
        class_name=class_name,
        kind=kind,
        settings=ReconstructSettings(surface=surface, size=size, refine=MeshRefineSettings() if refine else None),
        imported=imported,
        remove=tuple(remove or ()),
        material=uniform_material(metallic, roughness),
        light=None if lights is None else CaptureLight.load(lights),
    )
    select_device(device)
    with stage_bar("steps/s") as progress:
        done = make_asset(Capture.load(capture), splats, out, job, progress=progress)
    _print_result(done)


def asset(
    context: typer.Context,
    photos: Photos,
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    frames: Frames = 150,
    size: Size = None,
    scale_from: ScaleFrom = None,
    poses: Poses = None,
    masks: Masks = None,
    mask_model: MaskModel = None,
    pick: Picks = None,
    pick_not: PicksNot = None,
    box: Box = None,
    budget: Budget = None,
    remove: Remove = None,
    metallic: Metallic = None,
    roughness: Roughness = None,
    lights: Lights = None,
    device: DeviceName = "cpu",
) -> None:
    """Make an asset from PHOTOS.

    The command runs the stages `capture`, `fit` and `mesh`, whose commands have further options. An interrupted run
    continues when the command runs again. The page report.html shows the result. The exit status is 4 if a quality
    threshold is missed.

    In an environment, level surfaces are detected. The command also writes a scene file beside the asset folder, which
    drops objects on the surface at which the photos are directed.
    """
    from mitsplat.capture.pipeline.capture_settings import CaptureSettings
    from mitsplat.reconstruct.materials.capture_light import CaptureLight
    from mitsplat.reconstruct.pipeline.asset_pipeline import asset_from_photos, default_fit
    from mitsplat.reconstruct.reconstruct import AssetJob, ReconstructSettings

    refuse_frames(context, photos)
    job = AssetJob(
        name=name or out.resolve().name,
        class_name=class_name,
        kind=kind,
        settings=ReconstructSettings(size=size),
        light=None if lights is None else CaptureLight.load(lights),
        remove=tuple(remove or ()),
        material=uniform_material(metallic, roughness),
    )
    capture = CaptureSettings(
        kind=kind,
        frames=frames,
        scale_from=parse_distance(scale_from),
        poses=poses,
        masks=masks,
        mask_model=mask_model,
        picks=tuple(pick or ()),
        picks_not=tuple(pick_not or ()),
        box=box,
    )
    fit = replace(default_fit(kind), budget=None if budget is None else _parse_duration(budget))
    select_device(device)
    with stage_bar("steps/s") as progress:
        done = asset_from_photos(photos, out, job, capture=capture, fit=fit, progress=progress)
    _print_result(done)


def _print_result(done: AssetResult) -> None:
    """Print the result of making an asset.

    Raises:
        PartialResultError: If the asset misses a threshold (exit status 4).
    """
    found, kept = done.verdict, " (reused: the inputs have not changed)" if done.kept else ""
    closed = "watertight" if found.watertight else "open"
    typer.echo(f"asset: {done.folder}{kept}")
    for warning in done.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(f"photos: {found.photos} of {found.photos + found.rejected} with a camera; units: {found.units}")
    typer.echo(f"splats: {found.gaussians}; mesh: {found.faces} faces, {closed}")
    for what, text in found.rows.items():
        typer.echo(f"{what[0].lower()}{what[1:]}: {text}")
    figures = {
        "held-out PSNR": None if found.psnr is None else f"{found.psnr:.2f} dB",
        "IoU with held-out masks": None
        if found.splat_iou is None
        else f"splats {found.splat_iou:.3f}, mesh {found.mesh_iou or 0:.3f}",
        "shift between mesh and splats": None if found.offset is None else f"{found.offset:.3%} of the diagonal",
    }
    typer.echo("; ".join(f"{name} {value}" for name, value in figures.items() if value is not None))
    typer.echo(f"report: {done.folder / 'report.html'}")
    if done.scene is not None:
        typer.echo(f"scene: {done.scene}")
    if done.shortcoming is not None:
        raise PartialResultError(f"{done.folder}: {done.shortcoming}")


def _parse_duration(text: str) -> float:
    """Return the time [s] of a text such as 90s, 10min or 1h."""
    for suffix, factor in (("min", 60.0), ("h", 3600.0), ("s", 1.0)):
        if text.endswith(suffix):
            with suppress(typer.BadParameter):
                return parse_number(text.removesuffix(suffix)) * factor
    raise InputError(f"--budget must be a time such as 90s, 10min or 1h (got {text})")
