"""The coordinate search that ends a study: one value at a time, until no change of one value improves the score.

    switch: each of its other values         number: 1.2 and 0.8 times its value, within its range

A change that lowers the score by more than `ACCEPTED` is kept and the same value is changed again; after a whole round
without such a change the search ends. `servobench.harness.studies.tuning.check` makes the same changes.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Final

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from servobench.harness.studies.tuning.spaces import Distribution, Point, Space, nested_settings

STEP: Final = 0.2  # [1] share of a number by which it is changed
STEP_FROM_ZERO: Final = 0.05  # [1] share of the range's upper end by which a number of 0 is changed
ACCEPTED: Final = 0.005  # [1] share of the score that a change must gain to be kept


@dataclass(frozen=True)
class Found:
    """Where a coordinate search ended."""

    values: Point
    score: float
    evaluations: int  # points that it asked for
    complete: bool  # whether no change improves the score; False: the budget ended first


def changes(distribution: Distribution, value: Any) -> list[Any]:  # noqa: ANN401 - a number or a choice
    """Return the values that the search and the check try instead of `value`."""
    if isinstance(distribution, CategoricalDistribution):
        return [choice for choice in distribution.choices if choice != value]
    reached = [_step(distribution, value, sign) for sign in (1, -1)]
    return [other for other in dict.fromkeys(reached) if other != value]


def _step(distribution: FloatDistribution | IntDistribution, value: float, sign: int) -> float:
    size = STEP * abs(value) or STEP_FROM_ZERO * distribution.high
    if distribution.step is not None:
        size = distribution.step * max(1, round(size / distribution.step))
    moved = min(max(value + sign * size, distribution.low), distribution.high)
    return int(moved) if isinstance(distribution, IntDistribution) else moved


def neighbours(space: Space, values: Point) -> list[tuple[str, Point]]:
    """Return every point that differs from `values` by one change, with the key that is changed."""
    return [(key, {**values, key: other}) for key in space for other in changes(space[key], values[key])]


def coordinate_search(space: Space, values: Point, score: float, budget: int) -> Generator[Point, float, Found]:
    """Improve a point: a generator that yields the points whose scores it needs, and returns the last one kept.

    Args:
        space: what may be changed, in the order in which it is tried.
        values: where to begin.
        score: of that point.
        budget: most points to ask for.
    """
    keys, at, idle, asked = list(space), 0, 0, 0
    seen = {str(nested_settings(values))}
    while idle < len(keys):
        key = keys[at % len(keys)]
        improved = False
        for other in changes(space[key], values[key]):
            candidate = {**values, key: other}
            if str(nested_settings(candidate)) in seen:
                continue
            if asked == budget:
                return Found(values, score, asked, complete=False)
            came = yield candidate
            asked += 1
            seen.add(str(nested_settings(candidate)))
            if came < (1.0 - ACCEPTED) * score:
                values, score, improved = candidate, came, True
                break
        idle = 0 if improved else idle + 1
        at += not improved
    return Found(values, score, asked, complete=True)
