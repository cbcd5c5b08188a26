"""What the commands that run batches show on their way."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

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
from rich.status import Status
from rich.text import Text

from servobench.harness.batch.campaign import Observer, Row
from servobench.harness.cli.options import INTERRUPTED


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


class ConsoleObserver(Observer):
    """Shows what happens before the runs as a line, then a bar with throughput and time left.

    Args:
        console: where.
        bar: false where a debugger may need the terminal.
    """

    def __init__(self, console: Console, *, bar: bool = True) -> None:
        self._console, self._shows_bar = console, bar
        self._status: Status | None = console.status("checking the configuration")
        self._status.start()
        self._bar: Progress | None = None

    def training(self, share: float, what: str) -> None:
        """Show how much of a training of networks is done."""
        if self._status is not None:
            self._status.update(f"training networks once: {100 * share:3.0f} %, {what}")

    def begin(self, total: int, done: int) -> None:
        """Show the bar."""
        self.close()
        if not self._shows_bar:
            return
        self._bar = run_progress(self._console, RateColumn())
        self._bar.add_task("running", total=total, completed=done)
        self._bar.start()

    def finished(self, rows: Sequence[Row]) -> None:
        """Advance the bar."""
        if self._bar is not None:
            self._bar.advance(self._bar.task_ids[0], len(rows))

    def note(self, text: str) -> None:
        """Print a line."""
        self._console.print(text, soft_wrap=True)

    def close(self) -> None:
        """Take line and bar away."""
        for shown in (self._status, self._bar):
            if shown is not None:
                shown.stop()
        self._status = self._bar = None


@contextlib.contextmanager
def watching(console: Console, folder: Path, *, bar: bool = True) -> Iterator[Observer]:
    """Yield an observer for one campaign; after Ctrl-C one line says how to continue.

    Args:
        console: where it shows the progress.
        folder: what the user named with --out.
        bar: see `ConsoleObserver`.
    """
    observer = ConsoleObserver(console, bar=bar)
    try:
        yield observer
    except KeyboardInterrupt:
        observer.close()
        if folder.exists():
            sys.stderr.write(
                f"servobench: interrupted; finished runs are kept in {folder}, the same call with --resume continues\n"
            )
            raise SystemExit(INTERRUPTED) from None
        raise
    finally:
        observer.close()
