"""The command ``mitsplat``: arguments to calls, and errors in one sentence instead of a traceback.

Exit status: 0 done, 1 the doctor or an audit found something wrong, 2 bad input, 3 something is missing on the machine,
4 a result was written that misses a threshold, 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mitsplat import __version__
from mitsplat.errors import InputError, MissingResourceError, PartialResultError

if TYPE_CHECKING:
    from mitsplat.board import Board
    from mitsplat.pipeline import Finished

# Commands import what they need themselves, so that help appears at once.

app = typer.Typer(
    help="Labelled training images of settled objects, from Gaussian splats, physics and traced light.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml).")]
FrameIndex = Annotated[int, typer.Option("--frame", help="Index of the frame, from 0.")]
DatasetFolder = Annotated[Path, typer.Argument(metavar="DATASET", help="Dataset folder.")]
QualityName = Literal["fast", "balanced", "exact"]


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    Args:
        args: Arguments; those of the process if None.
    """
    try:
        app(args)
    except InputError as error:
        _fail(str(error))
    except MissingResourceError as error:
        _fail(str(error), status=3)
    except PartialResultError as error:
        _fail(str(error), status=4)
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml), or a Mitsuba scene (.xml).")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Dataset folder (for .xml: picture); out/<name of SCENE> if absent."),
    ] = None,
    frames: Annotated[int | None, typer.Option("--frames", "-n", help="Only the first so many images.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size [px], such as 1280x720.")] = None,
    seed: Annotated[int | None, typer.Option(help="Decides everything that is random.")] = None,
    quality: Annotated[QualityName | None, typer.Option(help="Rendering preset.")] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Choose the cheapest preset within this error (RMSE of encoded colours), as `chart` does."),
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes that make images.")] = 1,
    formats: Annotated[
        str | None,
        typer.Option("--format", metavar="NAMES", help="Label formats as in output.formats, separated by commas."),
    ] = None,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite/--resume", help="Replace the dataset in the folder, or keep what is finished of it."),
    ] = False,
) -> None:
    """Write the labelled dataset that SCENE describes.

    Options replace what the file says. A Mitsuba scene (.xml) gives one picture.
    """
    overrides = _overrides(size=size, seed=seed, quality=quality, formats=formats)
    if out is None:
        out = Path("out") / scene.stem
    if scene.suffix == ".xml":
        if overrides or frames is not None or tolerance is not None:
            raise InputError(f"{scene}: a Mitsuba scene says size, seed and quality itself; only --out applies")
        from mitsplat.xml_scene import render_xml

        typer.echo(f"picture: {render_xml(scene, out)}")
        return
    from mitsplat.dataset import write_dataset
    from mitsplat.scene import load_scene

    loaded = load_scene(scene, overrides=overrides)
    if tolerance is not None:
        if quality is not None:
            raise InputError("--quality and --tolerance both choose the preset: give one of them")
        from mitsplat.chart import choose_preset

        with _progress_bar() as progress:
            best = choose_preset(scene, tolerance, overrides=overrides, note=progress)
        typer.echo(f"preset: {best.name} (RMSE {best.rmse:.2g}, {best.seconds:.2f} s an image)")
        loaded = load_scene(scene, overrides=overrides | {"quality": best.name})
    with _progress_bar() as progress:
        summary = write_dataset(loaded, out, frames=frames, workers=workers, overwrite=overwrite, progress=progress)
    images = ", ".join(f"{count} {split}" for split, count in summary.images.items())
    typer.echo(f"dataset: {summary.path} ({images}; {sum(summary.instances.values())} labelled instances)")
    typer.echo(f"not labelled: {_counts(summary.dropped)}; marked: {_counts(summary.marked)}")
    typer.echo(f"contact sheet: {summary.contact_sheet}")


