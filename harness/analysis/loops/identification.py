"""The frequency response of any controller from logged data: small motions under an excitation.

The controller runs in closed loop with the linear arm around a rest. One after the other, a multisine d_i is added to
each signal that it measures, the features and the joint positions. Of each experiment the last period is logged, of
which the discrete Fourier transforms are exact, as everything in it is periodic:

    U(ω) = C(ω) V(ω)   ⇒   C(ω) = U(ω) V(ω)⁻¹

with U (n, m + n) the commands and V (m + n, m + n) what the controller measured, a column an experiment. Schoukens and
Pintelon, *System Identification: A Frequency Domain Approach*, chapters 2 and 5. The reference is constant, so that a
feedforward of it does not pass for feedback. What adapts in the small motions is part of the response.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servobench.controllers.controller import Controller
from servobench.harness.analysis.loops.arm import ArmModel
from servobench.harness.analysis.loops.linearise import Rest
from servobench.harness.analysis.loops.matrices import ComplexArray, StateSpace
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ControllerDiverged
from servobench.plant.contract.signals import Observation

LENGTH = 256  # [periods] of the multisine
AMPLITUDE = 2e-4  # [m] and [rad] root mean square of the multisine
SETTLING = 100  # [periods] of rest before the experiments
LARGEST_MOTION = 0.1  # [m] beyond it a loop is not at small motions any more


class Record(NamedTuple):
    """The logged signals of one experiment.

    Attributes:
        measured: features and joint positions as the controller saw them, as deviations, (periods, m + n).
        command: (periods, n) [rad/s].
    """

    measured: FloatArray
    command: FloatArray


class SmallMotions:
    """A controller in closed loop with the linear arm around a rest."""

    def __init__(self, controller: Controller, arm: ArmModel, rest: Rest) -> None:
        """Let the controller settle; it is left in the state that it has then.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        self._controller, self._rest, self._period = controller, rest, arm.period
        self._plant = arm.matrices()
        self._m = len(arm.jacobian)
        self._x, self._k = np.zeros(len(self._plant.A)), 0
        self._reference = rest.reference(rest.feature)
        self.run(np.zeros((SETTLING, len(self._plant.C))))

    def run(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Go on with signals added to the measurements, (periods, m + n).

        Args:
            added: m and rad.
            desired: (m,) [m], a deviation of the reference; None for none.

        Raises:
            ControllerDiverged: the loop is not stable.
        """
        reference = self._reference if desired is None else self._reference + desired
        measured, command = np.zeros(added.shape), np.zeros((len(added), self._plant.B.shape[1]))
        for k, offset in enumerate(added):
            measured[k] = self._plant.C @ self._x + offset
            if not np.abs(measured[k, : self._m]).max() < LARGEST_MOTION:
                raise ControllerDiverged(f"the loop is unstable: {LARGEST_MOTION} m were exceeded in small motions")
            command[k] = self._controller.step(self._observation(measured[k]), reference).joint_velocity
            self._x = self._plant.A @ self._x + self._plant.B @ command[k]
            self._k += 1
        return Record(measured, command)

    def tried(self, added: FloatArray, desired: FloatArray | None = None) -> Record:
        """Return what `run` does, and go on as if it had not been."""
        saved, x, k = self._controller.save(), self._x, self._k
        record = self.run(added, desired)
        self._controller.restore(saved)
        self._x, self._k = x, k
        return record

    def _observation(self, deviation: FloatArray) -> Observation:
        rest, m = self._rest, self._m
        return Observation(
            rest.time + self._k * self._period, rest.joint_position + deviation[m:], rest.feature + deviation[:m]
        )


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
