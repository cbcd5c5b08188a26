"""The loop: the only place that sees plant, controller and reference together.

reference(t) ------------.
                         v
  .--> Observation --> controller.step --> Command --> plant.step --.
  |         |                                |                      |
  |         '------------> log row k <-------'                      |
  '-----------------------------------------------------------------'
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter_ns

from servobench.controllers.controller import Controller
from servobench.harness.run.log import StepLog
from servobench.harness.run.references import Reference
from servobench.plant.checks import FloatArray
from servobench.plant.faults import FeatureLost
from servobench.plant.plant import Plant
from servobench.plant.seeds import named_seed


@dataclass(frozen=True, eq=False)
class CameraMove:
    """A change of the camera's pose during a run, of which the controller is not told."""

    period: int  # from this period on
    X_BC: FloatArray  # (4, 4), the new pose in the base frame


@dataclass(frozen=True)
class LoopSettings:
    """How long a run is and what ends it early."""

    periods: int  # control periods in the run
    preview: int  # future rows of the reference that a controller sees
    lost_after_periods: int  # that many periods in a row without a valid feature end the run
    camera_move: CameraMove | None = None  # somebody knocks against the camera


def run_loop(
    plant: Plant, controller: Controller, reference: Reference, settings: LoopSettings, seed: int, log: StepLog
) -> None:
    """Step `plant` and `controller` against `reference` and write a row a period into `log`.

    Raises:
        RunFault: the run ended before its last period; the rows so far are in the log.
    """
    period, rows = plant.spec.period, 1 + settings.preview
    observation = plant.reset(named_seed(seed, "plant"))
    controller.reset(observation, named_seed(seed, "controller"))
    lost = 0
    for k in range(settings.periods):
        desired = reference.preview(k, period, rows)
        began = perf_counter_ns()
        command = controller.step(observation, desired)
        decided = perf_counter_ns()
        truth = plant.truth()
        if settings.camera_move is not None and k == settings.camera_move.period:
            plant.move_camera(settings.camera_move.X_BC)
        released = perf_counter_ns()
        following = plant.step(command)
        arrived = perf_counter_ns()
        log.add(
            observation,
            desired[0],
            command,
            truth,
            controller.estimated_jacobian(),
            controller.diagnostics(),
            (decided - began, arrived - released),
        )
        observation = following
        lost = 0 if observation.feature_valid else lost + 1
        if lost >= settings.lost_after_periods:
            raise FeatureLost(f"no valid feature for {lost} periods, until {observation.time:g} s")
