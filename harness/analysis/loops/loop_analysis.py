"""The loop of one controller analysed: linearised where it is composed, identified from logged data where it is not.

**Identification.** The controller runs in closed loop with the linear arm around a rest. One after the other, a
multisine d_i is added to each signal that it measures, the features and the joint positions. Of each experiment the
last period is logged, of which the discrete Fourier transforms are exact, as everything in it is periodic:

    U(ω) = C(ω) V(ω)   ⇒   C(ω) = U(ω) V(ω)⁻¹

with U (n, m + n) the commands and V (m + n, m + n) the measured signals, a column an experiment. Schoukens and
Pintelon, *System Identification: A Frequency Domain Approach*, chapters 2 and 5. The reference is constant, so that a
feedforward of it does not pass for feedback. Adaptation in the small motions is part of the response.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple, TypeAlias, final

import numpy as np
import pandas as pd

from servobench.controllers.controller import Controller
from servobench.controllers.servo import ServoController
from servobench.harness.analysis.comparison import number
from servobench.harness.analysis.loops.equilibrium import (
    PLANT,
    TASK,
    Rest,
    Source,
    at_rest,
    linearise,
    warm_up,
)
from servobench.harness.analysis.loops.systems import (
    POINTS,
    ArmModel,
    ComplexArray,
    LoopResponse,
    Margins,
    StateSpace,
    closed_loop,
    frequencies,
    is_stable,
    largest_gain,
    sensitivity,
)
from servobench.harness.run.loop import LoopSettings, Rollout, periods
from servobench.harness.run.request import DEFAULT_ROBOT, RunRequest, RunSettings, find_robot
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.tasks import fitted
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ControllerDiverged, RunFault
from servobench.plant.contract.lanes import one_thread
from servobench.plant.contract.signals import Command, Observation, Truth
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.mismatch import Mismatch

AnyConfig: TypeAlias = Any  # settings of any composed controller
LENGTH = 256  # [periods] of the multisine
AMPLITUDE = 2e-4  # [m] and [rad] root mean square of the multisine
SETTLING = 100  # [periods] of rest before the experiments
MAX_MOTION = 0.1  # [m] beyond it a loop is not at small motions any more
STEP_DURATION = 4.0  # [s] of the step responses
FAST_POINTS = 150  # of the frequency axis where only the delay margin is wanted
# Heading in a terminal -> column, factor, digits
SHOWN: Final = {
    "gain\nmargin": ("gain_margin", 1.0, 2),
    "phase\nmargin, °": ("phase_margin_deg", 1.0, 0),
    "delay\nmargin, ms": ("delay_margin_s", 1000.0, 0),
    "peak\nM_s": ("sensitivity_peak", 1.0, 2),
    "disk\nmargin": ("disk_margin", 1.0, 2),
    "over-\nshoot, %": ("overshoot", 100.0, 0),
}
# The same where limits were simulated, too
SIMULATED: Final = {
    "gain\nmargin": ("gain_margin", 1.0, 2),
    "gain,\nsimulated": ("simulated_gain_margin", 1.0, 2),
    "latency\nlimit, ms": ("latency_limit_s", 1000.0, 0),
    "latency,\nsimulated": ("simulated_latency_limit_s", 1000.0, 0),
}
LEGEND = (
    "Gain margin: factor on the command. Delay margin: further latency of the camera. M_s: largest singular value of "
    "the sensitivity at the feature. Disk margin: for changes of each feature by itself. A dash: the loop is unstable. "
    "Linearised loops have frozen estimators; how these adapt is not judged."
)


class Record(NamedTuple):
    """The logged signals of one experiment."""

    measured: FloatArray  # features and joint positions as the controller saw them, as deviations, (periods, m + n)
    command: FloatArray  # (periods, n) [rad/s]


@final
class LinearArm(Plant):
    """The linear arm around a rest, as a plant whose measurements can be excited.

    Attributes:
        measured: deviations of features and joint positions since `excite`, one (m + n,) a period.
    """

    def __init__(self, arm: ArmModel, rest: Rest) -> None:
        """Begin at the rest."""
        self._system, self._period, self._rest = arm.matrices(), arm.period, rest
        self._m = len(arm.jacobian)
        self._x, self._k = np.zeros(len(self._system.A)), 0

    def excite(self, added: FloatArray) -> Observation:
        """Add signals to the measurements from now on, (periods, m + n) m and rad, and return the present observation.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        self._added, self.measured = added, list[FloatArray]()
        return self._observe()

    def reset(self, seed: int) -> Observation:
        """Measure without excitation; nothing is random. See `Plant.reset`."""
        return self.excite(np.zeros((0, len(self._system.C))))

    def step(self, command: Command) -> Observation:
        """See `Plant.step`.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        self._x = self._system.A @ self._x + self._system.B @ command.joint_velocity
        self._k += 1
        return self._observe()

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return Truth(self._rest.feature + (self._system.C @ self._x)[: self._m], None)

    def close(self) -> None:
        """See `Plant.close`; nothing is held."""

    def _observe(self) -> Observation:
        deviation, row, rest, m = self._system.C @ self._x, len(self.measured), self._rest, self._m
        if row < len(self._added):
            deviation = deviation + self._added[row]
            if not np.abs(deviation[:m]).max() < MAX_MOTION:
                raise ControllerDiverged(
                    f"the loop is unstable: {MAX_MOTION} m were exceeded in small motions"
                )
            self.measured.append(deviation)
        time = rest.time + self._k * self._period
        return Observation(time, rest.joint_position + deviation[m:], rest.feature + deviation[:m])


class SmallMotions:
    """A controller in closed loop with the linear arm around a rest."""

    def __init__(self, controller: Controller, arm: ArmModel, rest: Rest) -> None:
        """Let the controller settle; it is left in the state that it has then.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        self._controller, self._rest, self._arm = controller, rest, LinearArm(arm, rest)
        self.run(np.zeros((SETTLING, sum(arm.jacobian.shape))))

    def run(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Go on with signals added to the measurements, (periods, m + n).

        Args:
            added: m and rad.
            desired: (m,) [m], a deviation of the reference; None for none.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        wanted = self._rest.feature if desired is None else self._rest.feature + desired
        rows = np.tile(wanted, (len(added) + self._rest.preview + 1, 1))
        rollout = Rollout(
            self._arm, self._arm.excite(added), rows, LoopSettings(len(added), self._rest.preview)
        )
        command = [period.command.joint_velocity for period in periods(rollout, self._controller)]
        return Record(np.array(self._arm.measured), np.array(command))

    def tried(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Return the record of `run`, and restore the state from before it."""
        controller, arm = self._controller.save(), self._arm.save()
        record = self.run(added, desired)
        self._controller.restore(controller)
        self._arm.restore(arm)
        return record


def multisine(length: int) -> FloatArray:
    """Return one period of equal sines at all harmonics with Schroeder's phases, (length,), without a mean."""
    harmonics = np.arange(1, length // 2 + 1)
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    spectrum[1:] = np.exp(-1j * np.pi * harmonics * (harmonics - 1) / len(harmonics))
    spectrum[-1] = 1.0  # real at the Nyquist frequency
    signal = np.fft.irfft(spectrum, length)
    return np.asarray(AMPLITUDE * signal / np.sqrt(np.mean(signal**2)))


def excite(loop: SmallMotions, inputs: int, length: int = LENGTH) -> list[Record]:
    """Return an experiment for each of the signals that the controller measures: its second period, less the rest."""
    signal = np.tile(multisine(length), 2)
    rest = loop.tried(np.zeros((len(signal), inputs)))
    excited = [loop.tried(np.outer(signal, each)) for each in np.eye(inputs)]
    return [Record(each.measured[length:] - rest.measured[length:], each.command[length:] - rest.command[length:])
            for each in excited]  # fmt: skip


def step_responses(loop: SmallMotions, m: int, n: int, periods: int) -> FloatArray:
    """Return each feature after a unit step of its own reference, (periods, m), measured in small motions."""
    nothing = np.zeros((periods, m + n))
    rest = loop.tried(nothing).measured
    moved = [loop.tried(nothing, AMPLITUDE * each).measured for each in np.eye(m)]
    return np.stack([(each - rest)[:, i] / AMPLITUDE for i, each in enumerate(moved)], axis=-1)


def controller_response(records: list[Record], period: float) -> tuple[FloatArray, ComplexArray]:
    """Return the frequencies (k,) [rad/s] and the controller's response (k, n, m + n) there.

    Args:
        records: as many experiments as the controller measures signals, each one whole period of its excitation.
        period: of sampling [s].
    """
    V = np.stack([np.fft.rfft(record.measured, axis=0)[1:] for record in records], axis=-1)
    U = np.stack([np.fft.rfft(record.command, axis=0)[1:] for record in records], axis=-1)
    length = len(records[0].measured)
    frequency = 2.0 * np.pi * np.arange(1, length // 2 + 1) / (length * period)
    response = np.linalg.solve(np.swapaxes(V, -1, -2), np.swapaxes(U, -1, -2))
    return np.asarray(frequency, np.float64), np.asarray(np.swapaxes(response, -1, -2))


@dataclass(frozen=True, eq=False)
class LoopAnalysis:
    """The loop around a rest."""

    name: str  # of the controller
    model: str  # "linearised" or "identified"
    stable: bool  # whether the loop is stable as it is
    margins: Margins  # of the loop
    response: LoopResponse  # the frequency response of controller and loop
    step: FloatArray  # each feature after a unit step of its own reference, (periods, m)

    @property
    def arm(self) -> ArmModel:
        """The linear model of arm and camera."""
        return self.response.arm

    @property
    def latency_limit(self) -> float:
        """The largest latency of the camera at which the loop is predicted to be stable [s]; 0 if it is not now."""
        return self.arm.latency + self.margins.delay_margin_s if self.stable else 0.0

    def gain_limits(self, latencies: Sequence[float]) -> FloatArray:
        """Return the least factor on the command at which the loop becomes unstable, at each latency [s]."""
        at = [replace(self.response, arm=replace(self.arm, latency=each)) for each in latencies]
        return np.array([each.gain_limit() for each in at])

    def sensitivity_peaks(self, factors: FloatArray, latencies: Sequence[float]) -> FloatArray:
        """Return M_s with the command multiplied by each factor, at each latency [s], (factors, latencies)."""
        peaks = np.full((len(factors), len(latencies)), np.inf)
        every = max(1, len(self.response.frequency) // 128)
        frequency, controller = (
            self.response.frequency[::-every][::-1],
            self.response.controller[::-every][::-1],
        )
        limits = self.gain_limits(latencies)
        for j, latency in enumerate(latencies):
            arm = replace(self.arm, latency=latency)
            for i in np.flatnonzero(factors < limits[j]):
                L = LoopResponse(frequency, factors[i] * controller, arm).at_feature()
                peaks[i, j] = largest_gain(sensitivity(L)).max()
        return peaks


def analyse_loop(
    resolved: ResolvedRun, source: Source = "true", *, identify: bool = False
) -> LoopAnalysis:
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
        arm, (m, n) = warm.arm, warm.arm.jacobian.shape
        steps = round(STEP_DURATION / arm.period)
        if isinstance(warm.controller, ServoController) and not identify:
            controller = linearise(*at_rest(warm, source))
            closed, response = (
                closed_loop(arm.matrices(), controller),
                linear_response(controller, arm),
            )
            stable, step = is_stable(closed.A), closed.step(m, arm.period, steps)
            return LoopAnalysis(name, "linearised", stable, response.margins(), response, step)
        loop = SmallMotions(warm.controller, arm, warm.rest)
        response = LoopResponse(*controller_response(excite(loop, m + n), arm.period), arm)
        return LoopAnalysis(
            name,
            "identified",
            True,
            response.margins(),
            response,
            step_responses(loop, m, n, steps),
        )


def delay_margin(
    config: AnyConfig,
    name: str,
    run: RunSettings | None = None,
    plant: KinematicConfig | None = None,
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
        robot: name, or the path of a file.

    Returns:
        0 for a loop that is unstable without any addition, or whose controller cannot go on.

    Raises:
        TypeError: a controller that is not composed.
        ConfigurationError: a name or a setting that cannot be used.
    """
    request = RunRequest(PLANT, name, TASK, Mismatch(), 0, robot=robot)
    task = fitted(TASK, find_robot(robot))
    resolved = ResolvedRun(request, run or RunSettings(), plant or KinematicConfig(), config, task)
    with one_thread():
        try:
            warm = warm_up(resolved)
            controller = linearise(*at_rest(warm, "true"))
        except RunFault:
            return 0.0
        if not is_stable(closed_loop(warm.arm.matrices(), controller).A):
            return 0.0
        return linear_response(controller, warm.arm, FAST_POINTS).delay_margin()


def latency_border(
    config: AnyConfig,
    name: str,
    latencies: Sequence[float],
    run: RunSettings,
    plant: KinematicConfig,
    robot: str,
) -> float:
    """Return the latency of the camera [s] from which on a loop is predicted to be unstable; inf if none is.

    The controller is warmed up at each latency, so that its aids have identified it.

    Args:
        config: settings of the controller; this and the next ones as of `delay_margin`.
        name: of the controller.
        latencies: ascending, from 0 on [s]; beyond the last one nothing is predicted.
        run: period and preview.
        plant: lag, delays and noise; its latency is replaced.
        robot: name, or the path of a file.
    """
    border = 0.0
    for latency in latencies:
        later = replace(plant, sensing=replace(plant.sensing, latency=latency))
        margin = delay_margin(config, name, run, later, robot)
        if margin == 0.0:
            return min(border, latency)
        border = latency + margin
    return border if border <= latencies[-1] else np.inf


def linear_response(controller: StateSpace, arm: ArmModel, points: int = POINTS) -> LoopResponse:
    """Return the frequency response of a linear controller on an arm, at so many points."""
    axis, measured = frequencies(arm.period, points), sum(arm.jacobian.shape)
    return LoopResponse(
        axis, controller.response(np.exp(1j * axis * arm.period))[:, :, :measured], arm
    )


def loop_table(loops: Sequence[LoopAnalysis]) -> pd.DataFrame:
    """Return a row for each loop; margins of a loop that is unstable are NaN, its limits 0."""
    rows = []
    for loop in loops:
        numbers = asdict(loop.margins) | {"overshoot": max(0.0, float(loop.step.max()) - 1.0)}
        known = numbers if loop.stable else dict.fromkeys(numbers, np.nan)
        rows.append(
            {"controller": loop.name, "model": loop.model, "stable": loop.stable, **known,
             "latency_limit_s": loop.latency_limit}
        )  # fmt: skip
    return pd.DataFrame(rows)


def printed(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table as text for a terminal."""
    shown = SIMULATED if "simulated_gain_margin" in table else SHOWN
    text = {head: [number(factor * value, f".{digits}f") for value in table[name]]
            for head, (name, factor, digits) in shown.items()}  # fmt: skip
    return pd.DataFrame({"controller": table["controller"], **text})