@app.command()
def chart(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml), or a file of splats.")],
    frames: Annotated[int, typer.Option("--frames", "-n", help="Images to compare, spread over the scene's.")] = 3,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size [px], such as 640x360.")] = None,
    tolerance: Annotated[
        float, typer.Option(help="Mark the cheapest preset within this error (RMSE of encoded colours).")
    ] = 0.004,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Chart to write (.png); a .csv of the same name goes beside it.")
    ] = Path("chart.png"),
) -> None:
    """Chart speed against accuracy for SCENE.

    Every preset, and cheaper models of light, beside the preset exact. Times are those of this machine, now.
    """
    from rich.console import Console
    from rich.table import Table

    from mitsplat.chart import cheapest, draw_chart, measure_steps, write_csv

    if out.suffix.lower() != ".png" or not out.parent.is_dir():
        raise InputError(f"--out must end in .png, in a folder that exists (got {out})")
    with _progress_bar() as progress:
        rows = measure_steps(scene, frames=frames, overrides=_overrides(size=size), note=progress)
    best = cheapest(rows, tolerance)
    table = Table("step", "s/image", "RMSE", "PSNR [dB]", "largest", "SSIM", "mask IoU", "peak [GiB]")
    for row in rows:
        name = f"{row.name} *" if row == best else row.name
        numbers = f"{row.rmse:.5f}", f"{row.psnr:.1f}", f"{row.largest:.3f}", f"{row.ssim:.4f}", f"{row.mask_iou:.4f}"
        table.add_row(name, f"{row.seconds:.2f}", *numbers, f"{row.memory:.2f}")
    Console(width=100).print(table)
    typer.echo(f"* the cheapest preset within {tolerance:g}")
    write_csv(rows, out.with_suffix(".csv"))
    draw_chart(rows, out, title=f"{scene.name}: {frames} images", tolerance=tolerance)
    typer.echo(f"chart: {out}, {out.with_suffix('.csv')}")


@app.command()
def audit(dataset: DatasetFolder) -> None:
    """Re-check DATASET from its files alone.

    Every violation is one line; with any, the exit status is 1.
    """
    from mitsplat.audit import POLYGON_AREA, POLYGON_IOU, audit_dataset

    found = audit_dataset(dataset)
    for file, text in found.violations:
        typer.echo(f"{file}: {text}")
    typer.echo(f"{found.frames} frames, {found.instances} instances, {found.files} files")
    typer.echo(f"not labelled: {_counts(found.dropped)}; marked: {_counts(found.marked)}")
    typer.echo(f"polygons below an IoU of {POLYGON_IOU} (masks in parts, over {POLYGON_AREA} px): {found.low_polygons}")
    typer.echo(f"violations: {len(found.violations)}")
    raise typer.Exit(1 if found.violations else 0)


@app.command()
def report(
    dataset: DatasetFolder,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Page to write (.html); report.html in DATASET if absent.")
    ] = None,
) -> None:
    """Write a page to look at DATASET by.

    It is one HTML file that needs no network: samples with their labels, statistics, audit, origin.
    """
    from mitsplat.report import write_report

    page, found = write_report(dataset, out)
    typer.echo(f"report: {page} ({len(found.violations)} violations)")


@app.command()
def preview(
    scene: SceneFile,
    frame: FrameIndex = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write (.png or .jpg).")] = Path("preview.png"),
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size [px], such as 640x360.")] = None,
    seed: Annotated[int | None, typer.Option(help="Decides everything that is random.")] = None,
    quality: Annotated[QualityName | None, typer.Option(help="Rendering preset.")] = None,
    layers: Annotated[
        bool, typer.Option("--layers/--no-layers", help="Show ids, depth, light and highlight beside the picture.")
    ] = True,
) -> None:
    """Render one frame of SCENE to a picture, with its layers side by side."""
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"--out must end in .png or .jpg (got {out})")
    if not out.parent.is_dir():
        raise InputError(f"--out must be in a folder that exists (got {out})")
    from PIL import Image

    from mitsplat.frame import render_frame
    from mitsplat.scene import load_scene
    from mitsplat.sheet import layer_sheet

    loaded = load_scene(scene, overrides=_overrides(size=size, seed=seed, quality=quality))
    rendered = render_frame(loaded, frame)
    Image.fromarray(layer_sheet(rendered) if layers else rendered.image).save(out)
    typer.echo(f"picture: {out}")


