"""Discrete linear systems as plain float64 matrices, x₊ = A x + B u, y = C x + D u, and the one of arm and camera.

Around a rest, with command delay, joint lag, integrator, Jacobian and latency, arm and camera are

    q̇ = v,   τ v̇ = u(t − D) − v,   y(t) = J q(t − ℓ)        sampled every dt, u held over a period

Neither the command delay D nor the latency ℓ needs to be a multiple of the period dt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.kinematic import discretise_lag

ComplexArray = npt.NDArray[np.complex128]
STABILITY_TOLERANCE = 1e-4  # [1] of a pole's modulus above 1, which neutral modes have by rounding of differences
WHOLE = 1e-9  # [1] a share of a period below which a delay is a whole number of periods


class StateSpace(NamedTuple):
    """A discrete linear system.

    Attributes:
        A: (s, s).
        B: (s, inputs).
        C: (outputs, s).
        D: (outputs, inputs).
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return C (zI − A)⁻¹ B + D, (k, outputs, inputs), at the points z, (k,), of the complex plane."""
        resolvent = z[:, None, None] * np.eye(len(self.A)) - self.A
        return np.asarray(self.C @ np.linalg.solve(resolvent, self.B.astype(np.complex128)) + self.D)

    def as_control(self, period: float) -> Any:  # noqa: ANN401 - python-control has no types
        """Return the system as a `control.StateSpace` with the sampling period [s]."""
        import control  # noqa: PLC0415 - costs a second, so it is imported where it is used

        return control.ss(*self, period)


def closed_loop(plant: StateSpace, controller: StateSpace, gain: float = 1.0) -> StateSpace:
    """Return the loop of a strictly proper plant with a controller whose command is multiplied by `gain`.

    Args:
        plant: from the command u to the measured signals, D = 0.
        controller: from measurements and then references to u.
        gain: factor on u between controller and plant.

    Returns:
        From the references to the measured signals; the states are those of the plant, then the controller's.
    """
    measured = len(plant.C)
    B, D = controller.B, controller.D
    by_plant, by_law = D[:, :measured] @ plant.C, controller.C
    A = np.block(
        [
            [plant.A + gain * plant.B @ by_plant, gain * plant.B @ by_law],
            [B[:, :measured] @ plant.C, controller.A],
        ]
    )
    references = np.vstack([gain * plant.B @ D[:, measured:], B[:, measured:]])
    C = np.hstack([plant.C, np.zeros((measured, len(controller.A)))])
    return StateSpace(A, references, C, np.zeros((measured, references.shape[1])))


def decay(A: FloatArray) -> float:
    """Return the spectral radius of A, the factor of the slowest or the growing mode in a period; 0 without states."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def is_stable(A: FloatArray) -> bool:
    """Return whether no mode grows; neutral ones, such as a rest of the arm in any null-space posture, may be there."""
    return decay(A) <= 1.0 + STABILITY_TOLERANCE


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Arm and camera around a rest.

    Attributes:
        jacobian: J, (m, n), unit of the feature per rad.
        period: dt [s].
        lag: τ [s]; 0 for joints that have the commanded velocity at once.
        command_delay: D [s].
        latency: ℓ [s].
    """

    jacobian: FloatArray
    period: float
    lag: float
    command_delay: float
    latency: float

    def matrices(self) -> StateSpace:
        """Return the system from u, (n,) rad/s, to deviations of measured feature and joint positions, (m + n,)."""
        joint, (m, n) = self._joint(), self.jacobian.shape
        late, _ = split(self.latency, self.period)
        size, every = len(joint.A), np.eye(n)
        A, B = np.kron(joint.A, every), np.kron(joint.B, every)
        exposed, positions = np.kron(joint.C[:1], self.jacobian), np.kron(joint.C[1:], every)
        line = np.eye(late * m, k=-m)  # frames under way, the newest first
        entry = np.zeros((late * m, size * n))
        entry[:m] = exposed[: late * m]
        A = np.block([[A, np.zeros((size * n, late * m))], [entry, line]])
        B = np.vstack([B, np.zeros((late * m, n))])
        oldest = np.hstack([np.zeros((m, size * n + late * m - m)), np.eye(m)])
        feature = oldest if late else exposed
        C = np.vstack([feature, np.hstack([positions, np.zeros((n, late * m))])])
        return StateSpace(np.asarray(A, np.float64), np.asarray(B, np.float64), C, np.zeros((m + n, n)))

    def response(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return how a joint answers its command at z, (k,): its position at the exposure and now, (k,) each."""
        joint = self._joint().response(z)[:, :, 0]
        late, _ = split(self.latency, self.period)
        return joint[:, 0] * z ** (-late), joint[:, 1]

    def _joint(self) -> StateSpace:
        """Return the system of one joint, from u(k) to its positions at the last exposure and now.

        States: q, v, the commands u(k−1), u(k−2), … under way, and q at the exposure between the last two instants
        where the latency has a part of a period.
        """
        dt = self.period
        waiting, part = split(self.command_delay, dt)
        _, early = split(self.latency, dt)
        queue = waiting + (part > 0.0)
        until_now = self._advance(dt, waiting, part)
        size = 2 + queue + (early > 0.0)
        A, B, C = np.zeros((size, size)), np.zeros((size, 1)), np.zeros((2, size))
        A[:2, : 2 + queue], B[:2] = until_now
        for i in range(queue):
            A[2 + i, 1 + i], B[2 + i] = float(i > 0), float(i == 0)
        if early > 0.0:
            from_state, from_command = self._advance(dt - early, waiting, part)
            A[-1, : 2 + queue], B[-1] = from_state[0], from_command[0]
        C[0, -1 if early > 0.0 else 0], C[1, 0] = 1.0, 1.0
        return StateSpace(A, B, C, np.zeros((2, 1)))

    def _advance(self, time: float, waiting: int, part: float) -> _Advance:
        """Return how (q, v) `time` [s] into a period follow from q, v, the waiting commands, and u(k)."""
        queue = waiting + (part > 0.0)
        before = min(time, part)  # the command of the period before still acts
        first, by_first = discretise_lag(self.lag, before) if before > 0.0 else (np.eye(2), np.zeros(2))
        after = time - before
        then, by_then = discretise_lag(self.lag, after) if after > 0.0 else (np.eye(2), np.zeros(2))
        state, command = np.zeros((2, 2 + queue)), np.zeros((2, 1))
        state[:, :2] = then @ first
        if part > 0.0:
            state[:, 2 + waiting] += then @ by_first
        if waiting:
            state[:, 1 + waiting] += by_then
        else:
            command[:, 0] = by_then
        return _Advance(state, command)


class _Advance(NamedTuple):
    from_state: FloatArray  # (2, 2 + queue)
    from_command: FloatArray  # (2, 1)


def split(delay: float, period: float) -> tuple[int, float]:
    """Return a delay [s] as whole periods and the rest [s]."""
    periods = delay / period
    whole = round(periods)
    if abs(periods - whole) < WHOLE:
        return whole, 0.0
    return int(periods), delay - int(periods) * period
