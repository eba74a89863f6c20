"""Commands that make datasets.

Each command imports its dependencies inside its function, so that all other commands and ``--help`` start fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.console import command_log, format_counts, print_device
from mitsplat.cli.options import (
    AllowOutside,
    DatasetFolder,
    FrameSize,
    JsonLog,
    OverwriteDataset,
    Preset,
    SceneFile,
    SceneSeed,
    check_output_file,
    given_options,
    refuse_options,
    scene_overrides,
)
from mitsplat.errors import InputError, PartialResultError

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

    from mitsplat.dataset.write import DatasetSummary
    from mitsplat.progress import Progress
    from mitsplat.runtime.device import Device
    from mitsplat.scene.scene import Scene


def render(
    context: typer.Context,
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
            help="Number of worker processes; by default one for every two cores, or for every core with GPUs, as far "
            "as the memory suffices."
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
    from mitsplat.runtime.device import find_device
    from mitsplat.usd.usd_layers import is_usd

    with command_log(json_log, "render") as progress_bars:
        _refuse_ineffective(given_options(context), scene, only=only, engine=engine)
        overrides = scene_overrides(size=size, seed=seed, quality=quality, formats=formats)
        if out is None:
            out = Path("out") / (scene.stem if shard is None else f"{scene.stem}-{shard.replace('/', '-of-')}")
        chosen = find_device(device or "cpu") if engine == "local" else None
        if chosen is not None and not json_log:
            print_device(chosen)
        if scene.suffix == ".xml":
            from mitsplat.frames.mitsuba_xml import render_apart

            typer.echo(f"picture: {render_apart(scene, out, allow_outside=allow_outside, device=chosen)}")
            return
        if is_usd(scene):
            _render_stage(scene, out, frames, overrides, device=device or "cpu", overwrite=overwrite)
            return
        from mitsplat.dataset.shard_file import Shard
        from mitsplat.dataset.write import write_dataset
        from mitsplat.engine.ray import Cluster
        from mitsplat.scene.loading.scene_loading import load_scene

        part = None if shard is None else Shard.parse(shard)
        cluster = None
        if engine == "ray":
            cluster = Cluster(address, None if resources is None else Cluster.parse_resources(resources))
            cluster.on_device(device)  # raises if the device contradicts the cluster's resources
        if tolerance is not None:
            if quality is not None:
                raise InputError("--quality and --tolerance both select the preset: give only one")
            best = _fastest_preset(scene, tolerance, overrides, allow_outside, chosen, progress_bars)
            overrides = overrides | {"quality": best}
        loaded = load_scene(scene, overrides=overrides, allow_outside=allow_outside)
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
        if part is None and summary.frames > (wanted := loaded.num_frames if frames is None else frames):
            typer.echo(
                f"kept: all {summary.frames} images of {out}, although only {wanted} are asked for; --overwrite "
                "removes them and renders anew"
            )


def _refuse_ineffective(given: set[str], scene: Path, *, only: int | None, engine: str) -> None:
    """Raise InputError if a given option has no effect with the other options or on this kind of scene."""
    from mitsplat.usd.usd_layers import is_usd

    if only is not None:
        ineffective = given & {"--frames", "--shard", "--engine", "--workers", "--overwrite"}
        refuse_options(ineffective, "--only, which renders one image on this machine")
    if engine != "ray":
        refuse_options(given & {"--address", "--resources"}, "this machine: add --engine ray for a Ray cluster")
    given -= {"--out", "--device", "--json", "--allow-outside"}
    if scene.suffix == ".xml":
        refuse_options(given, f"the Mitsuba scene {scene}, which has its own size, seed and quality")
    elif is_usd(scene):
        refuse_options(given - {"--frames", "--size", "--format", "--quality", "--overwrite"}, f"the USD stage {scene}")


def _fastest_preset(
    scene: Path,
    tolerance: float,
    overrides: dict[str, object],
    allow_outside: bool,
    device: Device | None,
    progress_bars: Callable[[], AbstractContextManager[Progress]],
) -> str:
    """Measure the presets on a scene and return the fastest one within a tolerance."""
    from mitsplat.dataset.preflight import refuse, run_faults
    from mitsplat.frames.accuracy.speed_accuracy import choose_preset
    from mitsplat.scene.loading.scene_loading import load_scene

    loaded = load_scene(scene, overrides=overrides, allow_outside=allow_outside)
    refuse(loaded, run_faults(loaded))
    with progress_bars() as progress:
        best = choose_preset(
            scene, tolerance, overrides=overrides, allow_outside=allow_outside, progress=progress, device=device
        )
    typer.echo(f"preset: {best.name} (RMSE {best.rmse:.2g}, {best.seconds:.2f} s an image)")
    return best.name


def _render_stage(
    stage: Path, out: Path, times: int | None, overrides: Mapping[str, object], *, device: str, overwrite: bool
) -> None:
    """Render the cameras of a USD stage at its time codes, at most ``times``, to a labelled dataset."""
    if times is not None and times < 1:
        raise InputError(f"--frames must be 1 or more (got {times})")
    from tempfile import TemporaryDirectory

    from mitsplat.dataset.python_frames import write_frames
    from mitsplat.frames.sequence import render_frames
    from mitsplat.runtime.device import use_device
    from mitsplat.scene.layout import Layout
    from mitsplat.usd.stage_scene import read_stage_scene

    use_device(device)
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

    from mitsplat.dataset.preflight import count_faults, layout_faults, refuse, worker_faults
    from mitsplat.frames.settle_preview import certificate_table, write_preview
    from mitsplat.physics.settle import settle_layouts
    from mitsplat.scene.loading.scene_loading import load_scene

    loaded = load_scene(scene, overrides=scene_overrides(size=size), allow_outside=allow_outside)
    wanted = loaded.spec.output.layouts if layouts is None else layouts
    if not 1 <= wanted <= loaded.spec.output.layouts:
        raise InputError(
            f"--layouts must be 1 to {loaded.spec.output.layouts}, the scene's output.layouts (got {wanted})"
        )
    refuse(loaded, chain(count_faults(loaded), layout_faults(loaded), worker_faults(workers, wanted)))
    with Console(stderr=True).status("settling") as status:
        found = settle_layouts(loaded, range(wanted), workers=workers, progress=status.update)
        settled = sorted(found, key=lambda layout: layout.index)
    # Output to a file has 80 columns, which would truncate the headings to one or two letters.
    Console(width=max(Console().width, 120)).print(certificate_table(settled))
    for layout in settled:
        for one in layout.left_out:
            typer.echo(f"left out of layout {layout.index}: {loaded.assets[one.asset].name} ({one.reason})")
    if preview:
        pictures, again = write_preview(loaded, settled[0], out)
        typer.echo(f"drop: {out} ({pictures} pictures)")
        if again:
            typer.echo(f"dropped again, because they did not come to rest where they may: {', '.join(again)}")


def merge(
    shards: Annotated[
        list[Path], typer.Argument(metavar="SHARDS", help="Dataset folders with all shards of one dataset.")
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

    All images of a layout are in the same fold, and so are frames of equal poses that were made in Python. Classes are
    spread evenly over the folds as far as whole layouts allow. The test split is not used.
    """
    from mitsplat.dataset.folds import write_folds

    for number, fold in enumerate(write_folds(dataset, folds), start=1):
        counts = format_counts(fold.instances)
        typer.echo(f"fold{number}: validates with {fold.images} images of {fold.layouts} layouts ({counts})")


def _print_summary(summary: DatasetSummary, *, whole: bool = True) -> None:
    """Print a summary of a dataset.

    Raises:
        PartialResultError: If a complete dataset has no label at all. A shard may have none.
    """
    images = ", ".join(f"{count} {split}" for split, count in summary.images.items())
    typer.echo(f"dataset: {summary.path} ({images}; {sum(summary.instances.values())} labelled instances)")
    typer.echo(f"not labelled: {format_counts(summary.dropped)}; marked: {format_counts(summary.marked)}")
    if summary.incomplete:
        typer.echo(
            f"layouts without objects that did not come to rest: {summary.incomplete} "
            f"({format_counts(summary.left_out)})"
        )
    typer.echo(f"contact sheet: {summary.contact_sheet}")
    if summary.unlabelled and whole:
        raise PartialResultError(
            f"{summary.path}: no image has a label (not labelled: {format_counts(summary.dropped)}); "
            "run `mitsplat check` and `mitsplat preview` to see the view of the cameras"
        )
