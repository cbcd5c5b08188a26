"""The runs of a comparison: every plant with every controller, task, mismatch and seed; and which seeds are for what.

A run's seed decides its true robot, its task and its noise. Methods are tuned on the seeds `TUNING` and judged on all
others, so that no method is judged by a robot on which it was tuned.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from textwrap import shorten
from typing import Any, Final

from servobench.harness.batch.grid import Grid
from servobench.harness.config.robots import DEFAULT_ROBOT
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.request import RunRequest, read_mismatch
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.robot.mismatch import Mismatch

MAX_SEEDS: Final = 1_000_000  # of a batch
MAX_SEED: Final = 2**63 - 1  # which the tables hold
MAX_SHOWN: Final = 200  # [characters] of what was given, in a message
TUNING: Final = range(10_000, 20_000)  # seeds of `servobench tune`; all others are for judging


@dataclass(frozen=True)
class Batch:
    """All combinations of these."""

    plants: tuple[str, ...]
    controllers: tuple[str, ...]
    tasks: tuple[str, ...]
    mismatches: tuple[str, ...]
    seeds: Sequence[int]
    robot: str = DEFAULT_ROBOT
    """a name or the path of a file; all runs of a batch have one"""
    sensings: tuple[str, ...] = (DEFAULT_SENSING,)

    def requests(self) -> Grid[RunRequest]:
        """Return the runs, seeds varying fastest."""
        return Grid(partial(_request, self.robot), *self.axes())

    def axes(self) -> tuple[Sequence[Any], ...]:
        """Return sensing set-ups, plants, tasks, mismatches, controllers and seeds."""
        mismatches = [read_mismatch(text) for text in self.mismatches]
        return self.sensings, self.plants, self.tasks, mismatches, self.controllers, self.seeds


def _request(
    robot: str, sensing: str, plant: str, task: str, mismatch: Mismatch, controller: str, seed: int
) -> RunRequest:
    return RunRequest(plant, controller, task, mismatch, seed, robot=robot, sensing=sensing)


def parse_seeds(text: str) -> Sequence[int]:
    """Return the seeds that `text` names: a count `5`, a list `3,1,4`, or a range `100:120` (end not included).

    Raises:
        ConfigurationError: none of these, or empty.
    """
    came = f"got {shorten(repr(text), MAX_SHOWN, placeholder=' ...')}"
    try:
        if ":" in text:
            begin, end = (int(part) for part in text.split(":"))
            seeds: Sequence[int] = range(begin, max(begin, end))
        elif "," in text:
            seeds = tuple(int(part) for part in text.split(",") if part.strip())
        else:
            seeds = range(max(0, int(text)))
    except ValueError as error:
        raise ConfigurationError(f"seeds must be a count (5), a list (3,1,4) or a range (100:120), {came}") from error
    if isinstance(seeds, range):
        first, last = seeds.start, seeds.stop - 1
    else:
        first, last = min(seeds, default=-1), max(seeds, default=-1)
    if first < 0 or last < first:
        raise ConfigurationError(f"seeds must name at least one seed, none of them negative; {came}")
    if last > MAX_SEED:
        raise ConfigurationError(f"seeds must be at most {MAX_SEED}, {came}")
    if len(seeds) > MAX_SEEDS:
        raise ConfigurationError(f"seeds must name at most {MAX_SEEDS:,}, {came}; use several folders for more")
    for seed, count in Counter(seeds).items() if isinstance(seeds, tuple) else ():
        if count > 1:
            raise ConfigurationError(f"seeds name {seed} twice, {came}")
    return seeds


def tuning_seeds(count: int, offset: int = 0) -> tuple[int, ...]:
    """Return `count` seeds of the tuning range that begin `offset` after its first.

    Raises:
        ConfigurationError: fewer than one, or some of them outside the range.
    """
    if count < 1:
        raise ConfigurationError(f"the number of tuning seeds must be at least 1, got {count}")
    if offset < 0 or offset + count > len(TUNING):
        raise ConfigurationError(
            f"{count} seeds from {TUNING.start + offset} on leave the tuning range {_words()}; "
            f"count and offset must not be negative and together at most {len(TUNING)}"
        )
    return tuple(TUNING[offset : offset + count])


def refuse_tuning_seeds(seeds: Iterable[int]) -> None:
    """Refuse to judge methods by robots on which they were tuned.

    Raises:
        ConfigurationError: names the first seed of the tuning range and says what to take instead.
    """
    found = [seed for seed in seeds if seed in TUNING]
    if found:
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        raise ConfigurationError(
            f"seed {found[0]}{more} cannot be used to judge: {_words()} are kept for tuning; "
            f"take seeds below {TUNING.start} or from {TUNING.stop} on"
        )


def _words() -> str:
    return f"{TUNING.start}:{TUNING.stop}"
