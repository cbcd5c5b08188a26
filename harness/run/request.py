"""What a run is asked for: one cell of a comparison, and the settings that are common to all cells."""

from __future__ import annotations

import math
import operator
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

from servobench.harness.config.robots import DEFAULT_ROBOT
from servobench.harness.config.settings import ConfigurationError
from servobench.plant.cameras.registry import DEFAULT_SENSING, FIXED
from servobench.plant.contract.settings import NonNegative, Positive, ShareBelowOne, settings
from servobench.plant.robot.mismatch import Mismatch

UNFIT_FOR_FILES = re.compile(r"[^A-Za-z0-9.=+_-]")
NAMES = ("plant", "controller", "task", "robot", "sensing")  # fields of a request that are texts
TIMES = ("latency", "period")  # fields of a request, which are columns with the suffix _s


@settings
class RunSettings:
    """The section `run`: what is common to all plants, controllers and tasks."""

    period: Positive = 0.05
    """[s] control period"""
    preview_time: NonNegative = 0.5
    """[s] of the future reference that every controller gets, rounded up to control periods"""
    lost_after: Positive = 1.0
    """[s] without a valid feature after which a run ends"""
    camera_moves_at: ShareBelowOne = 0.5
    """share of the run after which a mismatch's `camera_move` happens"""
    full_jacobian: bool = False
    """log every entry of the estimated and the true Jacobian"""

    @property
    def preview_rows(self) -> int:
        """Future rows of the reference that every controller gets."""
        return self._whole_periods(self.preview_time)

    @property
    def lost_after_periods(self) -> int:
        """Control periods in a row without a valid feature after which a run ends."""
        return self.periods(self.lost_after)

    def periods(self, duration: float) -> int:
        """Return how many control periods a run of `duration` [s] has."""
        return max(1, self._whole_periods(duration))

    def _whole_periods(self, time: float) -> int:
        return math.ceil(time / self.period - 1e-9)


@dataclass(frozen=True)
class RunRequest:
    """One cell of a comparison.

    Raises:
        ConfigurationError: a text that is no mismatch, a name that is no text, or a bad seed.
    """

    plant: str
    controller: str
    task: str
    mismatch: Mismatch  # how far the true robot may be from the nominal one; its text is read, too
    seed: int  # of everything random in the run
    noise_factor: float = 1.0  # multiplies the sensor noise that the plant is configured with
    latency: float | None = None  # [s] of the camera; None for what the plant is configured with
    period: float | None = None  # [s] of control; None for that of the section `run`
    robot: str = DEFAULT_ROBOT  # a name, or the path of a file
    sensing: str = DEFAULT_SENSING  # a set-up, or the path of a file with one; with `:hand` for cameras on the hand

    def __post_init__(self) -> None:
        """Check the names and the seed, and read a mismatch that came as text."""
        for name in NAMES:
            if not isinstance(getattr(self, name), str):
                raise ConfigurationError(f"{name} must be a name, got {getattr(self, name)!r}")
        object.__setattr__(self, "seed", read_seed(self.seed))
        given: object = self.mismatch
        if isinstance(given, str):
            object.__setattr__(self, "mismatch", read_mismatch(given))
        object.__setattr__(self, "sensing", self.sensing.strip().removesuffix(f":{FIXED}"))

    @property
    def run_id(self) -> str:
        """Return a name for the run that is the same wherever it is made, and fit for a file."""
        mismatch, plant, controller = (
            UNFIT_FOR_FILES.sub("_", str(name)) for name in (self.mismatch, self.plant, self.controller)
        )
        noise = "" if self.noise_factor == 1.0 else f"-noise{self.noise_factor:g}"
        times = "".join(f"-{name}{1e3 * value:g}ms" for name in TIMES if (value := getattr(self, name)) is not None)
        robot = "" if self.robot == DEFAULT_ROBOT else f"{UNFIT_FOR_FILES.sub('_', Path(self.robot).name)}-"
        sensing = "" if self.sensing == DEFAULT_SENSING else f"{UNFIT_FOR_FILES.sub('_', Path(self.sensing).name)}-"
        return f"{plant}-{robot}{sensing}{controller}-{self.task}-{mismatch}{noise}{times}-{self.seed}"

    def as_row(self) -> dict[str, Any]:
        """Return the columns by which a run is found in the table of runs."""
        columns = {f"{name}_s" if name in TIMES else name: value for name, value in vars(self).items()}
        return {"run_id": self.run_id, **columns, "mismatch": str(self.mismatch)}


def read_mismatch(text: str) -> Mismatch:
    """Return the mismatch that a user wrote.

    Raises:
        ConfigurationError: it cannot be read.
    """
    if not isinstance(text, str):
        raise ConfigurationError(f"mismatch must be a text such as 'moderate' or 'links=10%', got {text!r}")
    try:
        return Mismatch.parse(text)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


def read_seed(seed: object) -> int:
    """Return a seed, a whole number from 0 on, as a Python integer, which numpy's integers become.

    Raises:
        ConfigurationError: it is no such number.
    """
    if isinstance(seed, bool) or not isinstance(seed, SupportsIndex) or operator.index(seed) < 0:
        raise ConfigurationError(f"seed must be a non-negative integer, got {seed!r}")
    return operator.index(seed)
