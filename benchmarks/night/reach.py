"""Which lines of some modules each test runs, and how long the test takes.

A fault in a line can be noticed only by tests that run the line, they or their fixtures.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import NamedTuple


class Reached(NamedTuple):
    """What a test reaches."""

    lines: set[tuple[str, int]]  # files and numbers
    seconds: float  # of the processor, while lines are noted


class Reach:
    """What the tests of a session reach, by their places in it."""

    def __init__(self, found: list[Reached]) -> None:
        self._found = found

    def tests(self, file: str, lines: range | None) -> list[int]:
        """Return the tests that run one of some lines, or all tests if none are known; the quickest first."""
        wanted = None if lines is None else {(file, line) for line in lines}
        chosen = [test for test, found in enumerate(self._found) if wanted is None or wanted & found.lines]
        return sorted(chosen, key=lambda test: self._found[test].seconds)

    def cost(self, tests: list[int]) -> float:
        """Return the processor time of some tests with their fixtures [s]."""
        return sum(self._found[test].seconds for test in tests)


def traced(files: set[str], work: Callable[[], object]) -> Reached:
    """Do something, and return which lines of some files it runs."""
    lines = set()

    def note(frame, event, _argument):
        if event == "line":
            lines.add((frame.f_code.co_filename, frame.f_lineno))
        return note

    def enter(frame, _event, _argument):
        return note if frame.f_code.co_filename in files else None

    begin = time.process_time()
    threading.settrace(enter)
    sys.settrace(enter)
    work()
    sys.settrace(None)
    return Reached(lines, time.process_time() - begin)
