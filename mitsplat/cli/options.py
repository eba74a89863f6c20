"""What commands share: the seed, and the bar that shows how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

Seed = Annotated[int, typer.Option(help="Decides everything that is random.")]


@contextmanager
def progress_bar(unit: str = "images/s") -> Iterator[Callable[[int, int, str], None]]:
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