@app.command()
def settle(
    scene: SceneFile,
    layouts: Annotated[int | None, typer.Option("--layouts", "-n", help="Only the first so many layouts.")] = None,
    preview: Annotated[bool, typer.Option("--preview", help="Write the drop of the first layout as a GIF.")] = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="GIF to write.")] = Path("settle.gif"),
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the GIF [px].")] = "480x270",
    seed: Annotated[int | None, typer.Option(help="Decides everything that is random.")] = None,
    workers: Annotated[int, typer.Option(help="Processes that settle layouts.")] = 1,
) -> None:
    """Settle the layouts of SCENE and print their rest certificates.

    They are kept, so that rendering finds them settled.
    """
    if out.suffix.lower() != ".gif":
        raise InputError(f"--out must end in .gif (got {out})")
    if not out.parent.is_dir():
        raise InputError(f"--out must be in a folder that exists (got {out})")
    from rich.console import Console

    from mitsplat.rest import certificate_table, write_preview
    from mitsplat.scene import load_scene
    from mitsplat.settle import settle_layouts

    loaded = load_scene(scene, overrides=_overrides(size=size, seed=seed))
    wanted = loaded.spec.output.layouts if layouts is None else layouts
    if not 1 <= wanted <= loaded.spec.output.layouts:
        raise InputError(
            f"--layouts must be 1 to {loaded.spec.output.layouts}, the scene's output.layouts (got {wanted})"
        )
    with Console(stderr=True).status("settling") as status:
        found = settle_layouts(loaded, range(wanted), workers=workers, progress=status.update)
        settled = sorted(found, key=lambda layout: layout.index)
    Console().print(certificate_table(settled))
    if preview:
        pictures = write_preview(loaded, settled[0], out)
        typer.echo(f"drop: {out} ({pictures} pictures)")


@app.command()
def export(
    scene: SceneFile,
    frame: FrameIndex = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Mitsuba scene to write (.xml).")] = Path("scene.xml"),
) -> None:
    """Write one frame of SCENE as a Mitsuba scene.

    It can be edited, and rendered by `mitsplat render`.
    """
    from mitsplat.scene import load_scene
    from mitsplat.xml_scene import export_xml

    export_xml(load_scene(scene), frame, out)
    typer.echo(f"scene: {out}")


@app.command()
def bake(
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="Textured or coloured mesh that trimesh reads.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Asset folder to write.")],
    name: Annotated[str | None, typer.Option(help="Name of the asset; the folder's if absent.")] = None,
    class_name: Annotated[str | None, typer.Option("--class", help="Class to learn; the name if absent.")] = None,
    kind: Annotated[Literal["object", "environment"], typer.Option(help="Whether physics moves it.")] = "object",
    light: Annotated[Literal["uniform", "studio"], typer.Option(help="Light to bake under.")] = "uniform",
    gaussians: Annotated[int, typer.Option(help="Number of Gaussians aimed for.")] = 20000,
    sh_degree: Annotated[int, typer.Option(help="Degree of the spherical harmonics, 0 to 3.")] = 2,
    units: Annotated[float, typer.Option(help="Metres per unit of the mesh; 0.001 for millimetres.")] = 1.0,
    up: Annotated[Literal["y", "z"], typer.Option(help="Axis of the mesh that points up.")] = "z",
    density: Annotated[float, typer.Option(help="Mass density [kg/m^3].")] = 1000.0,
    friction: Annotated[float, typer.Option(help="Coulomb friction coefficient.")] = 0.5,
    seed: Annotated[int, typer.Option(help="Decides everything that is random.")] = 0,
) -> None:
    """Turn MESH into an asset.

    It has Gaussians with baked radiance, a proxy mesh and convex pieces.
    """
    from mitsplat.bake import BakeSettings, bake_asset

    result = bake_asset(
        mesh,
        name=name or out.resolve().name,
        class_name=class_name,
        kind=kind,
        light=light,
        settings=BakeSettings(gaussians=gaussians, sh_degree=sh_degree, seed=seed),
        metres_per_unit=units,
        up=up,
        density=density,
        friction=friction,
    )
    result.asset.save(out)
    typer.echo(f"asset: {out} ({len(result.asset.splats)} Gaussians, {result.psnr:.1f} dB on unseen views)")


