"""The loop: the only place that knows plant, controller and reference; for one run or many side by side.

reference(t) ------------.
                         v
  .--> Observation --> controller.step --> Command --> plant.step --.
  |         |                                |                      |
  |         '------------> log row k <-------'                      |
  '-----------------------------------------------------------------'

Linear algebra runs on one thread, for the same bits on any number of processors, and a number that leaves its range is
an error (`careful`).
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter_ns
from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.controller import Controller
from servobench.harness.run.log import Period, StepLog
from servobench.harness.run.result import INSTANT
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FeatureLost
from servobench.plant.contract.lanes import one_thread
from servobench.plant.contract.seeds import Seeds, named_seed
from servobench.plant.contract.signals import BoolArray, Command, Observation


class CameraMove(NamedTuple):
    """A change of the camera's pose during a run that the controller must notice by itself."""

    period: int  # the first period with the new pose
    X_BC: FloatArray  # (..., 4, 4), the new pose in the base frame


@dataclass(frozen=True)
class LoopSettings:
    """The length of a run and the reasons to end it early."""

    periods: int  # control periods in the run
    preview: int = 0  # future rows of the reference that a controller gets
    lost_after_periods: int = (
        sys.maxsize
    )  # a run ends after so many periods in a row without a valid feature
    camera_move: CameraMove | None = None  # a move of the camera in the middle of the run, or None
    jumps: tuple[int, ...] = ()  # periods in which the reference jumps, ascending


@final
@dataclass(eq=False)
class Rollout:
    """The plant's side of a run, for a controller or for an agent that sends commands from elsewhere."""

    plant: Plant  # of one run, or of runs side by side
    observation: Observation  # the present one, which the plant returned last
    desired: FloatArray  # (..., periods + preview, m), the desired features from the first observation on
    settings: LoopSettings  # length of the run and the reasons to end it early
    k: int = 0  # periods that were begun
    _lost: Any = field(default=0, init=False)  # periods without a valid feature up to now, (...)
    _first: int = field(default=0, init=False)  # the period of the first row of `desired`

    @property
    def running(self) -> bool:
        """Whether a period is left."""
        return self.k < self.settings.periods

    @property
    def reference(self) -> FloatArray:
        """The reference from now on, (..., 1 + preview, m); a jump is not seen before it comes."""
        now = self.k - self._first
        rows = self.desired[..., now : now + 1 + self.settings.preview, :]
        for jump in self.settings.jumps:
            ahead = jump - self.k
            if 0 < ahead <= self.settings.preview:
                held = rows[..., ahead - 1 : ahead, :]
                hidden = np.broadcast_to(held, rows[..., ahead:, :].shape)
                return np.concatenate([rows[..., :ahead, :], hidden], axis=-2)
        return rows

    def redirect(self, desired: FloatArray) -> None:
        """Follow other desired features, (..., at least 1 + preview, m), from the present instant on."""
        self.desired = desired
        self._first = self.k

    def advance(self, command: Command) -> None:
        """Hold a command for a period.

        Raises:
            RunFault: the plant cannot go on.
        """
        move = self.settings.camera_move
        if move is not None and self.k == move.period:
            self.plant.move_camera(move.X_BC)
        self.k += 1
        self.observation = self.plant.step(command)
        self._lost = (1 + self._lost) * (1 - self.observation.feature_valid)

    def lost(self) -> BoolArray | None:
        """Return the runs, (...), that had no valid feature for too long; None if there are none."""
        if np.max(self._lost) < self.settings.lost_after_periods:
            return None
        return np.asarray(self._lost >= self.settings.lost_after_periods)

    def loss(self) -> FeatureLost:
        """Return the fault of runs that had no valid feature for too long."""
        periods = self.settings.lost_after_periods
        return FeatureLost(
            f"no valid feature for {periods} periods, until {self.observation.time:g} s"
        )


def periods(rollout: Rollout, controller: Controller) -> Iterator[Period]:
    """Yield each period of a run after the controller and the plant have taken their steps.

    Raises:
        RunFault: the run ended before its last period.
    """
    while rollout.running:
        observation, reference = rollout.observation, rollout.reference
        INSTANT.value = observation.time
        began = perf_counter_ns()
        command = controller.step(observation, reference)
        decided = perf_counter_ns()
        truth = rollout.plant.truth()
        released = perf_counter_ns()
        rollout.advance(command)
        yield Period(
            observation, reference, command, truth, (decided - began, perf_counter_ns() - released)
        )


def run_loop(
    plant: Plant,
    controller: Controller,
    desired: FloatArray,
    settings: LoopSettings,
    seed: Seeds,
    log: StepLog,
) -> None:
    """Step `plant` and `controller` against a reference and write one row a period into `log`.

    Args:
        plant: of one run, or of runs side by side.
        controller: the same.
        desired: (..., periods + preview, m), the desired features from time 0 on.
        settings: length of the run and the reasons to end it early.
        seed: of the run, or one of each run.
        log: receives the rows.

    Raises:
        RunFault: the run ended before its last period; the rows so far are in the log.
    """
    rollout = begin(
        plant, controller, desired, settings, (_named(seed, "plant"), _named(seed, "controller"))
    )
    for period in periods(rollout, controller):
        log.add(period, controller.estimated_jacobian(), controller.diagnostics())
        lost = rollout.lost()
        if lost is not None:
            log.end(lost, rollout.loss())


def begin(
    plant: Plant,
    controller: Controller,
    desired: FloatArray,
    settings: LoopSettings,
    seeds: tuple[Any, Any],
) -> Rollout:
    """Reset plant and controller, each with its own of `seeds`, and return the run at its first instant."""
    rollout = Rollout(plant, plant.reset(seeds[0]), desired, settings)
    controller.reset(rollout.observation, seeds[1])
    return rollout


def _named(seed: Seeds, name: str) -> Any:  # noqa: ANN401 - as `seed`
    return (
        named_seed(seed, name)
        if isinstance(seed, int)
        else [named_seed(each, name) for each in seed]
    )


@contextmanager
def careful() -> Iterator[None]:
    """One thread, and an error where a number leaves its range."""
    with one_thread(), np.errstate(divide="raise", over="raise", invalid="raise"):
        yield
