"""The check of tuned values: on the second set of robots no change of one value may improve the score by much.

The changes are those of the coordinate search: each other value of each switch, and 20 % more and less of each number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from servobench.harness.batch.workers import Workers
from servobench.harness.config.defaults import default_config
from servobench.harness.studies.tuning.campaign import make_folder
from servobench.harness.studies.tuning.ledger import Ledger
from servobench.harness.studies.tuning.objective import TuningSet, score
from servobench.harness.studies.tuning.scoring import SECOND, Wanted, fill, open_ledger, refuse_broken_defaults
from servobench.harness.studies.tuning.search import neighbours
from servobench.harness.studies.tuning.spaces import Point, find_space, find_tunable, nested_settings, values_of

TOLERANCE: Final = 0.03  # [1] share of the score by which no change may improve it


@dataclass(frozen=True)
class Change:
    """A change of one value of a method's settings in use, and what came of it."""

    controller: str
    key: str
    before: Any
    after: Any
    score_before: float
    score_after: float

    @property
    def gain(self) -> float:
        """Share of the score that the change gains; negative if it loses."""
        return 1.0 - self.score_after / self.score_before


class Check:
    """The settings in use of some methods with all their changes, on one set of runs."""

    def __init__(self, folder: Path, controllers: Sequence[str], runs: TuningSet, keys: Sequence[str] = ()) -> None:
        """Open the ledgers, in which a check goes on where it stopped.

        Args:
            folder: of the ledgers; made if needed.
            controllers: names of methods with a search space.
            runs: the runs on which changes are judged.
            keys: the keys that are changed; none for all.

        Raises:
            ConfigurationError: a name or a file that cannot be used.
        """
        make_folder(folder)
        self._runs = runs
        self._changes: list[tuple[Ledger, str, str, Point, Point]] = []
        for name in controllers:
            refuse_broken_defaults(name, runs)
            ledger = open_ledger(folder, name, runs, SECOND)
            space, values = find_space(name), values_of(name, default_config(find_tunable(name)))
            self._changes += [
                (ledger, name, key, values, other)
                for key, other in neighbours(space, values)
                if (not keys or key in keys) and nested_settings(other) != nested_settings(values)
            ]

    def __len__(self) -> int:
        """Return the number of points to score, those known already included."""
        return len(self._scored())

    def known(self) -> int:
        """Return how many of the points the ledgers know."""
        return sum(self._scored().values())

    def _scored(self) -> dict[str, bool]:
        """Return whether a point is known, for each."""
        points = [(ledger, name, nested_settings(point)) for ledger, name, point in self._points()]
        return {f"{name}{nested}": ledger.costs(nested) is not None for ledger, name, nested in points}

    def _points(self) -> list[Wanted]:
        return [(ledger, name, point) for ledger, name, _, *points in self._changes for point in points]

    def carry_out(self, workers: Workers) -> Iterator[str]:
        """Score what the ledgers lack, and yield the controller of each point."""
        yield from fill(self._points(), self._runs, workers)

    def changes(self) -> list[Change]:
        """Return every change whose scores are known."""
        known = []
        for ledger, name, key, values, other in self._changes:
            before, after = (ledger.costs(nested_settings(point)) for point in (values, other))
            if before is not None and after is not None:
                known.append(Change(name, key, values[key], other[key], score(before), score(after)))
        return known


def improvements(changes: Sequence[Change]) -> list[Change]:
    """Return the changes that gain more than the tolerance, the largest first."""
    return sorted((change for change in changes if change.gain > TOLERANCE), key=lambda change: -change.gain)