@app.command()
def fit(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")],
    gaussians: Annotated[int, typer.Option(help="Most Gaussians.")] = 30000,
    iterations: Annotated[int, typer.Option(help="Optimiser steps, one photo each.")] = 3000,
    budget: Annotated[
        str | None, typer.Option(metavar="TIME", help="Shorten the fit to this time, such as 90s, 10min or 1h.")
    ] = None,
    target_psnr: Annotated[float | None, typer.Option(help="End early at this PSNR of held-out photos [dB].")] = None,
    edge: Annotated[int, typer.Option(help="Longest edge of the photos in the fit [px].")] = 800,
    sh_degree: Annotated[int, typer.Option(help="Degree of the spherical harmonics, 0 to 3.")] = 3,
    masks: Annotated[
        Literal["alpha", "ignore", "off"],
        typer.Option(help="Fit only what masks show, ignore what they leave out, or do not read them."),
    ] = "alpha",
    background: Annotated[Literal["random", "black"], typer.Option(help="Colour behind the splats.")] = "random",
    depth: Annotated[float, typer.Option(help="Weight of the depths of the capture's points.")] = 0.0,
    exposure: Annotated[
        bool, typer.Option("--exposure/--no-exposure", help="Give each photo a colour correction of its own.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Decides everything that is random.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite/--resume", help="Replace a fit in the folder, or go on with it.")
    ] = False,
) -> None:
    """Fit Gaussians to the photos of CAPTURE.

    Every eighth photo is held out to check the result.
    """
    from mitsplat.capture import Capture
    from mitsplat.fit import FitProgress, FitSettings, fit_capture

    settings = FitSettings(
        gaussians=gaussians,
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
    with _progress_bar("steps/s") as show:

        def progress(now: FitProgress) -> None:
            checked = "" if now.held_out is None else f" ({now.held_out:.1f} held out)"
            show(int(now.fraction * iterations), iterations, f"{now.psnr:.1f} dB{checked}, {now.gaussians} Gaussians")

        result = fit_capture(loaded, out, settings, overwrite=overwrite, progress=progress)
    typer.echo(
        f"splats: {out / 'splats.ply'} ({len(result.splats)} Gaussians; {len(result.held_out)} held-out photos: "
        f"{result.psnr:.2f} dB, SSIM {result.ssim:.3f})"
    )
    if target_psnr is not None and result.psnr < target_psnr:
        raise PartialResultError(
            f"{out}: held-out PSNR must reach {target_psnr:.2f} dB (got {result.psnr:.2f}); more iterations or "
            "Gaussians, or more photos with overlap and even light, would help"
        )


@app.command()
def capture(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="Folder of photographs of one object or place.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the capture to write.")],
    kind: Annotated[
        Literal["object", "environment"], typer.Option(help="Whether the subject is cut out by masks.")
    ] = "object",
    max_size: Annotated[int, typer.Option(help="Longest edge at which photos are used [px].")] = 1600,
    squares: Annotated[str, typer.Option(metavar="CxR", help="Squares of the ChArUco board to look for.")] = "7x5",
    square: Annotated[float, typer.Option(help="Edge of its squares as measured on the print [m].")] = 0.035,
    tag: Annotated[float | None, typer.Option(help="Edge of AprilTags (36h11) as printed, black border [m].")] = None,
    scale_from: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            metavar="A B METRES", help="Distance of two places: PHOTO is its camera, PHOTO:X,Y what it sees at a pixel."
        ),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Folder of a COLMAP model, or NeRF's transforms.json, to take cameras from.")
    ] = None,
    metric: Annotated[bool, typer.Option("--metric", help="The given poses are in metres with z up.")] = False,
    masks: Annotated[Path | None, typer.Option(help="Folder of masks, PHOTO.png, white = object.")] = None,
    mask_model: Annotated[
        Path | None, typer.Option(help="Segmentation network (.onnx) that makes the masks, by rembg.")
    ] = None,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Resample the photos to cameras without lens distortion.")
    ] = False,
) -> None:
    """Find cameras, scale, gravity and masks of PHOTOS.

    Runs again where it stopped. If too many photos are of no use, the exit status is 4.
    """
    from mitsplat.take import CaptureSettings, capture_photos

    settings = CaptureSettings(
        kind=kind,
        max_size=max_size,
        board=_board(squares, square),
        tag=tag,
        scale_from=scale_from,
        poses=poses,
        metric=metric,
        masks=masks,
        mask_model=mask_model,
        undistorted=undistort,
    )
    with _progress_bar("steps/s") as progress:
        result = capture_photos(photos, out, settings, progress=progress)
    found = result.capture
    for name, reason in sorted(found.rejected.items()):
        typer.echo(f"rejected: {name}: {reason}")
    if result.weak:
        typer.echo(f"weakly held, more overlap would help: {', '.join(result.weak)}")
    typer.echo(
        f"capture: {out} ({len(found.photos)} of {result.given} photos, {len(found.points)} points, "
        f"{result.reprojection_error:.2f} px)"
    )
    scale = "in metres" if found.units == "metre" else "in unknown units"
    error = "" if found.scale_error is None else f" ± {found.scale_error:.2%}"
    typer.echo(f"frame: {scale}{error}, {'z up' if found.up == 'z' else 'up unknown'}, by {result.source}")
    typer.echo(f"picture: {out / 'capture.png'}")
    if result.shortcoming is not None:
        raise PartialResultError(f"{out}: {result.shortcoming}")


