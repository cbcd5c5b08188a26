"""The console that all commands print to, and tables on it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import weakref
from collections.abc import Iterable, Iterator
from itertools import takewhile
from textwrap import wrap
from typing import TYPE_CHECKING, NoReturn

from rich.console import Console

from servobench.plant.contract.files import harmless

if TYPE_CHECKING:
    from types import FrameType

    import pandas as pd

FAILED = 1  # exit code where a run failed, a check was not passed or answers are different
INPUT_ERROR = 2  # exit code
INTERRUPTED = 130  # exit code after Ctrl-C
SOON = 0.05  # [s] until an interrupt comes again that was lost

# The first columns, by which a row is known.
KEYS = ("controller", "mismatch", "noise factor", "latency [ms]", "period [ms]", "A − B")
LEFT = (*KEYS, "failures", "outcome")  # columns of words
WHOLE = ("controller", "A − B")  # columns whose cells are not broken over lines
CONTROLLER_WIDTH = 15  # [characters] at least, so that tables below each other begin alike
GAP = 2  # [characters] that a table needs for each column beside its cells


class Terminal(Console):
    """A console whose command goes on if nobody reads its output any more."""

    def on_broken_pipe(self) -> None:
        """Print no more; figures and reports are made all the same."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if (
    os.environ.get("COLUMNS", "").strip("0") == ""
):  # as some programs tell their children: no line would be printed
    os.environ.pop("COLUMNS", None)
console = Terminal(emoji=False)  # `pixel:hand:` is none


class _Interrupt(KeyboardInterrupt):
    """What a signal raises; other than a usual `KeyboardInterrupt`, it can be referred to weakly."""


