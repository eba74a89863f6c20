"""Commands for scenes and datasets.

Each command imports its dependencies inside its function, so that all other commands and ``--help`` start fast.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer

from mitsplat.cli.options import (
    DeviceName,
    JsonLog,
    check_ending,
    check_new,
    check_output_file,
    command_log,
    print_device,
    progress_bar,
    select_device,
)
from mitsplat.errors import InputError, PartialResultError
from mitsplat.quality import PresetName

if TYPE_CHECKING:
    from mitsplat.dataset.write import DatasetSummary
    from mitsplat.findings import Finding
    from mitsplat.runtime.device import Device
    from mitsplat.scene.scene import Scene


SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml).")]
DatasetFolder = Annotated[Path, typer.Argument(metavar="DATASET", help="Dataset folder.")]
FrameIndex = Annotated[int, typer.Option("--frame", help="Frame index, from 0.")]
FrameSize = Annotated[str | None, typer.Option(metavar="WxH", help="Image size [px], such as 1280x720.")]
SceneSeed = Annotated[int | None, typer.Option(help="Seed of all random numbers; replaces the seed of the scene.")]
AllowOutside = Annotated[
    bool, typer.Option("--allow-outside", help="Allow SCENE to reference files outside its folder.")
]
OverwriteDataset = Annotated[
    bool,
    typer.Option(
        "--overwrite/--resume", help="Replace the dataset in the folder, or continue it and keep its finished images."
    ),
]
Preset = Annotated[PresetName | None, typer.Option(help="Rendering preset; replaces the preset of the scene.")]


def render(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml), OpenUSD stage, or Mitsuba scene (.xml).")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Dataset folder, or picture for a .xml scene; out/<name of SCENE> by default."
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option("--frames", "-n", help="Render only the first N images.")] = None,
    only: Annotated[
        int | None,
        typer.Option(
            metavar="FRAME",
            help="Render only this image again (index from 0) into a folder beside --out, and compare it "
            "with the dataset in --out.",
        ),
    ] = None,
    size: FrameSize = None,
    seed: SceneSeed = None,
    quality: Preset = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Use the fastest preset whose error (RMSE of encoded colours) is at most this value; see "
            "`mitsplat chart`."
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Device that renders: cpu, cuda (one GPU), cuda:1, cuda:all, or auto (a GPU if there is "
            "one); cpu by default.",
        ),
    ] = None,
    any_device: Annotated[
        bool, typer.Option("--any-device", help="Continue a dataset that was started on the other kind of device.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Number of worker processes; by default chosen by measured speed, and limited by the GPU "
            "memory on GPUs."
        ),
    ] = None,
    engine: Annotated[
        Literal["local", "ray"], typer.Option(help="Render on this machine or on a Ray cluster.")
    ] = "local",
    address: Annotated[
        str | None, typer.Option(help="Address of the Ray cluster, or auto; by default Ray is started on this machine.")
    ] = None,
    resources: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=AMOUNT,...",
            help="Resources that each cluster worker reserves, such as CPU=4; by default CPU=2, or "
            "CPU=1,GPU=0.125 on cuda.",
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="Render only part I of N (I from 1); `mitsplat merge` joins the parts."),
    ] = None,
    json_log: JsonLog = False,
    formats: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAMES",
            help="Label formats, separated by commas; replaces output.formats of the scene.",
        ),
    ] = None,
    overwrite: OverwriteDataset = False,
    allow_outside: AllowOutside = False,
) -> None:
    """Render the labelled dataset of SCENE.

    Options override values of the scene file. A Mitsuba scene (.xml) is rendered to one picture without labels.
    For an OpenUSD stage (.usd, .usda, .usdc, .usdz), each of its cameras gives a labelled image per time code.
    """
    from mitsplat.runtime.device import find_device, use_device

    if only is not None and any((frames is not None, shard, engine == "ray", workers is not None, overwrite)):
        raise InputError(
            "--only renders one image on this machine: remove -n, --shard, --engine, --workers and --overwrite"
        )

    with command_log(json_log, "render") as progress_bars:
        overrides = _overrides(size=size, seed=seed, quality=quality, formats=formats)
        if out is None:
            out = Path("out") / (scene.stem if shard is None else f"{scene.stem}-{shard.replace('/', '-of-')}")
        chosen = find_device(device or "cpu") if engine == "local" else None
        if chosen is not None and not json_log:
            print_device(chosen)
        if scene.suffix == ".xml":
            ignored = engine != "local", overwrite, any_device, workers is not None
            if overrides or any(ignored) or any(given is not None for given in (frames, only, tolerance, shard)):
                raise InputError(f"{scene}: a Mitsuba scene has its own size, seed and quality: only --out applies")
            from mitsplat.frames.mitsuba_xml import render_apart

            typer.echo(f"picture: {render_apart(scene, out, allow_outside=allow_outside, device=chosen)}")
            return
        from mitsplat.usd.usd_layers import is_usd

        if is_usd(scene):
            ignored = engine != "local", any_device, workers is not None, seed is not None
            if any(ignored) or any(given is not None for given in (only, tolerance, shard)):
                raise InputError(
                    f"{scene}: only --out, --frames, --size, --format, --quality, --device and --overwrite apply to a "
                    "USD stage"
                )
            if frames is not None and frames < 1:
                raise InputError(f"--frames must be 1 or more (got {frames})")
            use_device(device or "cpu")
            _render_stage(scene, out, frames, overrides, overwrite=overwrite)
            return
        from mitsplat.dataset.dataset_folder import Shard
        from mitsplat.dataset.write import write_dataset
        from mitsplat.engine.ray import Cluster
        from mitsplat.scene.loading.scene_loading import load_scene

        part = None if shard is None else Shard.parse(shard)
        if engine != "ray" and (address is not None or resources is not None):
            raise InputError("--address and --resources apply to a Ray cluster: add --engine ray")
        cluster = None
        if engine == "ray":
            cluster = Cluster(address, None if resources is None else Cluster.parse_resources(resources))
            cluster.on_device(device)  # raises if the device contradicts the cluster's resources
        loaded = load_scene(scene, overrides=overrides, allow_outside=allow_outside)
        if tolerance is not None:
            if quality is not None:
                raise InputError("--quality and --tolerance both select the preset: give only one")
            from mitsplat.dataset.preflight import refuse, run_faults
            from mitsplat.frames.accuracy.speed_accuracy import choose_preset

            refuse(loaded, run_faults(loaded))
            with progress_bars() as progress:
                best = choose_preset(
                    scene,
                    tolerance,
                    overrides=overrides,
                    allow_outside=allow_outside,
                    progress=progress,
                    device=chosen,
                )
            typer.echo(f"preset: {best.name} (RMSE {best.rmse:.2g}, {best.seconds:.2f} s an image)")
            loaded = load_scene(scene, overrides=overrides | {"quality": best.name}, allow_outside=allow_outside)
        if only is not None:
            _render_again(loaded, only, out, device if chosen is None else chosen)
            return
        with progress_bars() as progress:
            summary = write_dataset(
                loaded,
                out,
                frames=frames,
                shard=part,
                workers=workers,
                cluster=cluster,
                overwrite=overwrite,
                progress=progress,
                device=device if chosen is None else chosen,
                any_device=any_device,
            )
        _print_summary(summary, whole=part is None)


def _render_again(scene: Scene, index: int, dataset: Path, device: str | Device | None) -> None:
    """Render one frame again and exit with status 1 if it differs from the frame in the dataset."""
    from mitsplat.dataset.rerender import rerender_frame

    made = rerender_frame(scene, index, Path(f"{dataset}-{index:06d}"), dataset=dataset, device=device)
    typer.echo(f"frame {index}: {made.path} ({len(made.record['files'])} files)")
    if not made.compared:
        typer.echo(f"not compared: {dataset} has no frame {index}")
    elif not made.differing:
        typer.echo(f"all files are identical to those in {dataset}")
    else:
        cause = made.cause or "although the inputs are identical"
        typer.echo(f"different from {dataset}: {', '.join(made.differing)} ({cause})")
        raise typer.Exit(1)


def merge(
    shards: Annotated[
        list[Path], typer.Argument(metavar="SHARDS...", help="Dataset folders with all shards of one dataset.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Dataset folder to write.")],
    overwrite: OverwriteDataset = False,
    json_log: JsonLog = False,
) -> None:
    """Join the shards of a dataset into one dataset.

    The hash of every file is checked, and every frame must be present. The result equals that of a single run.
    """
    from mitsplat.dataset.shards import merge_shards

    with command_log(json_log, "merge") as progress_bars, progress_bars() as progress:
        summary = merge_shards(shards, out, overwrite=overwrite, progress=progress)
    _print_summary(summary)


def split(
    dataset: DatasetFolder,
    folds: Annotated[
        int, typer.Option(help="Number of folds; each fold validates on a different part of the layouts.")
    ] = 5,
) -> None:
    """Write image lists of DATASET for cross-validation.

    All images of a layout are in the same fold. Classes are spread evenly over the folds as far as whole layouts allow.
    The test split is not used.
    """
    from mitsplat.dataset.folds import write_folds

    for number, fold in enumerate(write_folds(dataset, folds), start=1):
        counts = _format_counts(fold.instances)
        typer.echo(f"fold{number}: validates with {fold.images} images of {fold.layouts} layouts ({counts})")


def _print_summary(summary: DatasetSummary, *, whole: bool = True) -> None:
    """Print a summary of a dataset.

    Raises:
        PartialResultError: If a complete dataset has no label at all. A shard may have none.
    """
    images = ", ".join(f"{count} {split}" for split, count in summary.images.items())
    typer.echo(f"dataset: {summary.path} ({images}; {sum(summary.instances.values())} labelled instances)")
    typer.echo(f"not labelled: {_format_counts(summary.dropped)}; marked: {_format_counts(summary.marked)}")
    if summary.incomplete:
        typer.echo(
            f"layouts without objects that did not come to rest: {summary.incomplete} "
            f"({_format_counts(summary.left_out)})"
        )
    typer.echo(f"contact sheet: {summary.contact_sheet}")
    if summary.unlabelled and whole:
        raise PartialResultError(
            f"{summary.path}: no image has a label (not labelled: {_format_counts(summary.dropped)}); "
            "run `mitsplat check` and `mitsplat preview` to see the view of the cameras"
        )


def chart(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml) or splat file.")],
    frames: Annotated[
        int, typer.Option("--frames", "-n", help="Number of images to compare, spread evenly over the scene.")
    ] = 3,
    size: FrameSize = None,
    tolerance: Annotated[
        float, typer.Option(help="Mark the fastest preset whose error (RMSE of encoded colours) is at most this value.")
    ] = 0.004,
    at: Annotated[
        list[float] | None,
        typer.Option(help="Additional blending-order tolerance at which `balanced` is measured; repeatable."),
    ] = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Chart to write (.png); a .csv file of the same name is written beside it."),
    ] = Path("chart.png"),
    device: DeviceName = "cpu",
    allow_outside: AllowOutside = False,
) -> None:
    """Measure speed and accuracy of the rendering presets on SCENE.

    All presets and several cheaper light models are compared with the preset exact. Objects that all have materials
    are compared with their path-traced meshes, beside captured objects and meshes with fewer paths. Times are valid for
    this machine only. Memory is main memory, not GPU memory.
    """
    from rich.console import Console
    from rich.table import Table

    from mitsplat.frames.accuracy.accuracy_chart import draw_chart, write_csv
    from mitsplat.frames.accuracy.speed_accuracy import cheapest, check_tolerance, measure_steps
    from mitsplat.runtime.device import find_device

    check_output_file(out, ".png")
    check_tolerance(tolerance)
    chosen = find_device(device)
    print_device(chosen)
    with progress_bar() as progress:
        rows = measure_steps(
            scene,
            tolerances=at or (),
            frames=frames,
            overrides=_overrides(size=size),
            allow_outside=allow_outside,
            progress=progress,
            device=chosen,
        )
    best = cheapest(rows, tolerance)
    names = "RMSE", "PSNR [dB]", "largest", "estimate", "objects [dB]", "SSIM", "mask IoU", "peak [GiB]"
    table = Table("step", "s/image", *names)
    for row in rows:
        name = f"{row.name} *" if row == best else row.name
        errors = f"{row.rmse:.5f}", f"{row.psnr:.1f}", f"{row.largest:.3f}", f"{row.estimate:.4f}", f"{row.objects:.1f}"
        table.add_row(
            name, f"{row.seconds:.2f}", *errors, f"{row.ssim:.4f}", f"{row.mask_iou:.4f}", f"{row.memory:.2f}"
        )
    Console(width=120).print(table)
    typer.echo(f"* fastest preset with an error of at most {tolerance:g}")
    write_csv(rows, out.with_suffix(".csv"))
    draw_chart(rows, out, title=f"{scene.name}: {frames} images", tolerance=tolerance)
    typer.echo(f"chart: {out}, {out.with_suffix('.csv')}")


def audit(dataset: DatasetFolder) -> None:
    """Check DATASET for errors, from its files alone.

    Each violation is printed on one line. The exit status is 1 if there is any violation.
    """
    from mitsplat.audit.audit import POLYGON_AREA, POLYGON_IOU, audit_dataset

    found = audit_dataset(dataset)
    for file, text in found.violations:
        typer.echo(f"{file}: {text}")
    typer.echo(f"{found.frames} frames, {found.instances} instances, {found.files} files")
    typer.echo(f"not labelled: {_format_counts(found.dropped)}; marked: {_format_counts(found.marked)}")
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
    audit and the origin of the data. Properties of the images that a detector cannot learn are also printed.
    """
    from mitsplat.report.dataset_report import write_report

    check_ending(out, ".html")
    page, found, warnings = write_report(dataset, out)
    for warning in warnings:
        typer.echo(f"look  {warning}")
    typer.echo(f"report: {page} ({len(found.violations)} violations)")


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

    loaded = load_scene(scene, overrides=_overrides(size=size), allow_outside=allow_outside)
    refuse(loaded, chain(count_faults(loaded), layout_faults(loaded), image_faults(loaded)))
    select_device(device)
    rendered = render_frame(loaded, frame)
    picture = Image.fromarray(layer_sheet(rendered))
    write_file(out, lambda part: picture.save(part, "PNG" if out.suffix.lower() == ".png" else "JPEG"))
    typer.echo(f"picture: {out}")
    for fault in label_faults(loaded, [frame]):
        typer.echo(f"look  {fault.text}; {fault.remedy}")


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
        typer.Option(help="Maximum number of Gaussians in the browser; of more, all clouds show the same share."),
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
        raise MissingResourceError("the viewer requires viser: pip install 'mitsplat[view]'")
    from mitsplat.view import Address, serve

    def print_url(url: str) -> None:
        typer.echo(f"view: {url}  (Ctrl-C stops it)")

    select_device(device)
    serve(path, Address(host, port), gaussians=gaussians, allow_outside=allow_outside, ready=print_url)


