"""The loop: the only place that sees plant, controller and reference together; for one run or many side by side.

reference(t) ------------.
                         v
  .--> Observation --> controller.step --> Command --> plant.step --.
  |         |                                |                      |
  |         '------------> log row k <-------'                      |
  '-----------------------------------------------------------------'

Linear algebra runs on one thread, for the same bits on any number of processors, and a number that leaves its range is
an error (`careful`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from servobench.controllers.controller import Controller
from servobench.harness.run.log import StepLog
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FeatureLost
from servobench.plant.contract.seeds import Seeds, named_seed

_found: list[tuple[int, ThreadpoolController]] = []


@dataclass(frozen=True, eq=False)
class CameraMove:
    """A change of the camera's pose during a run that the controller must notice by itself."""

    period: int  # the first period with the new pose
    X_BC: FloatArray  # (..., 4, 4), the new pose in the base frame


@dataclass(frozen=True)
class LoopSettings:
    """How long a run is and what ends it early."""

    periods: int  # control periods in the run
    preview: int  # future rows of the reference that a controller sees
    lost_after_periods: int  # a run ends after so many periods in a row without a valid feature
    camera_move: CameraMove | None = None  # a move of the camera in the middle of the run, or None


def run_loop(
    plant: Plant, controller: Controller, desired: FloatArray, settings: LoopSettings, seed: Seeds, log: StepLog
) -> None:
    """Step `plant` and `controller` against a reference and write one row a period into `log`.

    Args:
        plant: of one run, or of runs side by side.
        controller: the same.
        desired: (..., periods + preview, m), the desired features from time 0 on.
        settings: how long the run is and what ends it early.
        seed: of the run, or one of each run.
        log: receives the rows.

    Raises:
        RunFault: the run ended before its last period; the rows so far are in the log.
    """
    rows, move = 1 + settings.preview, settings.camera_move
    observation = plant.reset(_named(seed, "plant"))
    controller.reset(observation, _named(seed, "controller"))
    lost: Any = 0
    for k in range(settings.periods):
        began = perf_counter_ns()
        command = controller.step(observation, desired[..., k : k + rows, :])
        decided = perf_counter_ns()
        truth = plant.truth()
        if move is not None and k == move.period:
            plant.move_camera(move.X_BC)
        released = perf_counter_ns()
        following = plant.step(command)
        spent = (decided - began, perf_counter_ns() - released)
        estimate, diagnostics = controller.estimated_jacobian(), controller.diagnostics()
        log.add(observation, desired[..., k, :], command, truth, estimate, diagnostics, spent)
        observation = following
        lost = (1 + lost) * (1 - observation.feature_valid)
        if np.max(lost) >= settings.lost_after_periods:
            text = f"no valid feature for {settings.lost_after_periods} periods, until {observation.time:g} s"
            log.end(np.asarray(lost >= settings.lost_after_periods), FeatureLost(text))


def _named(seed: Seeds, name: str) -> Any:  # noqa: ANN401 - as `seed`
    return named_seed(seed, name) if isinstance(seed, int) else [named_seed(each, name) for each in seed]


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which linear algebra runs on one thread.

    The search for libraries takes milliseconds, so it is repeated only if a module was imported since the last one.
    """
    modules = len(sys.modules)
    if not _found or _found[0][0] != modules:
        _found[:] = [(modules, ThreadpoolController())]
    context: AbstractContextManager[object] = _found[0][1].limit(limits=1)
    return context


@contextmanager
def careful() -> Iterator[None]:
    """One thread, and an error where a number leaves its range."""
    with one_thread(), np.errstate(divide="raise", over="raise", invalid="raise"):
        yield