@contextlib.contextmanager
def ending_alike() -> Iterator[list[int]]:
    """Let SIGTERM and SIGHUP end the command as Ctrl-C does, such that nothing half written and no process is left.

    One of them that was ignored on entry, as below nohup, stays ignored. An interrupt that is lost comes again: Python
    drops those of destructors, and compiled code (numpy, for instance) clears those that reach it where it tries
    something out. Whoever catches one therefore ends the command before leaving its `except`. The exit code is that of
    the signal.

    Yields:
        The signals that came.
    """
    caught = []
    raised = []
    hook = sys.unraisablehook

    def interrupt(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        handler = signal.getsignal(signal.SIGINT)
        # That of asyncio, while its loop runs, raises nothing amid a task.
        if callable(handler) and handler != interrupt:
            handler(signal.SIGINT, frame)
            return
        raise_interrupt()

    def raise_interrupt() -> None:
        error = _Interrupt()
        raised.append(weakref.ref(error))
        signal.setitimer(signal.ITIMER_REAL, SOON)
        try:
            raise error
        finally:
            del error  # or its own traceback keeps it alive

    def is_lost() -> bool:
        # One that is on its way, or that a handler or clean-up was called for, is alive.
        return bool(raised) and raised[-1]() is None

    def raise_lost_again(_number: int, _frame: FrameType | None) -> None:
        if is_lost():
            raise_interrupt()
        signal.setitimer(signal.ITIMER_REAL, SOON)

    def report(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not _Interrupt:
            hook(unraisable)

    handlers = {signal.SIGINT: interrupt, signal.SIGALRM: raise_lost_again}
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            handlers[number] = interrupt
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    sys.unraisablehook = report
    try:
        yield caught
    except (SystemExit, KeyboardInterrupt) as stop:
        ended = isinstance(stop, SystemExit) and stop.code != INTERRUPTED
        if ended and not is_lost():
            raise
        raise SystemExit(128 + (caught or [signal.SIGINT])[0]) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def interrupting_as_usual() -> Iterator[None]:
    """Give Ctrl-C its usual handler, by which `asyncio.run` knows that it may put its own in place of it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def print_rows(headings: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a table of text with lines around it."""
    from rich.table import Table

    table = Table(*headings)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def print_tables(tables: Iterable[tuple[str, pd.DataFrame]], legend: str = "") -> None:
    """Print tables of text with their titles, and a legend below all of them.

    Cells are broken between words where a table is wider than the terminal. Columns for which there is no room even so
    follow in a table of their own below, after the columns by which a row is known.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    for title, given in tables:
        rows = given.map(harmless).rename(columns=harmless)
        for number, widths in enumerate(_fit(rows, console.width)):
            table = Table(
                title=None if number else Text(harmless(title)), title_justify="left", box=SIMPLE_HEAD, pad_edge=False,
                padding=(0, 1, 0, 0),
            )  # fmt: skip
            for name, width in widths.items():
                table.add_column(
                    Text(name),
                    justify="left" if name in LEFT else "right",
                    width=width,
                    overflow="fold",
                )
            for row in rows[list(widths)].itertuples(index=False):
                table.add_row(*map(Text, row))
            console.print(table)
    if legend:
        console.print(legend, markup=False, highlight=False)


def _fit(rows: pd.DataFrame, room: int) -> Iterator[dict[str, int]]:
    """Yield the columns of each table that rows are printed as, with their widths [characters]."""
    least, whole = dict[str, int](), dict[str, int]()
    for name in rows.columns:
        lines = [line for cell in (name, *rows[name]) for line in str(cell).splitlines()]
        words = lines if name in WHOLE else [word for line in lines for word in line.split()]
        least[name] = max([CONTROLLER_WIDTH * (name == "controller"), *map(len, words)])
        whole[name] = max([least[name], *map(len, lines)])
    names = [str(name) for name in rows.columns]
    keys = list(takewhile(KEYS.__contains__, names)) or names[:1]
    # In a sweep rows are told apart by further columns, of settings that are varied.
    further = (names[:end] for end in range(len(keys), len(names)))
    keys = next((each for each in further if not rows[each].duplicated().any()), keys)
    part = list(keys)
    for name in names[len(keys) :]:
        if len(part) > len(keys) and sum(least[each] + GAP for each in (*part, name)) > room:
            yield _shares(rows[part], least, whole, room)
            part = list(keys)
        part.append(name)
    yield _shares(rows[part], least, whole, room)


def _shares(
    rows: pd.DataFrame, least: dict[str, int], whole: dict[str, int], room: int
) -> dict[str, int]:
    """Return the widths of columns in one table: the widest give way first, and those of most lines get the rest."""
    names, cells = list(rows.columns), {name: (name, *rows[name]) for name in rows.columns}
    widths = {name: whole[name] for name in names}
    for most in range(max(widths.values()), 0, -1):
        if sum(widths.values()) + GAP * len(names) <= room:
            break
        widths = {name: max(least[name], min(whole[name], most)) for name in names}
    for _ in range(room - sum(widths.values()) - GAP * len(names)):
        lines = {name: max(len(wrap(cell, widths[name])) for cell in cells[name]) for name in names}
        highest = max(names, key=lambda name: lines[name] * (widths[name] < whole[name]))
        widths[highest] += widths[highest] < whole[highest]
    return widths


def end_interrupted(kept: str, going_on: str) -> NoReturn:
    """End the command after Ctrl-C with a line: the results that are kept, and the call that goes on."""
    sys.stderr.write(f"servobench: interrupted: {kept}; {going_on}\n")
    raise SystemExit(INTERRUPTED)


def say(line: str) -> None:
    """Print a line as it is, however long: it may hold names, paths and brackets of users. An empty one is left out."""
    if line:
        console.print(harmless(line), soft_wrap=True, markup=False, highlight=False)


def print_json(value: object) -> None:
    """Print a value as JSON."""
    say(json.dumps(value, indent=2, ensure_ascii=False))


def print_markdown(tables: Iterable[tuple[str, pd.DataFrame]]) -> None:
    """Print tables of text as Markdown."""
    for title, rows in tables:
        lines = [
            f"{title}:",
            "",
            "| " + " | ".join(rows.columns) + " |",
            "|---" * len(rows.columns) + "|",
        ]
        lines += ["| " + " | ".join(row) + " |" for row in rows.itertuples(index=False)]
        say("\n".join(lines) + "\n")
