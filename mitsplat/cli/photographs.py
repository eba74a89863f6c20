"""Commands that make assets of photographs, in one or stage by stage.

Commands import what they need inside of their functions, so that the start of every other one stays short.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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
    check_new,
    progress_bar,
    stage_bar,
    take_device,
)
from mitsplat.errors import InputError, PartialResultError

if TYPE_CHECKING:
    from mitsplat.capture.boards.targets import Board
    from mitsplat.capture.capture_photos import CaptureSettings
    from mitsplat.reconstruct.asset_from_photos import AssetResult

CaptureFolder = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder, with masks for an object.")]
Photos = Annotated[
    Path, typer.Argument(metavar="PHOTOS", help="Folder of photographs of one object or place, or a video of it.")
]
Frames = Annotated[int, typer.Option(help="Most frames that are taken of a video.")]
Poses = Annotated[
    Path | None, typer.Option(help="Folder of a COLMAP model, or NeRF's transforms.json, to take cameras from.")
]
Masks = Annotated[Path | None, typer.Option(help="Folder of masks, PHOTO.png, white = object.")]
MaskModel = Annotated[Path | None, typer.Option(help="Segmentation network (.onnx) that makes the masks, by rembg.")]
ScaleFrom = Annotated[
    tuple[str, str, float] | None,
    typer.Option(
        metavar="A B METRES", help="Distance of two places: PHOTO is its camera, PHOTO:X,Y what it sees at a pixel."
    ),
]
Picks = Annotated[
    list[str] | None,
    typer.Option("--pick", metavar="PHOTO:X,Y", help="Pixel on the object, in CAPTURE/images; may be repeated."),
]
PicksNot = Annotated[
    list[str] | None, typer.Option("--pick-not", metavar="PHOTO:X,Y", help="Pixel on a thing that it is not.")
]
Remove = Annotated[
    list[str] | None,
    typer.Option(
        "--remove",
        metavar="PHOTO:X,Y",
        help="Take the thing at this pixel, in CAPTURE/images, out of an environment; may be repeated.",
    ),
]
Delight = Annotated[
    Path | None,
    typer.Option(
        metavar="LIGHTS",
        help="File of the lights that the object was photographed in, which its colours are freed of.",
    ),
]
Box = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Box that holds the object, in the capture's frame."),
]
Size = Annotated[
    float | None, typer.Option(help="Longest edge of the smallest upright box around it [m], without other scale.")
]
Gaussians = Annotated[int, typer.Option(help="Most Gaussians.")]
Iterations = Annotated[int, typer.Option(help="Steps of the fit, one photo each.")]
Budget = Annotated[
    str | None, typer.Option(metavar="TIME", help="Shorten the fit to this time, such as 90s, 10min or 1h.")
]
Edge = Annotated[int, typer.Option(help="Longest edge of the photos in the fit, around an object [px].")]
Voxels = Annotated[int, typer.Option(help="Cells of the mesh's grid along the longest extent.")]
Refine = Annotated[
    bool, typer.Option("--refine", help="Refine the mesh by the masks, where photos set aside say that it helps.")
]


def fit(
    capture: CaptureFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")],
    gaussians: Gaussians = 30000,
    densification: Annotated[
        Literal["mcmc", "classic"],
        typer.Option(help="Add Gaussians where others are opaque, or where the photos pull at them."),
    ] = "mcmc",
    iterations: Iterations = 3000,
    budget: Budget = None,
    target_psnr: Annotated[
        float | None, typer.Option(help="End early at this PSNR [dB] of photos that are set aside for it.")
    ] = None,
    edge: Edge = 800,
    sh_degree: ShDegree = 3,
    masks: Annotated[
        Literal["alpha", "ignore", "off"],
        typer.Option(help="Fit only what masks show, ignore what they leave out, or do not read them."),
    ] = "alpha",
    background: Annotated[Literal["random", "black"], typer.Option(help="Colour behind the splats.")] = "random",
    depth: Annotated[float, typer.Option(help="Weight of the depths of the capture's points, or of depth maps.")] = 0.5,
    depths: Annotated[
        Path | None, typer.Option(help="Folder of depth maps, PHOTO.png (16-bit), .npy, .exr or .tiff.")
    ] = None,
    depth_kind: Annotated[
        Literal["inverse", "metric"],
        typer.Option(help="Whether these are of inverse depth, as of a network, or of depth, 0 where unknown."),
    ] = "inverse",
    depth_model: Annotated[
        Path | None, typer.Option(help="Network (.onnx, such as Depth Anything v2) that makes the depth maps.")
    ] = None,
    exposure: Annotated[
        bool, typer.Option("--exposure/--no-exposure", help="Give each photo a colour correction of its own.")
    ] = False,
    device: DeviceName = "cpu",
    seed: Seed = 0,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite/--resume", help="Replace what the folder holds of another fit, or refuse to."),
    ] = False,
) -> None:
    """Fit Gaussians to the photos of CAPTURE.

    Every eighth photo is held out to check the result. Runs again where it stopped.
    """
    from mitsplat.capture.capture import Capture
    from mitsplat.fit.depth_network import model_maps
    from mitsplat.fit.depth_priors import find_maps
    from mitsplat.fit.trainer import FitProgress, FitSettings, fit_capture

    if depths is not None and depth_model is not None:
        raise InputError("depth maps come from a folder or from a network: give --depths or --depth-model")
    mapped = depths is not None or depth_model is not None
    if depth_kind != "inverse" and not mapped:
        raise InputError(f"--depth-kind {depth_kind} is of depth maps: give --depths or --depth-model")
    if depth == 0 and mapped:
        raise InputError("depth maps are of no use with --depth 0: leave them out, or give them weight")
    settings = FitSettings(
        gaussians=gaussians,
        densification=densification,
        iterations=iterations,
        budget=None if budget is None else _seconds(budget),
        target_psnr=target_psnr,
        size=edge,
        sh_degree=sh_degree,
        masks=masks,
        background=background,
        depth_weight=depth,
        exposure=exposure,
        seed=seed,
    )
    loaded = Capture.load(capture)
    take_device(device)
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
    for warning in result.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(
        f"splats: {out / 'splats.ply'} ({len(result.splats)} Gaussians; {len(result.held_out)} held-out photos: "
        f"{result.psnr:.2f} dB, SSIM {result.ssim:.3f})"
    )
    reached = result.validation_psnr
    if target_psnr is not None and reached is not None:
        typer.echo(f"target: {reached:.2f} dB on {len(result.validation)} photos set aside for it")
        if reached < target_psnr:
            raise PartialResultError(
                f"{out}: PSNR must reach {target_psnr:.2f} dB (got {reached:.2f}); more iterations or Gaussians, or "
                "more photos with overlap and even light, would help"
            )


def capture(
    photos: Photos,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the capture to write.")],
    kind: Annotated[
        Literal["object", "environment"], typer.Option(help="Whether the subject is cut out by masks.")
    ] = "object",
    frames: Frames = 150,
    max_size: Annotated[int, typer.Option(help="Longest edge at which photos are used [px].")] = 1600,
    squares: Annotated[str, typer.Option(metavar="CxR", help="Squares of the ChArUco board to look for.")] = "7x5",
    square: Annotated[float, typer.Option(help="Edge of its squares as measured on the print [m].")] = 0.035,
    tag: Annotated[float | None, typer.Option(help="Edge of AprilTags (36h11) as printed, black border [m].")] = None,
    scale_from: ScaleFrom = None,
    poses: Poses = None,
    metric: Annotated[bool, typer.Option("--metric", help="The given poses are in metres with z up.")] = False,
    masks: Masks = None,
    mask_model: MaskModel = None,
    pick: Picks = None,
    pick_not: PicksNot = None,
    box: Box = None,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Resample the photos to cameras without lens distortion.")
    ] = False,
) -> None:
    """Find cameras, scale, gravity and masks of PHOTOS.

    Runs again where it stopped. If too many photos are of no use, the exit status is 4.
    """
    from mitsplat.capture.capture_photos import capture_photos

    settings = replace(
        _capture_settings(kind, frames, scale_from, poses, masks, mask_model, pick, pick_not, box),
        max_size=max_size,
        board=_board(squares, square),
        tag=tag,
        metric=metric,
        undistorted=undistort,
    )
    with stage_bar("steps/s") as progress:
        result = capture_photos(photos, out, settings, progress=progress)
    found, video = result.capture, result.video
    if video is not None:
        typer.echo(f"video: {len(video.names)} of {video.read} frames ({video.seconds:.1f} s) in {video.folder}")
    for name, reason in sorted(found.rejected.items()):
        typer.echo(f"rejected: {name}: {reason}")
    for warning in result.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(
        f"capture: {out} ({len(found.photos)} of {result.given} photos, {len(found.points)} points, "
        f"{result.reprojection_error:.2f} px)"
    )
    scale = "in metres" if found.units == "metre" else "in unknown units"
    error = "" if found.scale_error is None else f" ± {found.scale_error:.2%}"
    typer.echo(f"frame: {scale}{error}, {'z up' if found.up == 'z' else 'up unknown'}, by {result.source}")
    if result.exposure is not None:
        typer.echo(f"exposure: {result.exposure}")
    typer.echo(f"picture: {out / 'capture.png'}")
    if result.shortcoming is not None:
        raise PartialResultError(f"{out}: {result.shortcoming}")


def board(
    out: Annotated[Path, typer.Option("--out", "-o", help="Sheet to write (.pdf).")] = Path("board.pdf"),
    paper: Annotated[Literal["a4", "letter", "a3"], typer.Option(help="Paper, in landscape.")] = "a4",
    squares: Annotated[str, typer.Option(metavar="CxR", help="Squares across and down.")] = "7x5",
    square: Annotated[float, typer.Option(help="Edge of a square [m].")] = 0.035,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file.")] = False,
) -> None:
    """Write a ChArUco board to print.

    In photographs of what stands on or beside it, it gives `mitsplat capture` metres and the vertical.
    """
    check_new(out, ".pdf", overwrite=overwrite)
    _board(squares, square).write_pdf(out, paper)
    typer.echo(f"board: {out} (print at 100 %, then measure a square and give it to `mitsplat capture --square`)")


def mesh(
    capture: CaptureFolder,
    splats: Annotated[Path, typer.Argument(metavar="SPLATS", help="Folder of a fit, or a splat file in its frame.")],
    out: AssetFolder,
    name: Name = None,
    class_name: ClassName = None,
    kind: Kind = "object",
    faces: Faces = 10000,
    voxels: Voxels = 192,
    dissent: Annotated[int, typer.Option(help="Masks that may leave a point out and be overruled, 0 to 3.")] = 2,
    size: Size = None,
    take: Annotated[
        Path | None, typer.Option("--import", metavar="MESH", help="Take this mesh instead; it is registered.")
    ] = None,
    normalisation: Annotated[
        Path | None,
        typer.Option(help="Matrix (3x4 or 4x4, text) that its tool applied to the cameras: its inverse places it."),
    ] = None,
    units: Annotated[float | None, typer.Option(help="Metres per unit of the imported mesh.")] = None,
    refine: Refine = False,
    remove: Remove = None,
    delight: Delight = None,
    device: DeviceName = "cpu",
) -> None:
    """Make an asset of SPLATS that were fitted to CAPTURE.

    The object is isolated by its masks, its surface found, and both are judged by held-out photos in report.html. An
    environment is kept whole, and level surfaces in it are found. If a threshold is missed, the exit status is 4.
    """
    from mitsplat.asset import read_mesh
    from mitsplat.reconstruct.asset_from_photos import AssetJob, make_asset
    from mitsplat.reconstruct.reconstruct import ImportedMesh, ReconstructSettings
    from mitsplat.reconstruct.registration import invert_transform
    from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings
    from mitsplat.reconstruct.surface import SurfaceSettings
    from mitsplat.surroundings import make_surroundings

    if take is None and (normalisation is not None or units is not None):
        raise InputError("--normalisation and --units say where an imported mesh belongs: give --import as well")
    imported = None
    if take is not None:
        matrix = None if normalisation is None else invert_transform(normalisation)
        imported = ImportedMesh(read_mesh(take), matrix, units)
    surface = SurfaceSettings(voxels=voxels, faces=faces, dissent=dissent)
    job = AssetJob(
        name=name or out.resolve().name,
        class_name=class_name,
        kind=kind,
        settings=ReconstructSettings(surface=surface, size=size, refine=MeshRefineSettings() if refine else None),
        imported=imported,
        remove=tuple(remove or ()),
        delight=delight,
    )
    take_device(device)
    with stage_bar("steps/s") as progress:
        make = make_asset if kind == "object" else make_surroundings
        done = make(capture, splats, out, job, progress=progress)
    _tell_asset(done)


def asset(
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
    gaussians: Annotated[
        int | None, typer.Option(help="Most Gaussians; 30000 of an object, 60000 of surroundings if absent.")
    ] = None,
    iterations: Iterations = 3000,
    budget: Budget = None,
    edge: Edge = 800,
    faces: Faces = 10000,
    voxels: Voxels = 192,
    refine: Refine = False,
    remove: Remove = None,
    delight: Delight = None,
    device: DeviceName = "cpu",
    seed: Seed = 0,
) -> None:
    """Make an asset of PHOTOS.

    Cameras, splats, isolation, mesh and verdict: `capture`, `fit` and `mesh` in one. Runs again where it stopped;
    report.html shows what came of it. Of an environment, level surfaces are found, and a scene file beside its folder
    drops things on the one that photos look at. If a threshold is missed, the exit status is 4.
    """
    from mitsplat.fit.trainer import FitSettings
    from mitsplat.reconstruct.asset_from_photos import AssetJob, make_photo_asset
    from mitsplat.reconstruct.reconstruct import ReconstructSettings
    from mitsplat.reconstruct.silhouette_refinement import MeshRefineSettings
    from mitsplat.reconstruct.surface import SurfaceSettings
    from mitsplat.surroundings import make_photo_surroundings

    whole = kind == "environment"
    make = make_photo_surroundings if whole else make_photo_asset
    job = AssetJob(
        name=name or out.resolve().name,
        class_name=class_name,
        kind=kind,
        settings=ReconstructSettings(
            surface=SurfaceSettings(voxels=voxels, faces=faces),
            size=size,
            refine=MeshRefineSettings(seed=seed) if refine else None,
        ),
        remove=tuple(remove or ()),
        delight=delight,
    )
    take_device(device)
    with stage_bar("steps/s") as progress:
        done = make(
            photos,
            out,
            job,
            capture=_capture_settings(kind, frames, scale_from, poses, masks, mask_model, pick, pick_not, box),
            fit=FitSettings(
                gaussians=gaussians if gaussians is not None else 60_000 if whole else 30_000,
                iterations=iterations,
                budget=None if budget is None else _seconds(budget),
                masks="off" if whole else "alpha",
                size=edge,
                seed=seed,
            ),
            progress=progress,
        )
    _tell_asset(done)


def _capture_settings(
    kind: Kind,
    frames: Frames,
    scale_from: ScaleFrom,
    poses: Poses,
    masks: Masks,
    mask_model: MaskModel,
    pick: Picks,
    pick_not: PicksNot,
    box: Box,
) -> CaptureSettings:
    """What `capture` and `asset` both are told of photographs."""
    from mitsplat.capture.capture_photos import CaptureSettings

    return CaptureSettings(
        kind=kind,
        frames=frames,
        scale_from=scale_from,
        poses=poses,
        masks=masks,
        mask_model=mask_model,
        picks=tuple(pick or ()),
        picks_not=tuple(pick_not or ()),
        box=box,
    )


def _board(squares: str, square: float) -> Board:
    from mitsplat.capture.boards.targets import Board

    columns, _, rows = squares.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise InputError(f"--squares must be COLUMNSxROWS, such as 7x5 (got {squares})")
    return Board(int(columns), int(rows), square)


def _tell_asset(done: AssetResult) -> None:
    """What came of an asset, and status 4 where a threshold is missed."""
    found, kept = done.verdict, " (kept: nothing it is made of has changed)" if done.kept else ""
    closed = "watertight" if found.watertight else "open"
    typer.echo(f"asset: {done.folder}{kept}")
    for warning in done.warnings:
        typer.echo(f"warning: {warning}")
    typer.echo(f"photos: {found.photos} of {found.photos + found.rejected} with a camera; units: {found.units}")
    typer.echo(f"splats: {found.gaussians}; mesh: {found.faces} faces, {closed}")
    for what, text in found.rows.items():
        typer.echo(f"{what[0].lower()}{what[1:]}: {text}")
    if found.refinement is not None:
        typer.echo(f"refinement: {found.refinement}")
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


def _seconds(text: str) -> float:
    """Time [s] such as 90s, 10min or 1h."""
    for suffix, factor in (("min", 60.0), ("h", 3600.0), ("s", 1.0)):
        if text.endswith(suffix):
            with suppress(ValueError):
                return float(text.removesuffix(suffix)) * factor
    raise InputError(f"--budget must be a time such as 90s, 10min or 1h (got {text})")
