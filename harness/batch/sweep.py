"""The runs of a Monte Carlo sweep: mismatches with one axis varied at a time, noise and latency."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

from servobench.harness.batch.campaign import Cell
from servobench.harness.batch.compare import Batch
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.request import RunRequest
from servobench.plant.robot.mismatch import Magnitude, parse_magnitudes

Variation: TypeAlias = tuple[str, tuple[Magnitude, ...]]


@dataclass(frozen=True)
class SweepPlan:
    """All combinations of these; each variation is put on top of every mismatch by itself, not with the others."""

    batch: Batch  # plants, controllers, tasks, mismatches and seeds
    variations: tuple[Variation, ...] = ()  # axes with their magnitudes
    noise_factors: tuple[float, ...] = (1.0,)  # on the plants' sensor noise
    latencies: tuple[int | None, ...] = (None,)  # [periods]; None for what a plant is configured with

    def cells(self) -> list[Cell]:
        """Return the runs, seeds varying fastest."""
        places: list[tuple[str, Magnitude] | None] = [
            (axis, magnitude) for axis, magnitudes in self.variations for magnitude in magnitudes
        ]
        return [
            _cell(replace(request, noise_factor=noise, latency_periods=latency), place)
            for place, noise, latency in product(places or [None], self.noise_factors, self.latencies)
            for request in self.batch.requests()
        ]


def place_columns(axis: str = "", magnitude: Magnitude | None = None) -> dict[str, Any]:
    """Return the columns that say where a run stands on the axis that is varied; empty and NaN where none is."""
    number, unit = (math.nan, "") if magnitude is None else (magnitude.number, magnitude.unit)
    return {"axis": axis, "magnitude": number, "unit": unit}


def vary(request: RunRequest, axis: str, magnitude: Magnitude) -> RunRequest:
    """Return a run with one axis put on top of its mismatch."""
    return replace(request, mismatch=request.mismatch.with_axis(axis, magnitude))


def parse_variation(text: str) -> Variation:
    """Return the axis and the magnitudes in `axis=begin:end:step` (both ends included) or `axis=one/another`.

    The unit stands at the end, as in `camera_rotation=0:180:30deg`.

    Raises:
        ConfigurationError: an unknown axis, or an empty or malformed range.
    """
    axis, _, values = text.strip().partition("=")
    try:
        return axis, parse_magnitudes(axis, values)
    except ValueError as error:
        raise ConfigurationError(f"--vary: {error}") from error


def _cell(request: RunRequest, place: tuple[str, Magnitude] | None) -> Cell:
    return Cell(request, place_columns()) if place is None else Cell(vary(request, *place), place_columns(*place))