def settle(
    scene: SceneFile,
    layouts: Annotated[int | None, typer.Option("--layouts", "-n", help="Settle only the first N layouts.")] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Write an animation of the first layout while it settles (GIF).")
    ] = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="GIF file to write.")] = Path("settle.gif"),
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the GIF [px].")] = "480x270",
    workers: Annotated[int, typer.Option(help="Number of processes that settle layouts.")] = 1,
    allow_outside: AllowOutside = False,
) -> None:
    """Settle the layouts of SCENE and print their rest certificates.

    Settled layouts are cached, so that a later `mitsplat render` does not settle them again.
    """
    check_output_file(out, ".gif")
    from rich.console import Console

    from mitsplat.dataset.preflight import count_faults, layout_faults, refuse
    from mitsplat.frames.settle_preview import certificate_table, write_preview
    from mitsplat.physics.settle import settle_layouts
    from mitsplat.scene.loading.scene_loading import load_scene

    loaded = load_scene(scene, overrides=_overrides(size=size), allow_outside=allow_outside)
    wanted = loaded.spec.output.layouts if layouts is None else layouts
    if not 1 <= wanted <= loaded.spec.output.layouts:
        raise InputError(
            f"--layouts must be 1 to {loaded.spec.output.layouts}, the scene's output.layouts (got {wanted})"
        )
    refuse(loaded, chain(count_faults(loaded), layout_faults(loaded)))
    with Console(stderr=True).status("settling") as status:
        found = settle_layouts(loaded, range(wanted), workers=workers, progress=status.update)
        settled = sorted(found, key=lambda layout: layout.index)
    # Output to a file has 80 columns, which would truncate the headings to one or two letters.
    Console(width=max(Console().width, 120)).print(certificate_table(settled))
    for layout in settled:
        for one in layout.left_out:
            typer.echo(f"left out of layout {layout.index}: {loaded.assets[one.asset].name} ({one.reason})")
    if preview:
        pictures = write_preview(loaded, settled[0], out)
        typer.echo(f"drop: {out} ({pictures} pictures)")


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
    is_asset, to_mitsuba = source.is_dir(), out.suffix.lower() == ".xml" and not mjcf
    losses: tuple[str, ...] = ()
    if is_asset and to_mitsuba:
        raise InputError(f"--out of an asset must be a USD stage, .glb, or MJCF with --mjcf (got {out})")
    if is_asset:
        from mitsplat.asset import Asset

        asset = Asset.load(source)
        if to_gltf:
            from mitsplat.gltf_splats.splat_writing import export_asset_gltf

            losses = export_asset_gltf(asset, out, spz=spz)
        else:
            from mitsplat.usd.mjcf import export_asset_mjcf
            from mitsplat.usd.usd_export import export_asset_usd

            losses = (export_asset_mjcf if mjcf else export_asset_usd)(asset, out)
    else:
        from mitsplat.scene.loading.scene_loading import load_scene

        scene = load_scene(source, allow_outside=allow_outside)
        if to_mitsuba:
            from mitsplat.frames.mitsuba_xml import export_xml

            export_xml(scene, frame, out)
        else:
            from mitsplat.usd.mjcf import export_scene_mjcf
            from mitsplat.usd.usd_export import export_scene_usd

            losses = (export_scene_mjcf if mjcf else export_scene_usd)(scene, frame, out)
    for loss in losses:
        typer.echo(f"not exported: {loss}")
    typer.echo(f"{'asset' if is_asset else 'scene'}: {out}")


