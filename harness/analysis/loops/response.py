"""Frequency responses: of any controller from logged data, and the margins of a loop with several channels.

**Identification.** The controller runs in closed loop with the linear arm around a rest. One after the other, a
multisine d_i is added to each signal that it measures, the features and the joint positions. Of each experiment the
last period is logged, of which the discrete Fourier transforms are exact, as everything in it is periodic:

    U(ω) = C(ω) V(ω)   ⇒   C(ω) = U(ω) V(ω)⁻¹

with U (n, m + n) the commands and V (m + n, m + n) the measured signals, a column an experiment. Schoukens and
Pintelon, *System Identification: A Frequency Domain Approach*, chapters 2 and 5. The reference is constant, so that a
feedforward of it does not pass for feedback. Adaptation in the small motions is part of the response.

**Margins.** With the loop L(z) broken at one place, its characteristic loci λ_i(ω) are the eigenvalues of
L(e^{jω dt}). The closed loop is at the border of stability where a locus passes −1, so that for the same change of all
channels at once exactly

    gain margin      1/|λ|      where arg λ = −π
    phase margin     arg λ + π  where |λ| = 1
    delay margin     (arg λ + π mod 2π)/ω   where |λ| = 1

and, for channels that change each by itself, with S = (I + L)⁻¹ and T = L S,

    sensitivity peak M_s = max σ̄(S),     disk margin α = 1 / max σ̄((S − T)/2)

α is the balanced one for unstructured changes: a lower bound of that for diagonal ones, and equal to it in one channel.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, final

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from servobench.controllers.controller import Controller
from servobench.harness.analysis.loops.linearisation import Rest
from servobench.harness.analysis.loops.systems import ArmModel, ComplexArray, StateSpace
from servobench.harness.run.loop import LoopSettings, Rollout, periods
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ControllerDiverged
from servobench.plant.contract.signals import Command, Observation, Truth

LENGTH = 256  # [periods] of the multisine
AMPLITUDE = 2e-4  # [m] and [rad] root mean square of the multisine
SETTLING = 100  # [periods] of rest before the experiments
MAX_MOTION = 0.1  # [m] beyond it a loop is not at small motions any more
MIN_FREQUENCY = 1e-3  # [1] lowest frequency, as a share of the Nyquist frequency
POINTS = 400  # of the frequency axis
NEGLIGIBLE = 1e-6  # [1] a locus that stays below this never matters


class Record(NamedTuple):
    """The logged signals of one experiment.

    Attributes:
        measured: features and joint positions as the controller saw them, as deviations, (periods, m + n).
        command: (periods, n) [rad/s].
    """

    measured: FloatArray
    command: FloatArray


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
                raise ControllerDiverged(f"the loop is unstable: {MAX_MOTION} m were exceeded in small motions")
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
        rollout = Rollout(self._arm, self._arm.excite(added), rows, LoopSettings(len(added), self._rest.preview))
        command = [period.command.joint_velocity for period in periods(rollout, self._controller)]
        return Record(np.array(self._arm.measured), np.array(command))

    def tried(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Return the record of `run`, and restore the state from before it."""
        controller, arm = self._controller.save(), self._arm.save()
        record = self.run(added, desired)
        self._controller.restore(controller)
        self._arm.restore(arm)
        return record


