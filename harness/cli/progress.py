"""Progress bars of the commands."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text


class RateColumn(ProgressColumn):
    """Runs a second."""

    def render(self, task: Task) -> Text:
        """Return the text for `task`."""
        return Text("" if task.speed is None else f"{task.speed:.1f} runs/s")


def run_progress(console: Console, *further: ProgressColumn) -> Progress:
    """Return a bar with a description, counts and the time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        *further,
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )


@contextlib.contextmanager
def sweep_progress(console: Console, total: int, done: int) -> Iterator[Callable[[int], None]]:
    """Show a bar with throughput and time left; yield a function that is told how many more runs are done."""
    with run_progress(console, RateColumn()) as progress:
        bar = progress.add_task("running", total=total, completed=done)
        yield lambda count: progress.update(bar, advance=count)
