"""Tasks of several moves in a row, in which what a controller learned in the first ones pays in the later ones.

A task is a sequence of segments: the target jumps to a place and is held there, or moves on a curve. Each segment in
which it is held is a move, and is judged by its own settling time from the jump on. All places are taught: postures of
the true arm that are drawn as those of the task `random`, whose move with the same seed is the first one.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Annotated

import numpy as np
from annotated_types import Ge

from servobench.harness.run.references import JointPath, Segment
from servobench.harness.run.scenario import Scenario, Span, TaskSetting
from servobench.harness.run.starts import (
    PLACES,
    Box,
    BoxTask,
    Move,
    are_apart,
    are_fit,
    drawn_moves,
    stays_in_reach,
)
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import Count, Duration, settings

CORNER_INTERVAL = 3  # targets, the last of which is a corner of the box
CORNERS_AT_ONCE = 64
MAX_DRAWS = 100  # draws of the next target, or of a curve
LAP_POINTS = 16  # points of a curve that must be fit
# Shares of the way from home to a corner, or to the ends of a move, that are tried one after the other
SHARES = tuple(np.linspace(1.0, 0.1, MAX_DRAWS).tolist())
CURVE_SHARE = 0.5  # factor on these shares, for a curve
FIRST_LATER = 2  # number of moves before those that are judged


@settings
class TourTask(BoxTask):
    """Moves to several targets in a row, drawn by the run's seed; every third one is a corner of the box."""

    targets: Annotated[Count, Ge(3)] = 6
    """moves in the run; those from the third on are judged"""
    hold: Duration = 3.0
    """[s] for which each target is held, from its jump on"""

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        box = self.box(setting)
        generator = named_generator(setting.seed, PLACES)
        moves = drawn_moves(box, setting, generator)
        start, target = next(moves)
        places = [target]
        while len(places) < self.targets:
            if len(places) % CORNER_INTERVAL == CORNER_INTERVAL - 1:
                candidates = _corners(box, setting, generator)
            else:
                candidates = (posture[None] for _, posture in moves)
            places.append(_next_place(places[-1], candidates, box, setting))
        return in_turn(setting, start, [Segment(self.hold, place) for place in places])


@settings
class AgainTask(BoxTask):
    """A move drawn by the run's seed, a curve elsewhere, the way back to the start, and the same move again."""

    hold: Duration = 3.0
    """[s] for which each target is held, from its jump on"""
    curve_time: Duration = 6.0
    """[s] of the lap on the curve"""

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        box = self.box(setting)
        moves = drawn_moves(box, setting, named_generator(setting.seed, PLACES))
        start, target = next(moves)
        there = Segment(self.hold, target)
        back = Segment(self.hold, start)
        curve = _curve(moves, self.curve_time, box, setting)
        return in_turn(setting, start, [there, curve, back, there])


def in_turn(setting: TaskSetting, start: FloatArray, segments: Sequence[Segment]) -> Scenario:
    """Return the scenario of an arm that starts at (n,) rad and follows segments, of which three or more are rests."""
    path = JointPath(tuple(segments))
    ends = path.ends.tolist()
    moves = [
        Span(end - segment.duration, end)
        for segment, end in zip(segments, ends, strict=True)
        if segment.swings is None
    ]
    return Scenario(
        setting.start(start),
        setting.led(path),
        duration=ends[-1],
        evaluate_from=moves[FIRST_LATER].begin,
        kind="sequence",
        moves=tuple(moves),
        jumps=tuple(ends[:-1]),
    )


def _corners(
    box: Box, setting: TaskSetting, generator: np.random.Generator
) -> Iterator[FloatArray]:
    """Yield corners of a box, (k, n) rad, drawn with equal probabilities; if none is fit, ever nearer to home."""
    home = _home(box, setting)
    for share in SHARES:
        is_upper = generator.integers(0, 2, (CORNERS_AT_ONCE, len(home)), dtype=np.bool_)
        corners = np.where(is_upper, box.upper, box.lower)
        yield corners if share == 1.0 else home + share * (corners - home)


def _home(box: Box, setting: TaskSetting) -> FloatArray:
    """Return the posture of a box that is nearest to the arm's home, (n,) rad."""
    return np.clip(setting.taught_on()[0].workspace.home, box.lower, box.upper)


def _next_place(
    last: FloatArray, candidates: Iterator[FloatArray], box: Box, setting: TaskSetting
) -> FloatArray:
    """Return the first of the candidates, groups of (k, n) rad, that is fit and far enough from the last place."""
    for postures in islice(candidates, MAX_DRAWS):
        fit = are_apart(postures, last, box, setting) & are_fit(postures, box, setting)
        for posture in postures[fit]:
            if stays_in_reach(posture, box, setting):
                return posture
    raise ValueError(
        f"no further target between lower and upper is shortest = {box.shortest:g} m from the last one and above the "
        f"table by lowest = {box.lowest:g} m"
    )


def _curve(moves: Iterator[Move], duration: float, box: Box, setting: TaskSetting) -> Segment:
    """Return a lap about home, as far as half the way to start and target of moves, or less where that is not fit."""
    home = _home(box, setting)
    times = np.linspace(0.0, duration, LAP_POINTS, endpoint=False)
    for share, ends in zip(SHARES, moves, strict=False):
        swings = CURVE_SHARE * share * (np.array(ends) - home)
        lap = Segment(duration, home, swings)
        if are_fit(JointPath((lap,)).at(times), box, setting).all():
            return lap
    raise ValueError("no curve about the arm's home between lower and upper is fit for it")
