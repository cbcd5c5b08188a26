"""Runs made ready to advance together: many true robots, targets and seeds under one method, on one plant."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from servobench.controllers.servo import Servo, ServoController
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.run.drawn import Drawn, draw
from servobench.harness.run.experiment import assemble, loop_settings
from servobench.harness.run.loop import LoopSettings
from servobench.harness.run.resolved import ResolvedRun
from servobench.plant.bench.bench import Bench
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import stack


@dataclass(frozen=True, eq=False)
class Together:
    """Runs made ready: plant, controller and reference with a lane for each."""

    bench: Bench
    servo: Servo
    drawn: tuple[Drawn, ...]  # the true robot and the task of each run
    desired: FloatArray  # (B, periods + preview, m) [unit of the feature]
    loop: LoopSettings


def side_by_side_key(run: ResolvedRun) -> Hashable | None:
    """Return what runs of one campaign must share to advance together; None for a run that goes alone."""
    request = run.request
    if not (find_plant(request.plant).side_by_side and find_controller(request.controller).side_by_side):
        return None
    moved = request.mismatch.size("camera_move") > 0.0
    names = request.plant, request.controller, request.task, request.noise_factor, request.latency, moved, request.robot
    return (*names, request.mismatch.sensor, request.sensing, id(run.run), id(run.controller), id(run.task))


def build_together(runs: Sequence[ResolvedRun], keep: Path | None = None) -> Together:
    """Make runs of one `side_by_side_key` ready.

    Raises:
        Exception: whatever a run alone would raise, or runs that cannot advance together.
    """
    first, drawn = runs[0], tuple(draw(run) for run in runs)
    moved = [each.moved.camera for each in drawn if each.moved is not None]
    loop = loop_settings(first.run, drawn[0].scenario.duration, np.stack(moved) if moved else None)
    rows = loop.periods + loop.preview
    desired = np.stack([each.scenario.reference.sampled(first.run.period, rows) for each in drawn])
    robots, starts = stack([each.true for each in drawn]), np.array([each.scenario.start for each in drawn])
    plant, controller = assemble(first, robots, starts, keep)
    return Together(cast(Bench, plant), cast(ServoController, controller).servo, drawn, desired, loop)