def schema() -> None:
    """Print the JSON Schema of scene files, for editors."""
    import json

    from mitsplat.scene.loading.scene_loading import scene_json_schema

    typer.echo(json.dumps(scene_json_schema(), indent=2))


def doctor() -> None:
    """Check that this machine meets the requirements.

    The command checks Python, Mitsuba, processor, LLVM, GPU, Warp, memory, disk and cache, and suggests a remedy for
    each problem. The exit status is 1 if there is any problem.
    """
    from mitsplat.checks.doctor import examine

    _print_findings(examine(), "FAIL")


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
    _print_findings(
        findings if path.is_dir() else chain(findings, _trial_run(path, allow_outside=allow_outside)), "look"
    )


def _trial_run(path: Path, *, allow_outside: bool) -> Iterator[Finding]:
    """Yield the result of a trial run of a scene, unless the scene is refused."""
    from mitsplat.checks.time_check import measure_run
    from mitsplat.dataset.preflight import run_faults
    from mitsplat.scene.loading.scene_loading import load_scene

    scene = load_scene(path, allow_outside=allow_outside)
    if not any(run_faults(scene)):
        with suppress(InputError):  # reported by the checks before
            yield from measure_run(scene)


def _print_findings(findings: Iterable[Finding], mark: str) -> NoReturn:
    """Print one line per finding, with its remedy if there is a problem, and exit with status 0 or 1."""
    good = True
    for finding in findings:
        good &= finding.ok
        typer.echo(f"{'ok  ' if finding.ok else mark}  {finding.name}: {finding.text}")
        if not finding.ok:
            typer.echo(f"      to do: {finding.remedy}")
            if finding.place:
                typer.echo(f"      in {finding.place}")
    raise typer.Exit(0 if good else 1)


