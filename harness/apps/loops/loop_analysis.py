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
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from servobench.controllers.controller import Controller
from servobench.controllers.servo import ServoController
from servobench.harness.analysis.comparison import number
from servobench.harness.apps.loops.equilibrium import (
    PLANT,
    TASK,
    Rest,
    Source,
    at_rest,
    linearise,
    warm_up,
)
from servobench.harness.apps.loops.systems import (
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
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.tasks import fitted
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ControllerDiverged, RunFault
from servobench.plant.contract.lanes import one_thread
from servobench.plant.contract.signals import Observation
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, find_robot
from servobench.plant.robot.mismatch import Mismatch

AnyConfig: TypeAlias = Any  # settings of any composed controller
LENGTH = 256  # [periods] length of the multisine
AMPLITUDE = 2e-4  # [m] and [rad] root mean square of the multisine
SETTLING = 100  # [periods] rest before the experiments
MAX_MOTION = 0.1  # [m] beyond it a loop is not at small motions any more
STEP_DURATION = 4.0  # [s] length of the step responses
FAST_POINTS = 150  # frequencies where only the delay margin is wanted
# Heading in a terminal -> column, factor, digits
MARGIN_COLUMNS = {
    "gain\nmargin": ("gain_margin", 1.0, 2),
    "phase\nmargin, °": ("phase_margin_deg", 1.0, 0),
    "delay\nmargin, ms": ("delay_margin_s", 1000.0, 0),
    "peak\nM_s": ("sensitivity_peak", 1.0, 2),
    "disk\nmargin": ("disk_margin", 1.0, 2),
    "over-\nshoot, %": ("overshoot", 100.0, 0),
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


class SmallMotions:
    """A controller in closed loop with the linear arm around a rest."""

    def __init__(self, controller: Controller, arm: ArmModel, rest: Rest) -> None:
        """Let the controller settle; it is left in the state that it has then.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        self._controller = controller
        self._rest = rest
        self._system = arm.matrices()
        self._period = arm.period
        self._x = np.zeros(len(self._system.A))
        self._k = 0
        self.run(np.zeros((SETTLING, len(self._system.C))))

    def run(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Go on with signals added to the measurements, (periods, m + n).

        Args:
            added: m and rad.
            desired: (m,) [m], a deviation of the reference; None for none.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        rest = self._rest
        m = len(rest.feature)
        wanted = rest.feature if desired is None else rest.feature + desired
        reference = rest.reference(wanted)
        measured = []
        commands = []
        for row in added:
            deviation = self._system.C @ self._x + row
            if not np.abs(deviation[:m]).max() < MAX_MOTION:  # NaN counts as unstable, too
                raise ControllerDiverged(
                    f"the loop is unstable: {MAX_MOTION} m were exceeded in small motions"
                )
            time = rest.time + self._k * self._period
            joint_position = rest.joint_position + deviation[m:]
            observation = Observation(time, joint_position, rest.feature + deviation[:m])
            u = self._controller.step(observation, reference).joint_velocity
            self._x = self._system.A @ self._x + self._system.B @ u
            self._k += 1
            measured.append(deviation)
            commands.append(u)
        return Record(np.array(measured), np.array(commands))

    def tried(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Return the record of `run`, and restore the state from before it."""
        before = self._controller.save()
        x = self._x
        k = self._k
        record = self.run(added, desired)
        self._controller.restore(before)
        self._x = x
        self._k = k
        return record


def multisine(length: int) -> FloatArray:
    """Return one period of equal sines at all harmonics with Schroeder's phases, (length,), without a mean."""
    k = np.arange(1, length // 2 + 1)
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    # Schroeder's phases, −π k(k − 1)/K, keep the peak of the sum low.
    spectrum[1:] = np.exp(-1j * np.pi * k * (k - 1) / len(k))
    spectrum[-1] = 1.0  # real at the Nyquist frequency
    signal = np.fft.irfft(spectrum, length)
    root_mean_square = np.sqrt(np.mean(signal**2))
    return AMPLITUDE * signal / root_mean_square


def excite(loop: SmallMotions, inputs: int, length: int = LENGTH) -> list[Record]:
    """Return an experiment for each of the signals that the controller measures: its second period, less the rest."""
    signal = np.tile(multisine(length), 2)
    rest = loop.tried(np.zeros((len(signal), inputs)))
    records = []
    for direction in np.eye(inputs):
        excited = loop.tried(np.outer(signal, direction))
        # Transients have died out in the second period; what moves without excitation is no response.
        measured = excited.measured[length:] - rest.measured[length:]
        command = excited.command[length:] - rest.command[length:]
        records.append(Record(measured, command))
    return records


def step_responses(loop: SmallMotions, m: int, n: int, periods: int) -> FloatArray:
    """Return each feature after a unit step of its own reference, (periods, m), measured in small motions."""
    nothing = np.zeros((periods, m + n))
    rest = loop.tried(nothing).measured
    steps = []
    for i, axis in enumerate(np.eye(m)):
        moved = loop.tried(nothing, AMPLITUDE * axis).measured
        steps.append((moved - rest)[:, i] / AMPLITUDE)
    return np.stack(steps, axis=-1)


def controller_response(records: list[Record], period: float) -> tuple[FloatArray, ComplexArray]:
    """Return the frequencies (k,) [rad/s] and the controller's response (k, n, m + n) there.

    Args:
        records: as many experiments as the controller measures signals, each one whole period of its excitation.
        period: of sampling [s].
    """
    V = _spectra([record.measured for record in records])
    U = _spectra([record.command for record in records])
    # C V = U, solved as Vᵀ Cᵀ = Uᵀ
    transposed = np.linalg.solve(V.mT, U.mT)
    response = transposed.mT
    length = len(records[0].measured)
    harmonics = np.arange(1, length // 2 + 1)
    frequency = 2.0 * np.pi * harmonics / (length * period)
    return np.asarray(frequency, np.float64), np.asarray(response)


def _spectra(signals: list[FloatArray]) -> ComplexArray:
    """Return the spectra of signals, (periods, c) each, without their means: (k, c, signals)."""
    return np.stack([np.fft.rfft(signal, axis=0)[1:] for signal in signals], axis=-1)


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
        if not self.stable:
            return 0.0
        return self.arm.latency + self.margins.delay_margin_s

    def gain_limits(self, latencies: Sequence[float]) -> FloatArray:
        """Return the least factor on the command at which the loop becomes unstable, at each latency [s]."""
        limits = []
        for latency in latencies:
            later = replace(self.arm, latency=latency)
            limits.append(replace(self.response, arm=later).gain_limit())
        return np.array(limits)

    def sensitivity_peaks(self, factors: FloatArray, latencies: Sequence[float]) -> FloatArray:
        """Return M_s with the command multiplied by each factor, at each latency [s], (factors, latencies)."""
        peaks = np.full((len(factors), len(latencies)), np.inf)
        every = max(1, len(self.response.frequency) // 128)
        # Thinned from the upper end, so that the Nyquist frequency stays.
        frequency = self.response.frequency[::-every][::-1]
        controller = self.response.controller[::-every][::-1]
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
        resolved: the run whose first seconds warm the controller up.
        source: the Jacobian at which the estimator of a composed controller is frozen.
        identify: identify a composed controller as any other, from logged data, while its estimator goes on learning.

    Raises:
        ConfigurationError: a name or a setting that cannot be used.
        RunFault: the controller cannot go on, or an unstable loop whose controller has to be identified.
    """
    with one_thread():
        warm = warm_up(resolved)
        arm = warm.arm
        m, n = arm.jacobian.shape
        steps = round(STEP_DURATION / arm.period)
        if isinstance(warm.controller, ServoController) and not identify:
            model = "linearised"
            controller = linearise(*at_rest(warm, source))
            closed = closed_loop(arm.matrices(), controller)
            stable = is_stable(closed.A)
            response = linear_response(controller, arm)
            step = closed.step(m, arm.period, steps)
        else:
            model = "identified"
            loop = SmallMotions(warm.controller, arm, warm.rest)
            stable = True  # an unstable one has ended the experiments
            response = LoopResponse(*controller_response(excite(loop, m + n), arm.period), arm)
            step = step_responses(loop, m, n, steps)
        name = resolved.request.controller
        return LoopAnalysis(name, model, stable, response.margins(), response, step)


def delay_margin(
    config: AnyConfig,
    name: str,
    run: RunSettings | None = None,
    plant: KinematicConfig | None = None,
    robot: str = DEFAULT_ROBOT,
) -> float:
    """Return the further latency of the camera at which the loop of a composed controller becomes unstable [s].

    The estimator is frozen at the true Jacobian of the nominal robot, where a move of the warm-up ended. A call takes
    20 ms for a controller without aids, 100 to 200 ms for one with all of them.

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
        sensing = replace(plant.sensing, latency=latency)
        margin = delay_margin(config, name, run, replace(plant, sensing=sensing), robot)
        if margin == 0.0:
            return min(border, latency)
        border = latency + margin
    if border > latencies[-1]:
        return np.inf
    return border


def linear_response(controller: StateSpace, arm: ArmModel, points: int = POINTS) -> LoopResponse:
    """Return the frequency response of a linear controller on an arm, at a number of frequencies."""
    axis = frequencies(arm.period, points)
    response = controller.response(np.exp(1j * axis * arm.period))
    measured = sum(arm.jacobian.shape)  # inputs before the references
    return LoopResponse(axis, response[:, :, :measured], arm)


def loop_table(loops: Sequence[LoopAnalysis]) -> pd.DataFrame:
    """Return a row for each loop; margins of a loop that is unstable are NaN, its limits 0."""
    rows = []
    for loop in loops:
        numbers = asdict(loop.margins)
        numbers["overshoot"] = max(0.0, float(loop.step.max()) - 1.0)
        if not loop.stable:
            numbers = dict.fromkeys(numbers, np.nan)
        row = {"controller": loop.name, "model": loop.model, "stable": loop.stable}
        rows.append({**row, **numbers, "latency_limit_s": loop.latency_limit})
    return pd.DataFrame(rows)


def printed(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table as text for a terminal."""
    text: dict[str, Any] = {"controller": table["controller"]}
    for heading, (name, factor, digits) in MARGIN_COLUMNS.items():
        text[heading] = [number(factor * value, f".{digits}f") for value in table[name]]
    return pd.DataFrame(text)