@app.command()
def board(
    out: Annotated[Path, typer.Option("--out", "-o", help="Sheet to write (.pdf).")] = Path("board.pdf"),
    paper: Annotated[Literal["a4", "letter", "a3"], typer.Option(help="Paper, in landscape.")] = "a4",
    squares: Annotated[str, typer.Option(metavar="CxR", help="Squares across and down.")] = "7x5",
    square: Annotated[float, typer.Option(help="Edge of a square [m].")] = 0.035,
) -> None:
    """Write a ChArUco board to print.

    In photographs of what stands on or beside it, it gives `mitsplat capture` metres and the vertical.
    """
    if out.suffix.lower() != ".pdf":
        raise InputError(f"--out must end in .pdf (got {out})")
    _board(squares, square).write_pdf(out, paper)
    typer.echo(f"board: {out} (print at 100 %, then measure a square and give it to `mitsplat capture --square`)")


@app.command()
def mesh(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder, with masks for an object.")],
    splats: Annotated[Path, typer.Argument(metavar="SPLATS", help="Folder of a fit, or a splat file in its frame.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Asset folder to write.")],
    name: Annotated[str | None, typer.Option(help="Name of the asset; the folder's if absent.")] = None,
    class_name: Annotated[str | None, typer.Option("--class", help="Class to learn; the name if absent.")] = None,
    kind: Annotated[Literal["object", "environment"], typer.Option(help="Whether physics moves it.")] = "object",
    faces: Annotated[int, typer.Option(help="Most faces of the mesh.")] = 10000,
    voxels: Annotated[int, typer.Option(help="Cells of the grid along the longest extent.")] = 192,
    dissent: Annotated[int, typer.Option(help="Masks that may leave a point out and be overruled, 0 to 3.")] = 0,
    size: Annotated[float | None, typer.Option(help="Longest extent [m], where the capture has no scale.")] = None,
    take: Annotated[
        Path | None, typer.Option("--import", metavar="MESH", help="Take this mesh instead; it is registered.")
    ] = None,
    normalisation: Annotated[
        Path | None,
        typer.Option(help="Matrix (3x4 or 4x4, text) that its tool applied to the cameras: its inverse places it."),
    ] = None,
    units: Annotated[float | None, typer.Option(help="Metres per unit of the imported mesh.")] = None,
) -> None:
    """Make an asset of SPLATS that were fitted to CAPTURE.

    The object is isolated by its masks, its surface found, and both are judged by held-out photos in report.html. If a
    threshold is missed, the exit status is 4.
    """
    from mitsplat.align import invert_transform
    from mitsplat.assets import read_mesh
    from mitsplat.pipeline import AssetJob, make_asset
    from mitsplat.reconstruct import ImportedMesh, ReconstructSettings
    from mitsplat.surface import SurfaceSettings

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
        settings=ReconstructSettings(surface=surface, size=size),
        imported=imported,
    )
    with _progress_bar("steps") as progress:
        done = make_asset(capture, splats, out, job, progress=progress)
    _tell_asset(done)


