"""Commands that inspect scenes, assets and datasets.

Each command imports its dependencies inside its function, so that all other commands and ``--help`` start fast.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitsplat.cli.console import format_counts, print_device, print_findings, progress_bar, select_device
from mitsplat.cli.options import (
    AllowOutside,
    DatasetFolder,
    DeviceName,
    FrameIndex,
    FrameSize,
    SceneFile,
    check_ending,
    check_output_file,
    scene_overrides,
)
from mitsplat.errors import InputError

if TYPE_CHECKING:
    from mitsplat.findings import Finding
    from mitsplat.frames.accuracy.speed_accuracy import Row


def view(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH", help="Scene file (.yaml), splat file, or folder of an asset, a capture or a dataset."
        ),
    ],
    host: Annotated[
        str, typer.Option(help="Address to listen on; with any address but localhost, other machines can connect.")
    ] = "localhost",
    port: Annotated[int, typer.Option(help="TCP port to listen on.")] = 8080,
    gaussians: Annotated[
        int,
        typer.Option(
            help="Maximum number of Gaussians in the browser; larger scenes show the same fraction of each cloud."
        ),
    ] = 300_000,
    device: DeviceName = "cpu",
    allow_outside: AllowOutside = False,
) -> None:
    """Show a scene, asset, capture, dataset or splats in a browser.

    For a scene, the page shows the splats beside a real render of the same view, which is refined over time. Scene
    values can be changed on the page, and the scene file is read again when it changes. Press Ctrl-C to stop.
    """
    from importlib.util import find_spec

    from mitsplat.errors import MissingResourceError

    if gaussians < 1:
        raise InputError(f"--gaussians must be at least 1 (got {gaussians})")
    if find_spec("viser") is None:
        raise MissingResourceError("the viewer needs viser: pip install 'mitsplat[view]'")
    from mitsplat.view import Address, serve

    def print_url(url: str) -> None:
        typer.echo(f"view: {url}  (Ctrl-C stops it)")

    select_device(device)
    serve(path, Address(host, port), gaussians=gaussians, allow_outside=allow_outside, ready=print_url)


def preview(
    scene: SceneFile,
    frame: FrameIndex = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Image to write (.png or .jpg).")] = Path("preview.png"),
    size: FrameSize = None,
    device: DeviceName = "cpu",
    allow_outside: AllowOutside = False,
) -> None:
    """Render one frame of SCENE, with its layers side by side."""
    check_output_file(out, ".png", ".jpg", ".jpeg")
    from PIL import Image

    from mitsplat.dataset.preflight import count_faults, image_faults, label_faults, layout_faults, refuse
    from mitsplat.frames.frame import render_frame
    from mitsplat.frames.layer_sheet import layer_sheet
    from mitsplat.scene.loading.scene_loading import load_scene
    from mitsplat.storage.files import write_file

    loaded = load_scene(scene, overrides=scene_overrides(size=size), allow_outside=allow_outside)
    refuse(loaded, chain(count_faults(loaded), layout_faults(loaded), image_faults(loaded)))
    select_device(device)
    rendered = render_frame(loaded, frame)
    picture = Image.fromarray(layer_sheet(rendered))
    write_file(out, lambda part: picture.save(part, "PNG" if out.suffix.lower() == ".png" else "JPEG"))
    typer.echo(f"picture: {out}")
    for fault in label_faults(loaded, [frame]):
        typer.echo(f"look  {fault.text}; {fault.remedy}")


def check(
    path: Annotated[Path, typer.Argument(metavar="ASSET|SCENE", help="Asset folder or scene file (.yaml).")],
    allow_outside: AllowOutside = False,
) -> None:
    """Check an asset or a scene for likely mistakes.

    The command checks units, up axis, needle-shaped Gaussians, floaters, agreement of mesh and splats, mass,
    colliders, free space, visibility and light, and suggests a remedy for each problem. For a scene, it also settles
    one layout and renders two images, and states the time that the dataset takes on this machine. The exit status is 1
    if there is any problem.
    """
    from mitsplat.checks.path_checks import check_path

    findings = check_path(path, allow_outside=allow_outside)
    print_findings(
        findings if path.is_dir() else chain(findings, _trial_run(path, allow_outside=allow_outside)), "look"
    )


def _trial_run(path: Path, *, allow_outside: bool) -> Iterator[Finding]:
    """Yield the result of a trial run of a scene, unless the scene is refused."""
    from mitsplat.checks.time_check import measure_run
    from mitsplat.dataset.preflight import run_faults
    from mitsplat.findings import Finding
    from mitsplat.scene.loading.scene_loading import load_scene

    scene = load_scene(path, allow_outside=allow_outside)
    if not any(run_faults(scene)):
        try:
            yield from measure_run(scene)
        except InputError as error:
            yield Finding(
                "trial run", False, str(error).removeprefix(f"{path}: "), "correct this first, or the problems above"
            )


def audit(dataset: DatasetFolder) -> None:
    """Check DATASET for errors, from its files alone.

    Each violation is printed on one line. The exit status is 1 if there is any violation.
    """
    from mitsplat.audit.audit import POLYGON_AREA, POLYGON_IOU, audit_dataset

    found = audit_dataset(dataset)
    for file, text in found.violations:
        typer.echo(f"{file}: {text}")
    typer.echo(f"{found.frames} frames, {found.instances} instances, {found.files} files")
    typer.echo(f"not labelled: {format_counts(found.dropped)}; marked: {format_counts(found.marked)}")
    typer.echo(
        f"polygons with IoU < {POLYGON_IOU} (masks of several parts, over {POLYGON_AREA} px): {found.low_polygons}"
    )
    typer.echo(f"violations: {len(found.violations)}")
    raise typer.Exit(1 if found.violations else 0)


def report(
    dataset: DatasetFolder,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="HTML page to write (.html); report.html in DATASET by default.")
    ] = None,
) -> None:
    """Write an HTML report of DATASET.

    The report is a single file that works offline. It shows sample images with labels, statistics, random draws, the
    audit and the origin of the data. The command also prints warnings about gaps in the dataset, such as classes with
    few examples.
    """
    from mitsplat.report.dataset_report import write_report

    check_ending(out, ".html")
    page, found, warnings = write_report(dataset, out)
    for warning in warnings:
        typer.echo(f"look  {warning}")
    typer.echo(f"report: {page} ({len(found.violations)} violations)")


def chart(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml) or splat file.")],
    frames: Annotated[
        int, typer.Option("--frames", "-n", help="Number of images to compare, spread evenly over the scene.")
    ] = 3,
    size: FrameSize = None,
    tolerance: Annotated[
        float, typer.Option(help="Mark the fastest preset whose error (RMSE of encoded colours) is at most this value.")
    ] = 0.004,
    order_tolerance: Annotated[
        list[float] | None,
        typer.Option(
            metavar="VALUE", help="Additional blending-order tolerance at which `balanced` is measured; repeatable."
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Chart to write (.png); a .csv file of the same name is written beside it."),
    ] = Path("chart.png"),
    device: DeviceName = "cpu",
    allow_outside: AllowOutside = False,
) -> None:
    """Measure speed and accuracy of the rendering presets on SCENE.

    The error of a preset, and of several cheaper light models, is the difference from the preset exact. If all objects
    have materials, the error of objects is the difference from their path-traced meshes. The chart then also has
    objects with captured colours, and path tracing with fewer paths. Times are valid for this machine only. Memory is
    main memory, not GPU memory.
    """
    from mitsplat.frames.accuracy.accuracy_chart import draw_chart, write_csv
    from mitsplat.frames.accuracy.speed_accuracy import check_tolerance, fastest_preset, measure_steps
    from mitsplat.runtime.device import find_device

    check_output_file(out, ".png")
    check_tolerance(tolerance)
    chosen = find_device(device)
    print_device(chosen)
    with progress_bar() as progress:
        rows = measure_steps(
            scene,
            tolerances=order_tolerance or (),
            frames=frames,
            overrides=scene_overrides(size=size),
            allow_outside=allow_outside,
            progress=progress,
            device=chosen,
        )
    _print_steps(rows, fastest_preset(rows, tolerance))
    typer.echo(f"* fastest preset with an error of at most {tolerance:g}")
    write_csv(rows, out.with_suffix(".csv"))
    draw_chart(rows, out, title=f"{scene.name}: {frames} images", tolerance=tolerance)
    typer.echo(f"chart: {out}, {out.with_suffix('.csv')}")


def _print_steps(rows: Sequence[Row], best: Row) -> None:
    """Print a table of measured steps with a mark at the best one."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    names = "RMSE", "PSNR [dB]", "largest", "estimate", "objects [dB]", "SSIM", "mask IoU", "peak [GiB]"
    table = Table()
    for title in ("step", "s/image", *names):
        table.add_column(Text(title))  # plain text, where markup would remove [dB]
    for row in rows:
        name = f"{row.name} *" if row == best else row.name
        errors = f"{row.rmse:.5f}", f"{row.psnr:.1f}", f"{row.largest:.3f}", f"{row.estimate:.4f}", f"{row.objects:.1f}"
        table.add_row(
            name, f"{row.seconds:.2f}", *errors, f"{row.ssim:.4f}", f"{row.mask_iou:.4f}", f"{row.memory:.2f}"
        )
    Console(width=120).print(table)