def _render_stage(stage: Path, out: Path, times: int | None, overrides: Mapping[str, Any], *, overwrite: bool) -> None:
    """Render the cameras of a USD stage at its time codes, at most ``times``, to a labelled dataset."""
    from tempfile import TemporaryDirectory

    from mitsplat.dataset.python_frames import write_frames
    from mitsplat.frames.sequence import render_frames
    from mitsplat.scene.layout import Layout
    from mitsplat.usd.stage_scene import read_stage_scene

    with TemporaryDirectory() as folder:
        found = read_stage_scene(stage, Path(folder), overrides, images=times)
        for note in found.notes:
            typer.echo(note)
        layouts = [Layout.from_poses(found.scene, poses) for poses in found.poses]
        # One film per camera; a stage without motion is one film over all cameras.
        films = found.cameras if len(layouts) > 1 else [[camera for (camera,) in found.cameras]]
        frames = chain.from_iterable(
            render_frames(found.scene, layouts=layouts * (len(film) // len(layouts)), cameras=film) for film in films
        )
        summary = write_frames(found.scene, out, frames, overwrite=overwrite)
        typer.echo(f"dataset: {out} ({summary.rendered} images of {len(layouts)} time codes)")


def _format_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in counts.items() if count) or "none"


def _overrides(
    *, size: str | None = None, seed: int | None = None, quality: str | None = None, formats: str | None = None
) -> dict[str, Any]:
    """Return the given options as a mapping from scene file keys to values."""
    from mitsplat.scene.spec.scene_spec import FORMATS

    if seed is not None and seed < 0:
        raise InputError(f"--seed must be >= 0 (got {seed})")
    overrides: dict[str, Any] = {"seed": seed, "quality": quality}
    if size is not None:
        width, _, height = size.lower().partition("x")
        if not (width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
            raise InputError(f"--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got {size})")
        overrides |= {"output.width": int(width), "output.height": int(height)}
    if formats is not None:
        names = [name.strip() for name in formats.split(",")]
        if unknown := [name for name in names if name not in FORMATS]:
            close = difflib.get_close_matches(unknown[0].lower(), FORMATS, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise InputError(f"--format must be one or more of {', '.join(FORMATS)} (got {unknown[0]}{hint})")
        overrides["output.formats"] = names
    return {key: value for key, value in overrides.items() if value is not None}