@app.command()
def asset(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="Folder of photographs of one object or place.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Asset folder to write.")],
    name: Annotated[str | None, typer.Option(help="Name of the asset; the folder's if absent.")] = None,
    class_name: Annotated[str | None, typer.Option("--class", help="Class to learn; the name if absent.")] = None,
    kind: Annotated[Literal["object", "environment"], typer.Option(help="Whether physics moves it.")] = "object",
    size: Annotated[float | None, typer.Option(help="Longest extent [m], where the photos give no scale.")] = None,
    scale_from: Annotated[
        tuple[str, str, float] | None,
        typer.Option(metavar="A B METRES", help="Distance of two places, as in `mitsplat capture`."),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Folder of a COLMAP model, or NeRF's transforms.json, to take cameras from.")
    ] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of masks, PHOTO.png, white = object.")] = None,
    mask_model: Annotated[
        Path | None, typer.Option(help="Segmentation network (.onnx) that makes the masks, by rembg.")
    ] = None,
    gaussians: Annotated[int, typer.Option(help="Most Gaussians.")] = 30000,
    iterations: Annotated[int, typer.Option(help="Optimiser steps of the fit, one photo each.")] = 3000,
    budget: Annotated[
        str | None, typer.Option(metavar="TIME", help="Shorten the fit to this time, such as 90s, 10min or 1h.")
    ] = None,
    edge: Annotated[int, typer.Option(help="Longest edge of the photos in the fit [px].")] = 800,
    faces: Annotated[int, typer.Option(help="Most faces of the mesh.")] = 10000,
    seed: Annotated[int, typer.Option(help="Decides everything in the fit that is random.")] = 0,
) -> None:
    """Make an asset of PHOTOS.

    Cameras, splats, isolation, mesh and verdict: `capture`, `fit` and `mesh` in one. Runs again where it stopped;
    report.html shows what came of it. If a threshold is missed, the exit status is 4.
    """
    from mitsplat.fit import FitSettings
    from mitsplat.pipeline import AssetJob, make_photo_asset
    from mitsplat.reconstruct import ReconstructSettings
    from mitsplat.surface import SurfaceSettings
    from mitsplat.take import CaptureSettings

    job = AssetJob(
        name=name or out.resolve().name,
        class_name=class_name,
        kind=kind,
        settings=ReconstructSettings(surface=SurfaceSettings(faces=faces), size=size),
    )
    with _progress_bar("steps") as progress:
        done = make_photo_asset(
            photos,
            out,
            job,
            capture=CaptureSettings(kind=kind, scale_from=scale_from, poses=poses, masks=masks, mask_model=mask_model),
            fit=FitSettings(
                gaussians=gaussians,
                iterations=iterations,
                budget=None if budget is None else _seconds(budget),
                size=edge,
                seed=seed,
            ),
            progress=progress,
        )
    _tell_asset(done)


