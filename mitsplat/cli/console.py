"""Output of commands: progress bars, machine-readable logs, findings and counts."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, NoReturn

import typer

from mitsplat.cli import fault
from mitsplat.errors import INTERRUPTED, exit_status
from mitsplat.progress import TIME_NOTE, Progress

if TYPE_CHECKING:
    from mitsplat.findings import Finding
    from mitsplat.runtime.device import Device

_CONTINUED = ("render", "merge", "train")
"""Commands that continue what an interrupted call has begun."""


def select_device(name: str) -> None:
    """Select the device for all later computation and print the reason for the choice of ``auto``."""
    from mitsplat.runtime.device import use_device  # most commands do not need it

    print_device(use_device(name))


def print_device(device: Device) -> None:
    """Print in one line the device that ``auto`` selected, and the reason."""
    if device.reason:
        typer.echo(f"device: {device}, because {device.reason}", err=True)


@contextmanager
def command_log(
    json_log: bool, command: str, unit: str = "images/s"
) -> Iterator[Callable[[], AbstractContextManager[Progress]]]:
    """Report the progress of a command, by bars or as a JSON log that also contains its errors.

    The log has the event started, any number of progress events, and then finished or failed. A failed event has the
    exit status and a sentence.

    Args:
        json_log: Write the log to stderr instead of bars.
        command: Name of the command in the log.
        unit: Unit of the speed that bars show.

    Yields:
        Function that returns a context manager for one progress callback.
    """
    interrupted = "interrupted"
    if command in _CONTINUED:
        interrupted += ": run the command again, without --overwrite, to continue"
    if not json_log:
        try:
            yield lambda: progress_bar(unit)
        except BaseException as error:
            if exit_status(error) == INTERRUPTED:
                typer.echo(f"mitsplat: {interrupted}", err=True)
            raise
        return

    def emit(event: str, **details: object) -> None:
        line = json.dumps({"time": round(time.time(), 3), "command": command, "event": event, **details})
        typer.echo(line, err=True)

    def progress(done: int, total: int, doing: str) -> None:
        emit("progress", done=done, total=total, doing=doing)

    emit("started")
    try:
        yield lambda: nullcontext(progress)
    except BaseException as error:
        if isinstance(error, typer.Exit) or (exit_status(error) is None and not isinstance(error, Exception)):
            raise
        status, sentence = fault.outcome_of(error)
        if status == INTERRUPTED:
            sentence = interrupted
        emit("failed", status=status, error=type(error).__name__, message=sentence)
        if status == INTERRUPTED:
            raise
        raise typer.Exit(status) from error
    emit("finished", status=0)


@contextmanager
def progress_bar(unit: str = "images/s") -> Iterator[Progress]:
    """Show a bar on stderr with the speed and the remaining time, from the first report on."""
    # Imported here because half of the commands and `--help` show no bar.
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

    text = TextColumn("{task.description}", markup=False)  # may hold names with brackets
    columns = (BarColumn(), MofNCompleteColumn(), RateColumn(), TimeRemainingColumn(), text)
    bar = Progress(*columns, console=Console(stderr=True), speed_estimate_period=300)
    task = bar.add_task("", total=None)

    def update(done: int, total: int, doing: str) -> None:
        # Frames of an earlier run and steps of an earlier stage must not count for the present speed.
        if bar.tasks[0].total != total or done < bar.tasks[0].completed:
            bar.reset(task, total=total, completed=done)
        bar.start()  # does nothing for a bar that is shown
        if doing.startswith(TIME_NOTE):
            bar.console.print(doing, markup=False, highlight=False, soft_wrap=True)
        else:
            bar.update(task, completed=done, description=doing)

    try:
        yield update
    finally:
        if bar.live.is_started:  # a command that fails early shows no empty bar
            bar.stop()


@contextmanager
def stage_bar(unit: str = "%/s") -> Iterator[Progress]:
    """Show progress in stages on stderr: a bar on a terminal, otherwise one line per stage.

    Without a terminal, a stage that takes longer prints one more line per minute, with the remaining time once a tenth
    of the stage is done. The text after a colon in the progress message is a detail and does not start a new stage.
    """
    if sys.stderr.isatty():
        with progress_bar(unit) as bar:
            yield bar
        return
    stage, stage_start, last_report, first = "", 0.0, 0.0, 0

    def emit(done: int, total: int, doing: str) -> None:
        nonlocal stage, stage_start, last_report, first
        now, left = time.monotonic(), ""
        if doing.partition(":")[0] != stage:
            stage, stage_start, first = doing.partition(":")[0], now, done
        elif now - last_report >= 60 and done > first:
            if done - first >= 0.1 * (total - first):
                left = f", {(now - stage_start) * (total - done) / (done - first):.0f} s left"
        else:
            return
        last_report = now
        typer.echo(f"{100 * done // total:3d} %: {doing}{left}", err=True)

    yield emit


def print_findings(findings: Iterable[Finding], mark: str) -> NoReturn:
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


def format_counts(counts: Mapping[str, int]) -> str:
    """Return the counts that are not zero with their keys, or "none"."""
    return ", ".join(f"{count} {reason}" for reason, count in counts.items() if count) or "none"
