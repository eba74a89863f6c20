"""Commands for detectors.

Each command imports its dependencies inside its function, so that all other commands start fast.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.console import command_log, format_counts
from mitsplat.cli.options import JsonLog, Seed, check_ending

if TYPE_CHECKING:
    from mitsplat.detector.likeness import Trait
    from mitsplat.storage.files import JsonObject

TorchDevice = Annotated[
    str,
    typer.Option(
        "--device", metavar="NAME", help="Device that computes: cpu, cuda, cuda:1, or auto (a GPU if there is one)."
    ),
]


def train(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASETS", help="Dataset folders with YOLO labels; the detector trains on all of them."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")],
    real: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Labelled photographs to mix in: a YOLO folder, a COCO folder or a dataset folder."
        ),
    ] = None,
    share: Annotated[float, typer.Option(help="Fraction of photographs in each batch, between 0 and 1.")] = 0.1,
    real_size: Annotated[
        int | None,
        typer.Option(
            help="Longer side of photographs at inference [px]; above --size, photographs are cut into "
            "tiles in which objects appear at that size."
        ),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="Ultralytics network: yolo11n-seg predicts masks, yolo11n boxes; the s and m variants are larger."
        ),
    ] = "yolo11n-seg.yaml",
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Initial weights (.pt); random by default.")
    ] = None,
    steps: Annotated[int, typer.Option(help="Number of training batches, independent of the number of images.")] = 1500,
    batch: Annotated[int, typer.Option(help="Number of images per batch.")] = 16,
    size: Annotated[int, typer.Option(help="Longer side of the images in training [px], a multiple of 32.")] = 640,
    mirror: Annotated[
        bool,
        typer.Option(
            help="Mirror half of the images left to right; switch it off for printed text or for left and right parts."
        ),
    ] = True,
    seed: Seed = 0,
    device: TorchDevice = "auto",
    workers: Annotated[
        int | None, typer.Option(help="Number of processes that read images; by default up to 8, and none on the cpu.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite/--resume", help="Replace the run in the folder, or continue it.")
    ] = False,
    json_log: JsonLog = False,
) -> None:
    """Train an Ultralytics detector on DATASETS.

    Nothing is downloaded: the initial weights are random or read from a file. Requires the extra `train`.
    """
    from mitsplat.detector.train_settings import TrainSettings
    from mitsplat.detector.training import train_detector

    settings = TrainSettings(
        model=model,
        weights=weights,
        steps=steps,
        batch=batch,
        size=size,
        share=share,
        real_size=real_size,
        mirror=mirror,
        seed=seed,
        device=device,
        workers=workers,
    )
    with command_log(json_log, "train", "steps/s") as progress_bars, progress_bars() as progress:
        run = train_detector(datasets, out, settings, real=real, overwrite=overwrite, progress=progress)
    done = run.record["finished"]
    if run.was_finished:
        typer.echo(f"run: {run.path} is already finished ({done['steps']} steps); --overwrite trains again")
    else:
        resumed = f", resumed at step {done['resumed_at_step']}" if done["resumed_at_step"] else ""
        typer.echo(
            f"run: {run.path} ({done['steps']} steps of {done['images_a_step']} images, {done['real_images_taken']} of "
            f"{done['images_taken']} real, {done['seconds']:.0f} s on {run.record['device']}{resumed})"
        )
    typer.echo(f"weights: {run.weights}")


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of a finished `mitsplat train`.")],
    data: Annotated[
        Path,
        typer.Argument(metavar="DATASET", help="Labelled images: a dataset folder, a YOLO folder or a COCO folder."),
    ],
    split: Annotated[
        Literal["train", "val", "test", "all"], typer.Option(help="Split of the images to evaluate on.")
    ] = "val",
    size: Annotated[
        int | None,
        typer.Option(help="Longer side of the images at inference [px]; by default the size used in training."),
    ] = None,
    device: TorchDevice = "auto",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder to write; evaluation/<name of DATASET>-<split> in RUN by default."),
    ] = None,
    json_log: JsonLog = False,
) -> None:
    """Evaluate a trained detector on labelled images.

    The command prints the average precision by the rules of COCO and writes a page. The page shows precision-recall
    curves, confusions between classes, and the images with the worst results.
    """
    from mitsplat.detector.detector_evaluation import evaluate_detector

    with command_log(json_log, "evaluate") as progress_bars, progress_bars() as progress:
        found = evaluate_detector(run, data, out, split=split, size=size, device=device, progress=progress)
    kinds = {kind: words for kind, words in (("box", "boxes"), ("mask", "masks")) if kind in found.results}
    for kind, words in kinds.items():
        typer.echo(f"{words}: {_format_scores(found.results[kind])}")
    for name, count in found.results["data"]["instances"].items():
        scores = {words: found.results[kind]["classes"].get(name) for kind, words in kinds.items()}
        texts = [f"{score['ap50_95']:.3f} ({words})" for words, score in scores.items() if score]
        typer.echo(f"  {name}: {count} labelled" + (f", AP50-95 {', '.join(texts)}" if texts else ""))
    typer.echo(f"report: {found.page}")


def compare(
    datasets: Annotated[list[Path], typer.Argument(metavar="DATASETS", help="Folders of rendered datasets.")],
    photographs: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS", help="Labelled photographs: a YOLO folder, a COCO folder or a dataset folder."
        ),
    ],
    split: Annotated[
        Literal["train", "val", "test", "all"], typer.Option(help="Split of the rendered images to measure.")
    ] = "train",
    size: Annotated[int, typer.Option(help="Longer side of the images when they are measured [px].")] = 640,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="JSON file for the measured values.")
    ] = None,
    json_log: JsonLog = False,
) -> None:
    """Compare rendered images with labelled photographs.

    The command compares the brightness, colours, size and number of objects, and the brightness and noise of images,
    in total and per class. Labels of classes that only one side has are not compared, but counted by class. Where
    photographs lie outside the range of the rendered images, the output suggests a change to the scene.
    """
    from mitsplat.detector.likeness import compare_with_photographs
    from mitsplat.storage.files import write_text

    check_ending(out, ".json")
    with command_log(json_log, "compare") as progress_bars, progress_bars() as progress:
        found = compare_with_photographs(datasets, photographs, split=split, size=size, progress=progress)
    for side, other, counts, skipped in (
        ("rendered images", "photographs", found.only_rendered, found.skipped[0]),
        ("photographs", "rendered images", found.only_photographed, found.skipped[1]),
    ):
        if counts:
            typer.echo(
                f"not compared: labels in {side} of classes that {other} do not have: {format_counts(counts)}"
                + (f"; {skipped} {side} have no other labels and are left out" if skipped else "")
            )
    typer.echo(f"{found.images} rendered images, {found.photographs} photographs; 5 %, median and 95 %:")
    for trait in found.traits:
        _print_trait(trait.name, trait)
    for name, traits in found.classes.items():
        for trait in traits:
            if trait.advice:
                _print_trait(f"{name}: {trait.name}", trait)
    if found.hues:
        turned = sorted(found.hues.values())
        typer.echo(
            f"hues of {len(turned)} classes: photographs differ by {turned[0]:+.0f} to {turned[-1]:+.0f} degrees, "
            f"median {statistics.median(turned):+.0f}"
        )
        if found.hue_advice:
            typer.echo(f"  {found.hue_advice}")
    if found.same_size is not None and found.same_sizes is not None:
        least, most = found.same_sizes
        typer.echo(
            f"objects in photographs of {found.same_size} px are as large as in rendered images of {size} px "
            f"({least} to {most} px by class): "
            f"`mitsplat evaluate --size {found.same_size}`"
            + (f", `mitsplat train --size {size} --real-size {found.same_size}`" if found.same_size > size else "")
        )
    if out is not None:
        write_text(out, json.dumps(asdict(found), indent=1) + "\n")
        typer.echo(f"measurements: {out}")


def _print_trait(name: str, trait: Trait) -> None:
    sides = "; ".join(
        f"{words} {values[0]:.0f} {values[1]:.0f} {values[2]:.0f}"
        for words, values in (("rendered", trait.rendered), ("photographs", trait.real))
    )
    typer.echo(f"{name}{f' [{trait.unit}]' if trait.unit else ''}: {sides}")
    if trait.advice:
        typer.echo(
            f"  photographs: {trait.below:.0%} below, {trait.above:.0%} above the rendered range: {trait.advice}"
        )


def _format_scores(score: JsonObject) -> str:
    if score["map50"] is None:
        return "no labels except crowds"
    return f"mAP50-95 {score['map50_95']:.3f}, mAP50 {score['map50']:.3f}"
