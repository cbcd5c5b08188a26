"""Discrete linear systems, x₊ = A x + B u, y = C x + D u; arm and camera as one; and the margins of loops.

Around a rest, with command delay, joint lag, integrator, Jacobian and latency, arm and camera are

    q̇ = v,   τ v̇ = u(t − D) − v,   y(t) = J q(t − ℓ)        sampled every dt, u held over a period

Neither the command delay D nor the latency ℓ needs to be a multiple of the period dt.

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

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment

from servobench.plant.contract.checks import FloatArray
from servobench.plant.kinematic import discretise_lag

ComplexArray = npt.NDArray[np.complex128]
STABILITY_TOLERANCE = (
    1e-4  # [1] of a pole's modulus above 1, which neutral modes have by rounding of differences
)
MIN_FREQUENCY = 1e-3  # [1] lowest frequency, as a share of the Nyquist frequency
POINTS = 400  # of the frequency axis
NEGLIGIBLE = 1e-6  # [1] a locus that stays below this never matters
WHOLE = 1e-9  # [1] a share of a period below which a delay is a whole number of periods


class StateSpace(NamedTuple):
    """A discrete linear system."""

    A: FloatArray  # (s, s)
    B: FloatArray  # (s, inputs)
    C: FloatArray  # (outputs, s)
    D: FloatArray  # (outputs, inputs)

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return C (zI − A)⁻¹ B + D, (k, outputs, inputs), at the points z, (k,), of the complex plane."""
        resolvent = z[:, None, None] * np.eye(len(self.A)) - self.A
        return np.asarray(
            self.C @ np.linalg.solve(resolvent, self.B.astype(np.complex128)) + self.D
        )

    def step(self, outputs: int, period: float, periods: int) -> FloatArray:
        """Return each of the first outputs after a unit step of the input with its number, (periods, outputs)."""
        import control  # noqa: PLC0415 - costs a second, so it is imported where it is used

        system, times = control.ss(*self, period), np.arange(periods) * period
        steps = [
            control.step_response(system, times, input=i, output=i).outputs for i in range(outputs)
        ]
        return np.stack([np.ravel(step) for step in steps], axis=-1)


def closed_loop(plant: StateSpace, controller: StateSpace) -> StateSpace:
    """Return the loop of a strictly proper plant with a controller.

    Args:
        plant: from the command u to the measured signals, D = 0.
        controller: from measurements and then references to u.

    Returns:
        From the references to the measured signals; the states are those of the plant, then the controller's.
    """
    measured = len(plant.C)
    B, D = controller.B, controller.D
    by_plant, by_law = D[:, :measured] @ plant.C, controller.C
    A = np.block(
        [
            [plant.A + plant.B @ by_plant, plant.B @ by_law],
            [B[:, :measured] @ plant.C, controller.A],
        ]
    )
    references = np.vstack([plant.B @ D[:, measured:], B[:, measured:]])
    C = np.hstack([plant.C, np.zeros((measured, len(controller.A)))])
    return StateSpace(A, references, C, np.zeros((measured, references.shape[1])))


def is_stable(A: FloatArray) -> bool:
    """Return whether no mode grows; neutral ones, such as a rest of the arm in any null-space posture, may be there."""
    return bool(np.abs(np.linalg.eigvals(A)).max(initial=0.0) <= 1.0 + STABILITY_TOLERANCE)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Arm and camera around a rest."""

    jacobian: FloatArray  # J, (m, n), unit of the feature per rad
    period: float  # dt [s]
    lag: float  # τ [s]; 0 for joints that have the commanded velocity at once
    command_delay: float  # D [s]
    latency: float  # ℓ [s]
    age: float = 0.0  # by which frames are older on the mean, as they come less often than commands [s]; part of ℓ

    def matrices(self) -> StateSpace:
        """Return the system from u, (n,) rad/s, to deviations of measured feature and joint positions, (m + n,)."""
        joint, (m, n) = self._joint(), self.jacobian.shape
        # Numbers of the frames under way
        waiting = split(self.latency + self.age, self.period)[0] * m
        joints, B, positions = (
            np.kron(each, np.eye(n)) for each in (joint.A, joint.B, joint.C[1:])
        )
        # Exposed now, then under way
        frames = block_diag(np.kron(joint.C[:1], self.jacobian), np.eye(waiting))
        A = np.vstack([np.pad(joints, ((0, 0), (0, waiting))), frames[:waiting]])
        C = np.vstack([frames[waiting:], np.pad(positions, ((0, 0), (0, waiting)))])
        return StateSpace(A, np.pad(B, ((0, waiting), (0, 0))), C, np.zeros((m + n, n)))

    def response(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return how a joint answers its command at z, (k,): its position at the exposure and now, (k,) each."""
        joint = self._joint().response(z)[:, :, 0]
        late, _ = split(self.latency + self.age, self.period)
        return joint[:, 0] * z ** (-late), joint[:, 1]

    def _joint(self) -> StateSpace:
        """Return the system of one joint, from u(k) to its positions at the last exposure and now.

        States: q, v, the commands u(k−1), u(k−2), … under way, and q at the exposure between the last two instants
        where the latency has a part of a period.
        """
        waiting, part = split(self.command_delay, self.period)
        _, early = split(self.latency + self.age, self.period)
        queue = waiting + (part > 0.0)
        every = np.eye(3 + queue + (early > 0.0))  # a row for each state, and the last one for u(k)
        position, motion, commands = (
            every[0],
            every[:2],
            np.vstack([every[-1], every[2 : 2 + queue]]),
        )

        def after(time: float) -> FloatArray:
            """Return q and v `time` [s] into the period, of which the command of the period before has its part."""
            state, before = motion, min(time, part)
            for span, command in ((before, commands[-1]), (time - before, commands[waiting])):
                if span > 0.0:
                    A, b = discretise_lag(self.lag, span)
                    state = A @ state + np.outer(b, command)
            return state

        rows = [after(self.period), commands[:queue]]
        exposed = position
        if early > 0.0:
            rows.append(after(self.period - early)[:1])
            exposed = every[-2]
        new = np.vstack(rows)
        return StateSpace(
            new[:, :-1], new[:, -1:], np.vstack([exposed, position])[:, :-1], np.zeros((2, 1))
        )


