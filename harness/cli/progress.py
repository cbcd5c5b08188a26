"""Progress of long commands: bars in a terminal, elsewhere a line now and then on standard error."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich import progress
from rich.console import Console
from rich.text import Text

from servobench.harness.batch.campaign import Execution, Observer
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.cli.terminal import end_interrupted
from servobench.harness.run.variations import Row
from servobench.plant.contract.files import harmless

MANY_RUNS = 10_000  # from which on their number and time are told first
# [s] to the first line, and from line to line at least; [1] of the time so far
FIRST_LINE, LINE_SHARE = (5.0, 0.1)


def show_time(seconds: float) -> str:
    """Return a time [s] in words, in the largest unit of which there are two or more."""
    for unit, size in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


class Lines:
    """Progress as few lines on standard error, for pipes and files, in which a bar is no use."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._began = clock, clock()
        self._due = self._began + FIRST_LINE

    def tell(self, share: float, text: str) -> None:
        """Write a line with the time left, unless one was written a moment ago.

        Args:
            share: how much is done, from 0 to 1.
            text: the line, without the time left.
        """
        now = self._clock()
        if now < self._due:
            return
        so_far = now - self._began
        left = ""
        if 0.0 < share < 1.0:
            left = f", about {show_time(so_far * (1.0 - share) / share)} left"
        sys.stderr.write(f"{text}{left}\n")
        sys.stderr.flush()
        self._due = now + max(FIRST_LINE, LINE_SHARE * so_far)


@contextlib.contextmanager
def telling(console: Console, begin: str) -> Iterator[Callable[[float, str], None]]:
    """Yield a function that shows the finished share of a task, and its name.

    Args:
        console: place of the line, if that is a terminal.
        begin: first line.
    """
    lines = Lines()
    with console.status(begin) as status:

        def tell(share: float, task: str) -> None:
            text = f"{task}: {100 * share:.0f} %"
            status.update(text)
            if not console.is_terminal:
                lines.tell(share, text)

        yield tell


class RateColumn(progress.ProgressColumn):
    """Runs a second."""

    def render(self, task: progress.Task) -> Text:
        """Return the text for `task`."""
        return Text("" if task.speed is None else f"{task.speed:.1f} runs/s")


class Bars(progress.Progress):
    """Work of known size: bars with counts and the time left in a terminal, elsewhere a line now and then.

    Args:
        console: where.
        further: columns behind the counts.
        shown: false where a debugger may need the terminal.
    """

    def __init__(
        self, console: Console, *further: progress.ProgressColumn, shown: bool = True
    ) -> None:
        counts = (
            progress.TextColumn("{task.description}"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
        )
        times = (
            progress.TimeElapsedColumn(),
            progress.TextColumn("left"),
            progress.TimeRemainingColumn(),
        )
        shown = shown and console.is_terminal
        super().__init__(*counts, *further, *times, console=console, disable=not shown)
        self._lines, self._begun = Lines(), 0

    def begin(self, name: str, total: int, done: int = 0, **fields: Any) -> progress.TaskID:  # noqa: ANN401 - those of rich
        """Begin a bar; `fields` are for the further columns."""
        self._begun += done
        return self.add_task(name, total=total, completed=done, **fields)

    def reach(self, bar: progress.TaskID, done: int, text: str, **fields: Any) -> None:  # noqa: ANN401 - those of rich
        """Move a bar; `text` is the line where there are none."""
        self.update(bar, completed=done, **fields)
        if not self.console.is_terminal:
            missing = sum((task.total or 0.0) - task.completed for task in self.tasks)
            finished = sum(task.completed for task in self.tasks) - self._begun
            self._lines.tell(finished / max(finished + missing, 1.0), text)


class ConsoleObserver(Observer):
    """Shows the work before the runs as a line, then a bar with throughput and time left.

    Args:
        console: where.
        bar: false where a debugger may need the terminal.

    Attributes:
        done: finished runs.
        total: all runs.
        finished_in_all: finished runs of all batches so far.
        wanted_in_all: number of all runs of these batches.
    """

    def __init__(self, console: Console, *, bar: bool = True) -> None:
        self._console, self._shows_bar, self._shown = console, bar, contextlib.ExitStack()
        self._tell = self._shown.enter_context(telling(console, "checking the configuration"))
        self.done = self.total = 0
        self.finished_in_all = self.wanted_in_all = 0
        self._is_told = False

    def training(self, share: float, subject: str) -> None:
        """Show how much of a training of networks is done."""
        self._tell(share, f"training networks once, {subject}")

    def begin(self, total: int, done: int) -> None:
        """Show the bar."""
        self.close()
        self.done, self.total = done, total
        self.finished_in_all += done
        self.wanted_in_all += total
        self._began = time.monotonic()
        self._first = done
        if total - done >= MANY_RUNS:
            self.note(f"{total - done:,} runs begin; Ctrl-C ends them, and --resume goes on")
        self._bars = self._shown.enter_context(
            Bars(self._console, RateColumn(), shown=self._shows_bar)
        )
        self._bar = self._bars.begin("running", total, done)
        if done == total:
            self.close()

    def finished(self, rows: Sequence[Row]) -> None:
        """Advance the bar."""
        self.done += len(rows)
        self.finished_in_all += len(rows)
        self._expect()
        self._bars.reach(self._bar, self.done, f"{self.done} of {self.total} runs")
        if self.done == self.total:
            self.close()

    def _expect(self) -> None:
        """Print once how long many runs will take, after a few seconds of them."""
        so_far = time.monotonic() - self._began
        finished = self.done - self._first
        missing = self.total - self.done
        if missing < MANY_RUNS or not finished or so_far < FIRST_LINE or self._is_told:
            return
        self._is_told = True
        self.note(f"{missing:,} runs are left, about {show_time(so_far / finished * missing)}")

    def note(self, text: str) -> None:
        """Print a line."""
        self._console.print(harmless(text), soft_wrap=True, markup=False, highlight=False)

    def close(self) -> None:
        """Take line and bar away."""
        self._shown.close()


@contextlib.contextmanager
def watching(console: Console, folder: Path, how: Execution) -> Iterator[Execution]:
    """Yield how runs are carried out, with their progress shown; a line says how many there are, or how to go on.

    Args:
        console: where it shows the progress.
        folder: the folder of --out.
        how: how runs are carried out.
    """
    observer = ConsoleObserver(console, bar=not how.debug)
    try:
        yield replace(how, observer=observer)
        if observer.wanted_in_all > 1:
            observer.note(f"{observer.finished_in_all} of {observer.wanted_in_all} runs are there")
    except KeyboardInterrupt:
        observer.close()
        done = observer.done
        if any(folder.rglob("*.parquet")):
            # A last one may be untold
            done = max(done, sum(map(len, ResultsFolder(folder).finished_runs())))
        if done == 0:
            raise
        kept = f"{done} of {max(done, observer.total)} runs are finished and kept in {folder}"
        end_interrupted(kept, "the same call with --resume and this --out continues")
    finally:
        observer.close()
