"""The loop of one controller analysed: linearised where it is composed, identified from logged data where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from servobench.controllers.servo import ServoController
from servobench.harness.analysis.loops.equilibrium import PLANT, TASK, Source, Warm, linear_controller, warm_up
from servobench.harness.analysis.loops.response import (
    POINTS,
    LoopResponse,
    Margins,
    SmallMotions,
    controller_response,
    excite,
    frequencies,
    simulated_step,
    step_responses,
)
from servobench.harness.analysis.loops.systems import ArmModel, StateSpace, closed_loop, is_stable
from servobench.harness.config.robots import DEFAULT_ROBOT, find_robot
from servobench.harness.run.loop import one_thread
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.tasks import fitted
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import RunFault
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.mismatch import Mismatch

STEP_DURATION = 4.0  # [s] of the step responses
FAST_POINTS = 150  # of the frequency axis where only the delay margin is wanted
LEGEND = (
    "Gain margin: factor on the command. Delay margin: further latency of the camera. M_s: largest singular value of "
    "the sensitivity at the feature. Disk margin: for changes of each feature by itself. A dash: the loop is unstable. "
    "Linearised loops have frozen estimators; how these adapt is not judged."
)


@dataclass(frozen=True, eq=False)
class LoopAnalysis:
    """The loop around a rest.

    Attributes:
        name: of the controller.
        model: "linearised" or "identified".
        stable: whether the loop is stable as it is.
        margins: of the loop.
        response: the frequency response of controller and loop.
        step: each feature after a unit step of its own reference, (periods, m).
        system: the closed loop from the references to the measured signals; None for an identified one.
    """

    name: str
    model: str
    stable: bool
    margins: Margins
    response: LoopResponse
    step: FloatArray
    system: StateSpace | None

    @property
    def arm(self) -> ArmModel:
        """The linear model of arm and camera."""
        return self.response.arm

    @property
    def latency_limit(self) -> float:
        """The largest latency of the camera at which the loop is predicted to be stable [s]; 0 if it is not now."""
        return self.arm.latency + self.margins.delay if self.stable else 0.0

    def gain_limits(self, latencies: Sequence[float]) -> FloatArray:
        """Return the least factor on the command at which the loop becomes unstable, at each latency [s]."""
        at = [replace(self.response, arm=replace(self.arm, latency=each)) for each in latencies]
        return np.array([each.gain_limit() for each in at])

    def sensitivity_peaks(self, factors: FloatArray, latencies: Sequence[float]) -> FloatArray:
        """Return M_s with the command multiplied by each factor, at each latency [s], (factors, latencies)."""
        peaks = np.full((len(factors), len(latencies)), np.inf)
        every = max(1, len(self.response.frequency) // 128)
        frequency, controller = self.response.frequency[::-every][::-1], self.response.controller[::-every][::-1]
        limits = self.gain_limits(latencies)
        for j, latency in enumerate(latencies):
            arm = replace(self.arm, latency=latency)
            for i in np.flatnonzero(factors < limits[j]):
                L = LoopResponse(frequency, factors[i] * controller, arm).at_feature()
                S = np.linalg.inv(np.eye(L.shape[-1]) + L)
                peaks[i, j] = np.linalg.norm(S, ord=2, axis=(-2, -1)).max()
        return peaks


def analyse_loop(resolved: ResolvedRun, source: Source = "true", *, identify: bool = False) -> LoopAnalysis:
    """Analyse the loop of a controller on the kinematic plant.

    Args:
        resolved: the run whose begin warms the controller up.
        source: the Jacobian at which the estimator of a composed controller is frozen.
        identify: identify a composed controller as any other, from logged data, while its estimator goes on learning.

    Raises:
        ConfigurationError: a name or a setting that cannot be used.
        RunFault: the controller cannot go on, or an unstable loop whose controller has to be identified.
    """
    with one_thread():
        warm, name = warm_up(resolved), resolved.request.controller
        if isinstance(warm.controller, ServoController) and not identify:
            return _linearised(name, warm, source)
        return _identified(name, warm)


def delay_margin(
    config: Any,  # noqa: ANN401 - the settings of any composed controller
    name: str,
    run: RunSettings | None = None,
    plant: KinematicConfig | None = None,
    seed: int = 0,
    robot: str = DEFAULT_ROBOT,
) -> float:
    """Return by how much later the camera may be before the loop of a composed controller is unstable, s.

    The estimator is frozen at the true Jacobian of the nominal robot, where a move of the warm-up ended. It takes 20 ms
    without aids, 100 to 200 ms with all of them.

    Args:
        config: settings of the controller.
        name: of the controller.
        run: period and preview; default: those of a run.
        plant: lag, delays and noise; default: those of the kinematic plant.
        seed: of the move.
        robot: name, or the path of a file.

    Returns:
        0 for a loop that is unstable without any addition, or whose controller cannot go on.

    Raises:
        TypeError: a controller that is not composed.
        ConfigurationError: a name or a setting that cannot be used.
    """
    request = RunRequest(PLANT, name, TASK, Mismatch(), seed, robot=robot)
    task = fitted(TASK, find_robot(robot))
    resolved = ResolvedRun(request, run or RunSettings(), plant or KinematicConfig(), config, task)
    with one_thread():
        try:
            warm = warm_up(resolved)
            controller = linear_controller(warm, "true")
        except RunFault:
            return 0.0
        if not is_stable(closed_loop(warm.arm.matrices(), controller).A):
            return 0.0
        return linear_response(controller, warm.arm, FAST_POINTS).delay_margin()


def latency_border(
    config: Any,  # noqa: ANN401 - the settings of any composed controller
    name: str,
    latencies: Sequence[float],
    run: RunSettings | None = None,
    plant: KinematicConfig | None = None,
    robot: str = DEFAULT_ROBOT,
) -> float:
    """Return the latency of the camera [s] from which on a loop is predicted to be unstable; inf if none is.

    The controller is warmed up at each latency, so that its aids have identified it.

    Args:
        config: settings of the controller.
        name: of the controller.
        latencies: ascending, from 0 on [s]; beyond the last one nothing is predicted.
        run: see `delay_margin`.
        plant: see `delay_margin`; its own latency is replaced.
        robot: see `delay_margin`.

    Raises:
        TypeError: a controller that is not composed.
        ConfigurationError: a name or a setting that cannot be used.
    """
    world, border = plant or KinematicConfig(), 0.0
    for latency in latencies:
        later = replace(world, sensing=replace(world.sensing, latency=latency))
        margin = delay_margin(config, name, run, later, robot=robot)
        if margin == 0.0:
            return min(border, latency)
        border = latency + margin
    return border if border <= latencies[-1] else np.inf


def linear_response(controller: StateSpace, arm: ArmModel, points: int = POINTS) -> LoopResponse:
    """Return the frequency response of a linear controller on an arm, at so many points."""
    axis, measured = frequencies(arm.period, points), sum(arm.jacobian.shape)
    return LoopResponse(axis, controller.response(np.exp(1j * axis * arm.period))[:, :, :measured], arm)


def _linearised(name: str, warm: Warm, source: Source) -> LoopAnalysis:
    controller, arm = linear_controller(warm, source), warm.arm
    closed, response = closed_loop(arm.matrices(), controller), linear_response(controller, arm)
    periods = round(STEP_DURATION / arm.period)
    step = simulated_step(closed, len(arm.jacobian), arm.period, periods)
    return LoopAnalysis(name, "linearised", is_stable(closed.A), response.margins(), response, step, closed)


def _identified(name: str, warm: Warm) -> LoopAnalysis:
    arm = warm.arm
    m, n = arm.jacobian.shape
    loop = SmallMotions(warm.controller, arm, warm.rest)
    frequency, controller = controller_response(excite(loop, m + n), arm.period)
    response = LoopResponse(frequency, controller, arm)
    step = step_responses(loop, m, n, round(STEP_DURATION / arm.period))
    return LoopAnalysis(name, "identified", True, response.margins(), response, step, None)


def loop_table(loops: Sequence[LoopAnalysis]) -> pd.DataFrame:
    """Return a row for each loop; margins of a loop that is unstable are NaN, its limits 0."""
    rows = []
    for loop in loops:
        margins, stable = loop.margins, loop.stable
        numbers = {
            "gain_margin": margins.gain,
            "gain_reduction_margin": margins.gain_reduction,
            "phase_margin_deg": np.rad2deg(margins.phase),
            "delay_margin_s": margins.delay,
            "crossover_rad_s": margins.crossover,
            "sensitivity_peak": margins.sensitivity_peak,
            "complementary_peak": margins.complementary_peak,
            "disk_margin": margins.disk,
            "overshoot": max(0.0, float(loop.step.max()) - 1.0),
        }
        known = {name: value if stable else np.nan for name, value in numbers.items()}
        rows.append(
            {"controller": loop.name, "model": loop.model, "stable": stable, **known,
             "latency_limit_s": loop.latency_limit}
        )  # fmt: skip
    return pd.DataFrame(rows)


def printed(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table as text for a terminal."""
    columns = {"controller": table["controller"], "gain\nmargin": _text(table["gain_margin"], 2)}
    if "simulated_gain_margin" in table:
        columns["gain,\nsimulated"] = _text(table["simulated_gain_margin"], 2)
        columns["latency\nlimit, ms"] = _text(1000.0 * table["latency_limit_s"], 0)
        columns["latency,\nsimulated"] = _text(1000.0 * table["simulated_latency_limit_s"], 0)
        return pd.DataFrame(columns)
    columns["phase\nmargin, °"] = _text(table["phase_margin_deg"], 0)
    columns["delay\nmargin, ms"] = _text(1000.0 * table["delay_margin_s"], 0)
    columns["peak\nM_s"] = _text(table["sensitivity_peak"], 2)
    columns["disk\nmargin"] = _text(table["disk_margin"], 2)
    columns["over-\nshoot, %"] = _text(100.0 * table["overshoot"], 0)
    return pd.DataFrame(columns)


def _text(values: pd.Series[float], digits: int) -> pd.Series[str]:
    return values.map(lambda value: "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.{digits}f}")
