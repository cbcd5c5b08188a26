"""Which lines of some modules each test runs, and how long the test takes.

A fault in a line can be noticed only by tests that run the line. What a fixture of several tests runs counts for each
of them; so does what a cache of the package or of the tests would keep from one test to the next.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from types import FrameType

import pytest

from night.mutants import Imported

Line = tuple[str, int]  # file and number


@dataclass
class Reach:
    """What the tests of a session reach, by their places in it.

    Attributes:
        lines: that each test runs.
        seconds: [s] that each test takes while its lines are noted.
        shared: [s] of these for fixtures of several tests, with the name of the first; 0 and "" without.
    """

    lines: list[set[Line]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    shared: list[tuple[float, str]] = field(default_factory=list)

    def tests(self, file: str, lines: range | None) -> list[int]:
        """Return the tests that run one of some lines, or all tests if none are known; the quickest first.

        Tests with a fixture in common stay together, so that it is made once.
        """
        wanted = None if lines is None else {(file, line) for line in lines}
        chosen = [test for test, ran in enumerate(self.lines) if wanted is None or wanted & ran]
        return sorted(chosen, key=lambda test: (*self.shared[test], self.seconds[test]))

    def cost(self, tests: list[int]) -> float:
        """Return the processor time of some tests and their fixtures [s]."""
        fixtures = {self.shared[test] for test in tests}
        return sum(self.seconds[test] for test in tests) + sum(seconds for seconds, _ in fixtures)


class Tracer:
    """A plugin of pytest that notes the lines of some files while tests run."""

    def __init__(self, files: Iterable[str], imported: Imported) -> None:
        self._files, self._imported = frozenset(files), imported
        self._now = set[Line]()
        self._fixtures: dict[str, tuple[float, set[Line]]] = defaultdict(lambda: (0.0, set()))

    def run(self, session: pytest.Session) -> Reach:
        """Run the tests of a session, until one fails, and return what they reach."""
        found = Reach()
        threading.settrace(self._enter)
        sys.settrace(self._enter)
        try:
            for item, following in zip(session.items, [*session.items[1:], None], strict=True):
                self._imported.clear_caches()
                self._now, begin = set(), time.process_time()
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                found.lines.append(self._now)
                found.seconds.append(time.process_time() - begin)
                if session.testsfailed:
                    break
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]
        for item, lines in zip(session.items, found.lines, strict=False):
            common = [name for name in getattr(item, "fixturenames", ()) if name in self._fixtures]
            for name in common:
                lines.update(self._fixtures[name][1])
            found.shared.append((sum(self._fixtures[name][0] for name in common), min(common, default="")))
        return found

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[object]) -> Iterator[None]:
        """Note apart what a fixture of several tests runs."""
        if fixturedef.scope == "function":
            return (yield)
        before, self._now, begin = self._now, set(), time.process_time()
        try:
            return (yield)
        finally:
            self._fixtures[fixturedef.argname] = time.process_time() - begin, self._now
            self._now = before | self._now

    def _enter(self, frame: FrameType, _event: str, _argument: object) -> object:
        return self._line if frame.f_code.co_filename in self._files else None

    def _line(self, frame: FrameType, event: str, _argument: object) -> object:
        if event == "line":
            self._now.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line