def split(delay: float, period: float) -> tuple[int, float]:
    """Return a delay [s] as whole periods and the rest [s]."""
    periods = delay / period
    whole = round(periods)
    if abs(periods - whole) < WHOLE:
        return whole, 0.0
    return int(periods), delay - int(periods) * period


@dataclass(frozen=True)
class Margins:
    """The margins of a loop, by their columns in the table of loops."""

    gain_margin: float  # the factor on the command above 1 at which the loop becomes unstable; inf if there is none
    gain_reduction_margin: (
        float  # the factor below 1 at which it becomes unstable; 0 if there is none
    )
    phase_margin_deg: float  # of all features together; inf where no locus crosses the unit circle
    delay_margin_s: float  # additional latency of the camera at which the loop becomes unstable; inf if there is none
    crossover_rad_s: float  # largest frequency at which a locus at the feature crosses the unit circle; 0 if none
    sensitivity_peak: float  # M_s, at the feature [1]
    # max σ̄(T), at the feature [1]; up to 4 % low for a slow loop, whose peak, T = I at rest, is below the axis
    complementary_peak: float
    disk_margin: float  # α, at the feature [1]


def frequencies(period: float, points: int = POINTS) -> FloatArray:
    """Return a logarithmic axis up to the Nyquist frequency, (points,) [rad/s]."""
    nyquist = np.pi / period
    return np.geomspace(MIN_FREQUENCY * nyquist, nyquist, points)


@dataclass(frozen=True, eq=False)
class LoopResponse:
    """The frequency response of a controller on an arm, and of the loops that they make."""

    frequency: FloatArray  # ω, (k,) [rad/s], ascending
    controller: ComplexArray  # from the measured feature and joint positions to the command, (k, n, m + n) [rad/s]
    arm: ArmModel  # linear model of arm and camera

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
        gain, L = gain_crossings(self.at_command()), self.at_feature()
        phase, where = phase_crossings(L, self.frequency)
        S = sensitivity(L)
        every = np.eye(S.shape[-1])
        return Margins(
            gain_margin=float(gain[gain >= 1.0].min(initial=np.inf)),
            gain_reduction_margin=float(gain[gain < 1.0].max(initial=0.0)),
            phase_margin_deg=float(
                np.rad2deg(np.minimum(phase, 2.0 * np.pi - phase).min(initial=np.inf))
            ),
            delay_margin_s=float((phase / where).min(initial=np.inf)),
            crossover_rad_s=float(where.max(initial=0.0)),
            sensitivity_peak=float(largest_gain(S).max()),
            complementary_peak=float(largest_gain(every - S).max()),
            disk_margin=1.0 / float(largest_gain(S - every / 2.0).max()),
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


def sensitivity(L: ComplexArray) -> ComplexArray:
    """Return S = (I + L)⁻¹, (k, c, c), of L, (k, c, c)."""
    return np.asarray(np.linalg.inv(np.eye(L.shape[-1]) + L))


def largest_gain(response: ComplexArray) -> FloatArray:
    """Return the largest singular value at each frequency, (k,)."""
    return np.asarray(np.linalg.norm(response, ord=2, axis=(-2, -1)), np.float64)


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
    before, turn = (
        np.angle(values[:-1][crosses]),
        np.angle(values[1:][crosses] / values[:-1][crosses]),
    )
    phase = np.mod(before + share * turn + np.pi, 2.0 * np.pi)
    where = frequency[row] * (frequency[row + 1] / frequency[row]) ** share
    return phase, where


def _relevant(values: ComplexArray) -> ComplexArray:
    """Return the loci that are not zero by construction, as those of the null space are."""
    return values[:, np.abs(values).max(axis=0) > NEGLIGIBLE]