@app.command()
def schema() -> None:
    """Print the JSON Schema of scene files, for editors."""
    import json

    from mitsplat.scene import scene_json_schema

    typer.echo(json.dumps(scene_json_schema(), indent=2))


@app.command()
def doctor() -> None:
    """Check that this machine has what is needed.

    Python, Mitsuba, LLVM, Warp and memory, and what to do about what is missing.
    """
    from mitsplat.doctor import examine

    healthy = True
    for finding in examine():
        healthy &= finding.ok
        typer.echo(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.name}: {finding.text}")
        if not finding.ok:
            typer.echo(f"      to do: {finding.remedy}")
    raise typer.Exit(0 if healthy else 1)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mitsplat {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


def _board(squares: str, square: float) -> Board:
    from mitsplat.board import Board

    columns, _, rows = squares.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise InputError(f"--squares must be COLUMNSxROWS, such as 7x5 (got {squares})")
    return Board(int(columns), int(rows), square)


def _tell_asset(done: Finished) -> None:
    """What came of an asset, and status 4 where a threshold is missed."""
    found, kept = done.verdict, " (kept: nothing it is made of has changed)" if done.kept else ""
    closed = "watertight" if found.watertight else "open"
    typer.echo(f"asset: {done.folder}{kept}")
    typer.echo(f"photos: {found.photos} of {found.photos + found.rejected} with a camera; units: {found.units}")
    typer.echo(f"splats: {found.gaussians}; mesh: {found.faces} faces, {closed}")
    figures = {
        "held-out PSNR": None if found.psnr is None else f"{found.psnr:.2f} dB",
        "IoU with held-out masks": None
        if found.splat_iou is None
        else f"splats {found.splat_iou:.3f}, mesh {found.mesh_iou or 0:.3f}",
        "shift between mesh and splats": None if found.offset is None else f"{found.offset:.3%} of the diagonal",
    }
    typer.echo("; ".join(f"{name} {value}" for name, value in figures.items() if value is not None))
    typer.echo(f"report: {done.folder / 'report.html'}")
    if done.shortcoming is not None:
        raise PartialResultError(f"{done.folder}: {done.shortcoming}")


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in counts.items() if count) or "none"


def _fail(sentence: str, *, status: int = 2) -> None:
    typer.echo(f"mitsplat: {sentence}", err=True)
    sys.exit(status)


def _overrides(
    *, size: str | None = None, seed: int | None = None, quality: str | None = None, formats: str | None = None
) -> dict[str, Any]:
    """The options that were given, by the scene file's keys."""
    overrides: dict[str, Any] = {"seed": seed, "quality": quality}
    if size is not None:
        width, _, height = size.lower().partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            raise InputError(f"--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got {size})")
        overrides |= {"output.width": int(width), "output.height": int(height)}
    if formats is not None:
        overrides["output.formats"] = [name.strip() for name in formats.split(",")]
    return {key: value for key, value in overrides.items() if value is not None}


def _seconds(text: str) -> float:
    """Time [s] such as 90s, 10min or 1h."""
    for suffix, factor in (("min", 60.0), ("h", 3600.0), ("s", 1.0)):
        if text.endswith(suffix):
            with suppress(ValueError):
                return float(text.removesuffix(suffix)) * factor
    raise InputError(f"--budget must be a time such as 90s, 10min or 1h (got {text})")


@contextmanager
def _progress_bar(unit: str = "images/s") -> Iterator[Callable[[int, int, str], None]]:
    """A bar on stderr with speed and the time left."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class RateColumn(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:.2f} {unit}")

    columns = (BarColumn(), MofNCompleteColumn(), RateColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=300) as bar:
        task = bar.add_task("", total=None)

        def update(done: int, total: int, doing: str) -> None:
            # Frames of an earlier run, or the steps of an earlier stage, must not count as this one's speed.
            if bar.tasks[0].total != total or done < bar.tasks[0].completed:
                bar.reset(task, total=total, completed=done)
            bar.update(task, completed=done, description=doing)

        yield update