def multisine(length: int, amplitude: float) -> FloatArray:
    """Return one period of equal sines at all harmonics with Schroeder's phases, (length,), without a mean."""
    harmonics = np.arange(1, length // 2 + 1)
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    spectrum[1:] = np.exp(-1j * np.pi * harmonics * (harmonics - 1) / len(harmonics))
    spectrum[-1] = 1.0  # real at the Nyquist frequency
    signal = np.fft.irfft(spectrum, length)
    return np.asarray(amplitude * signal / np.sqrt(np.mean(signal**2)))


def excite(loop: SmallMotions, inputs: int, length: int = LENGTH, amplitude: float = AMPLITUDE) -> list[Record]:
    """Return an experiment for each of the signals that the controller measures: its second period, less the rest."""
    signal = np.tile(multisine(length, amplitude), 2)
    rest = loop.tried(np.zeros((len(signal), inputs)))
    excited = [loop.tried(np.outer(signal, each)) for each in np.eye(inputs)]
    return [Record(each.measured[length:] - rest.measured[length:], each.command[length:] - rest.command[length:])
            for each in excited]  # fmt: skip


def step_responses(loop: SmallMotions, m: int, n: int, periods: int, amplitude: float = AMPLITUDE) -> FloatArray:
    """Return each feature after a unit step of its own reference, (periods, m), measured in small motions."""
    nothing = np.zeros((periods, m + n))
    rest = loop.tried(nothing).measured
    moved = [loop.tried(nothing, amplitude * each).measured for each in np.eye(m)]
    return np.stack([(each - rest)[:, i] / amplitude for i, each in enumerate(moved)], axis=-1)


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


def simulated_step(closed: StateSpace, outputs: int, period: float, periods: int) -> FloatArray:
    """Return each feature after a unit step of its own reference, (periods, outputs), by python-control."""
    import control  # noqa: PLC0415 - costs a second, so it is imported where it is used

    system = closed.as_control(period)[:outputs, :]
    times = np.arange(periods) * period
    return np.stack(
        [np.asarray(control.step_response(system, times, input=i).outputs)[i, 0] for i in range(outputs)], axis=-1
    )


@dataclass(frozen=True)
class Margins:
    """The margins of a loop.

    Attributes:
        gain: the factor on the command above 1 at which the loop becomes unstable; inf if there is none.
        gain_reduction: the factor below 1 at which it becomes unstable; 0 if there is none.
        phase: [rad], of all features together; inf where no locus crosses the unit circle.
        delay: additional latency of the camera at which the loop becomes unstable [s]; inf if there is none.
        crossover: largest frequency at which a locus at the feature crosses the unit circle [rad/s]; 0 if none does.
        sensitivity_peak: M_s, at the feature [1].
        complementary_peak: max σ̄(T), at the feature [1].
        disk: α, at the feature [1].
    """

    gain: float
    gain_reduction: float
    phase: float
    delay: float
    crossover: float
    sensitivity_peak: float
    complementary_peak: float
    disk: float


def frequencies(period: float, points: int = POINTS) -> FloatArray:
    """Return a logarithmic axis up to the Nyquist frequency, (points,) [rad/s]."""
    nyquist = np.pi / period
    return np.geomspace(MIN_FREQUENCY * nyquist, nyquist, points)


@dataclass(frozen=True, eq=False)
class LoopResponse:
    """The frequency response of a controller on an arm, and of the loops that they make.

    Attributes:
        frequency: ω, (k,) [rad/s], ascending.
        controller: from the measured feature and joint positions to the command, (k, n, m + n) [rad/s].
        arm: linear model of arm and camera.
    """

    frequency: FloatArray
    controller: ComplexArray
    arm: ArmModel

    @property
    def z(self) -> ComplexArray:
        """e^{jω dt}, (k,)."""
        return np.asarray(np.exp(1j * self.frequency * self.arm.period))

    def at_command(self) -> ComplexArray:
        """Return L broken at the command, (k, n, n)."""
        J, (exposed, joints) = self.arm.jacobian, self.arm.response(self.z)
        m = len(J)
        by_feature = exposed[:, None, None] * (self.controller[:, :, :m] @ J)
        return -by_feature - joints[:, None, None] * self.controller[:, :, m:]

    def at_feature(self) -> ComplexArray:
        """Return L broken at the measured feature, (k, m, m), with the joint positions fed back."""
        J, (exposed, joints) = self.arm.jacobian, self.arm.response(self.z)
        m, n = J.shape
        inner = np.eye(n) - joints[:, None, None] * self.controller[:, :, m:]
        command = np.linalg.solve(inner, self.controller[:, :, :m])
        return np.asarray(-exposed[:, None, None] * (J @ command))

    def margins(self) -> Margins:
        """Return the margins: of the gain at the command, of the rest at the measured feature."""
        gain = gain_crossings(self.at_command())
        feature = self.at_feature()
        phase, where = phase_crossings(feature, self.frequency)
        every = np.eye(feature.shape[-1])
        S = np.linalg.inv(every + feature)
        return Margins(
            gain=float(gain[gain >= 1.0].min(initial=np.inf)),
            gain_reduction=float(gain[gain < 1.0].max(initial=0.0)),
            phase=float(np.minimum(phase, 2.0 * np.pi - phase).min(initial=np.inf)),
            delay=float((phase / where).min(initial=np.inf)),
            crossover=float(where.max(initial=0.0)),
            sensitivity_peak=_peak(S),
            complementary_peak=_peak(every - S),
            disk=1.0 / _peak(S - every / 2.0),
        )

    def delay_margin(self) -> float:
        """Return the additional latency at which the loop becomes unstable [s], inf if there is none."""
        phase, where = phase_crossings(self.at_feature(), self.frequency)
        return float((phase / where).min(initial=np.inf))

    def gain_limit(self) -> float:
        """Return the least factor on the command at which the loop becomes unstable, inf if there is none.

        For a loop that is stable at small gains, whether or not it is at the present one.
        """
        return float(gain_crossings(self.at_command()).min(initial=np.inf))


def loci(L: ComplexArray) -> ComplexArray:
    """Return the eigenvalues of L, (k, c, c), ordered so that each column, (k, c), is one smooth curve."""
    values = np.linalg.eigvals(L)
    for before, now in pairwise(values):
        _, order = linear_sum_assignment(np.abs(before[:, None] - now[None, :]))
        now[:] = now[order]
    return np.asarray(values)


def gain_crossings(L: ComplexArray) -> FloatArray:
    """Return the factors at which a locus passes −1, (crossings,)."""
    values = _relevant(loci(L))
    before, after = values[:-1], values[1:]
    crosses = (np.sign(before.imag) != np.sign(after.imag)) & (before.imag != after.imag)
    share = before.imag[crosses] / (before.imag[crosses] - after.imag[crosses])
    real = before.real[crosses] + share * (after.real[crosses] - before.real[crosses])
    last = values[-1]  # at the Nyquist frequency the loci are real
    ends = last.real[np.abs(last.imag) <= NEGLIGIBLE * np.abs(last)]
    real = np.concatenate([real, ends])
    return -1.0 / real[real < 0.0]


def phase_crossings(L: ComplexArray, frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where loci cross the unit circle: arg λ + π in [0, 2π) [rad] and ω [rad/s], (crossings,) each."""
    values = _relevant(loci(L))
    level = np.log(np.abs(values))
    crosses = np.sign(level[:-1]) != np.sign(level[1:])
    share = level[:-1][crosses] / (level[:-1][crosses] - level[1:][crosses])
    row, _ = np.nonzero(crosses)
    before, turn = np.angle(values[:-1][crosses]), np.angle(values[1:][crosses] / values[:-1][crosses])
    phase = np.mod(before + share * turn + np.pi, 2.0 * np.pi)
    where = frequency[row] * (frequency[row + 1] / frequency[row]) ** share
    return phase, where


def _relevant(values: ComplexArray) -> ComplexArray:
    """Return the loci that are not zero by construction, as those of the null space are."""
    return values[:, np.abs(values).max(axis=0) > NEGLIGIBLE]


def _peak(response: npt.NDArray[Any]) -> float:
    return float(np.linalg.norm(response, ord=2, axis=(-2, -1)).max())
