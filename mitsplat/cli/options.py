"""What commands share: options of assets, the seed, the bar or log of how far they are, and logs for machines."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mitsplat.cli import fault
from mitsplat.errors import InputError, exit_status, sentence_of
from mitsplat.progress import Progress

if TYPE_CHECKING:
    from mitsplat.runtime.device import Device

DeviceName = Annotated[
    str,
    typer.Option(
        "--device", metavar="NAME", help="Render on the cpu, or on a GPU: cuda, cuda:1, or auto if there is one."
    ),
]

Name = Annotated[str | None, typer.Option(help="Name of the asset; the folder's if absent.")]
ClassName = Annotated[str | None, typer.Option("--class", help="Class to learn; the name if absent.")]
Kind = Annotated[Literal["object", "environment"], typer.Option(help="Whether physics moves it.")]
AssetFolder = Annotated[Path, typer.Option("--out", "-o", help="Asset folder to write.")]
ShDegree = Annotated[int, typer.Option(help="Degree of the spherical harmonics, 0 to 3.")]
Faces = Annotated[int, typer.Option(help="Most faces of the mesh.")]

Seed = Annotated[int, typer.Option(help="Decides everything that is random.")]

JsonLog = Annotated[
    bool,
    typer.Option("--json", help="Log to stderr for machines: an event a line, as a JSON object, instead of a bar."),
]


def check_ending(out: Path | None, *endings: str) -> None:
    """Refuse a file that is to be written, and ends otherwise."""
    if out is not None and out.suffix.lower() not in endings:
        raise InputError(f"--out must end in {' or '.join(endings)} (got {out})")


def check_place(out: Path, *endings: str) -> None:
    """Refuse such a file, and one in a folder that is not there."""
    check_ending(out, *endings)
    if not out.parent.is_dir():
        raise InputError(f"--out must be in a folder that exists (got {out})")


def check_new(out: Path, *endings: str, overwrite: bool) -> None:
    """Refuse such a file, and one that is there, unless it is to be replaced."""
    check_ending(out, *endings)
    if out.exists() and not (overwrite and out.is_file()):
        raise InputError(f"--out must be a new file (got {out}); --overwrite replaces one")


def take_device(name: str) -> None:
    """Compute on a device from now on; why ``auto`` chose it is said."""
    from mitsplat.runtime.device import use_device  # most commands do without

    tell_device(use_device(name))


def tell_device(device: Device) -> None:
    """Say in one line which device ``auto`` chose, and why."""
    if device.reason:
        typer.echo(f"device: {device}, as {device.reason}", err=True)


@contextmanager
def command_log(
    json_log: bool, command: str, unit: str = "images/s"
) -> Iterator[Callable[[], AbstractContextManager[Progress]]]:
    """How a command shows its progress: by bars, or as a log for machines, which then holds its errors too.

    The log's events are started, progress, then finished, or failed with the exit status and a sentence.
    """
    if not json_log:
        yield lambda: progress_bar(unit)
        return

    def tell(event: str, **details: Any) -> None:
        line = json.dumps({"time": round(time.time(), 3), "command": command, "event": event, **details})
        typer.echo(line, err=True)

    def progress(done: int, total: int, doing: str) -> None:
        tell("progress", done=done, total=total, doing=doing)

    tell("started")
    try:
        yield lambda: nullcontext(progress)
    except BaseException as error:
        status = exit_status(error)
        if isinstance(error, typer.Exit) or (status is None and not isinstance(error, Exception)):
            raise
        if status == 130:
            tell("failed", status=130, error=type(error).__name__, message="interrupted: run again to go on")
            raise
        sentence = fault.tell_fault(error) if status is None else sentence_of(error)
        status = fault.STATUS if status is None else status
        tell("failed", status=status, error=type(error).__name__, message=sentence)
        raise typer.Exit(status) from error
    tell("finished", status=0)


@contextmanager
def progress_bar(unit: str = "images/s") -> Iterator[Progress]:
    """A bar on stderr with speed and the time left."""
    # Not at the top: half of the commands show no bar, and `--help` none.
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


@contextmanager
def stage_bar(unit: str = "%/s") -> Iterator[Progress]:
    """A bar on stderr with the time left where that is a terminal, else a line for every stage, and one a minute in it.

    What follows a colon in what is being done is of the moment, and no other stage. Lines within one tell what time is
    left.
    """
    if sys.stderr.isatty():
        with progress_bar(unit) as bar:
            yield bar
        return
    stage, begun, told, first = "", 0.0, 0.0, 0

    def tell(done: int, total: int, doing: str) -> None:
        nonlocal stage, begun, told, first
        now, left = time.monotonic(), ""
        if doing.partition(":")[0] != stage:
            stage, begun, first = doing.partition(":")[0], now, done
        elif now - told >= 60 and done > first:
            left = f", {(now - begun) * (total - done) / (done - first):.0f} s left"
        else:
            return
        told = now
        typer.echo(f"{100 * done // total:3d} %: {doing}{left}", err=True)

    yield tell
