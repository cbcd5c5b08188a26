"""The runs of a Monte Carlo sweep: mismatches with one axis varied at a time, noise, latency and control period."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, TypeAlias

from servobench.harness.batch.blocks import Cell
from servobench.harness.batch.compare import Batch
from servobench.harness.batch.grid import Grid
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.request import RunRequest, read_mismatch
from servobench.plant.robot.mismatch import Magnitude, Mismatch, parse_magnitudes

Variation: TypeAlias = tuple[str, tuple[Magnitude, ...]]


@dataclass(frozen=True)
class SweepPlan:
    """All combinations of these; each variation is put on top of every mismatch by itself, not with the others."""

    batch: Batch  # plants, controllers, tasks, mismatches and seeds
    variations: tuple[Variation, ...] = ()  # axes with their magnitudes
    noise_factors: tuple[float, ...] = (1.0,)  # on the plants' sensor noise
    latencies: tuple[float | None, ...] = (None,)  # [s]; None for what a plant is configured with
    periods: tuple[float | None, ...] = (None,)  # [s] of control; None for that of the section `run`

    def cells(self) -> Grid[Cell]:
        """Return the runs, seeds varying fastest.

        Raises:
            ConfigurationError: an axis that is varied and stands in a mismatch, too.
        """
        for axis, _ in self.variations:
            for text in self.batch.mismatches:
                if axis in dict(read_mismatch(text).axes):
                    raise ConfigurationError(f"--vary {axis} varies an axis that the mismatch {text!r} has")
        places = [Place(axis, magnitude) for axis, magnitudes in self.variations for magnitude in magnitudes]
        make = partial(_cell, self.batch.robot)
        return Grid(make, places or [Place()], self.noise_factors, self.latencies, self.periods, *self.batch.axes())


@dataclass(frozen=True)
class Place:
    """Where a run stands on the axis that is varied; without an axis, none is."""

    axis: str = ""
    magnitude: Magnitude | None = None

    @cached_property
    def columns(self) -> dict[str, Any]:
        """The columns of the table of runs that say so; empty and NaN without an axis."""
        number, unit = (math.nan, "") if self.magnitude is None else (self.magnitude.number, self.magnitude.unit)
        return {"axis": self.axis, "magnitude": number, "unit": unit}

    def vary(self, mismatch: Mismatch) -> Mismatch:
        """Return a mismatch with the axis put on top of it."""
        return mismatch if self.magnitude is None else _with_axis(mismatch, self.axis, self.magnitude)


@lru_cache
def _with_axis(mismatch: Mismatch, axis: str, magnitude: Magnitude) -> Mismatch:
    """Return the same object for all runs at one place, so that messages to workers hold it once."""
    return mismatch.with_axis(axis, magnitude)


OWN_OPTIONS = {"noise": "noise 0,1,2", "latency": "latency 0,0.05,0.1", "period": "period 0.02,0.05"}


def parse_variation(text: str) -> Variation:
    """Return the axis and the magnitudes in `axis=begin:end:step` (both ends included) or `axis=one/another`.

    The unit stands at the end, as in `camera_rotation=0:180:30deg`.

    Raises:
        ConfigurationError: an unknown axis, or an empty or malformed range.
    """
    axis, _, values = text.strip().partition("=")
    if axis in OWN_OPTIONS:
        raise ConfigurationError(f"--vary: {axis} is no axis of the mismatch and has an option, --{OWN_OPTIONS[axis]}")
    try:
        return axis, parse_magnitudes(axis, values)
    except ValueError as error:
        raise ConfigurationError(f"--vary: {error}") from error


def _cell(
    robot: str,
    place: Place,
    noise: float,
    latency: float | None,
    period: float | None,
    *names: Any,  # noqa: ANN401 - as `Batch.axes`
) -> Cell:
    sensing, plant, task, mismatch, controller, seed = names
    varied = place.vary(mismatch)
    request = RunRequest(plant, controller, task, varied, seed, noise, latency, period, robot, sensing)
    return Cell(request, place.columns)
