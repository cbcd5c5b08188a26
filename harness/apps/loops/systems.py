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
# A pole's modulus may exceed 1 by this: neutral modes do, by the rounding of differences.
STABILITY_TOLERANCE = 1e-4  # [1]
MIN_FREQUENCY = 1e-3  # [1] lowest frequency, as a share of the Nyquist frequency
POINTS = 400  # number of frequencies on the axis
NEGLIGIBLE_LOCUS = 1e-6  # [1] a locus that stays below this never matters
WHOLE_PERIOD_TOLERANCE = 1e-9  # [1] share of a period within which a delay counts as whole periods


class StateSpace(NamedTuple):
    """A discrete linear system."""

    A: FloatArray  # (s, s)
    B: FloatArray  # (s, inputs)
    C: FloatArray  # (outputs, s)
    D: FloatArray  # (outputs, inputs)

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return C (zI − A)⁻¹ B + D, (k, outputs, inputs), at the points z, (k,), of the complex plane."""
        pencil = z[:, None, None] * np.eye(len(self.A)) - self.A  # zI − A
        states = np.linalg.solve(pencil, self.B.astype(np.complex128))
        return np.asarray(self.C @ states + self.D)

    def step(self, outputs: int, period: float, periods: int) -> FloatArray:
        """Return each of the first outputs after a unit step of the input with its number, (periods, outputs)."""
        import control  # noqa: PLC0415 - costs a second, so it is imported where it is used

        system = control.ss(*self, period)
        times = np.arange(periods) * period
        steps = []
        for i in range(outputs):
            response = control.step_response(system, times, input=i, output=i)
            steps.append(np.ravel(response.outputs))
        return np.stack(steps, axis=-1)


def closed_loop(plant: StateSpace, controller: StateSpace) -> StateSpace:
    """Return the loop of a strictly proper plant with a controller.

    Args:
        plant: from the command u to the measured signals, D = 0.
        controller: from measurements and then references to u.

    Returns:
        From the references to the measured signals; the states are those of the plant, then the controller's.
    """
    measured = len(plant.C)
    # The controller's inputs are the measured signals and then the references.
    B_y, B_r = np.split(controller.B, [measured], axis=1)
    D_y, D_r = np.split(controller.D, [measured], axis=1)
    by_plant = D_y @ plant.C  # u from the plant's states
    plant_rows = [plant.A + plant.B @ by_plant, plant.B @ controller.C]
    controller_rows = [B_y @ plant.C, controller.A]
    A = np.block([plant_rows, controller_rows])
    B = np.vstack([plant.B @ D_r, B_r])
    C = np.hstack([plant.C, np.zeros((measured, len(controller.A)))])
    return StateSpace(A, B, C, np.zeros((measured, B.shape[1])))


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
        joint = self._joint()
        m, n = self.jacobian.shape
        every_joint = np.eye(n)
        joints = np.kron(joint.A, every_joint)
        B = np.kron(joint.B, every_joint)
        positions = np.kron(joint.C[1:], every_joint)
        exposed = np.kron(joint.C[:1], self.jacobian)
        # States behind those of the joints: the numbers of the frames under way, the newest first. The rows of `frames`
        # are the feature exposed now and these; all but the last frame wait on, the last one is measured.
        late, _ = split(self.latency + self.age, self.period)
        waiting = late * m
        frames = block_diag(exposed, np.eye(waiting))
        no_frames = ((0, 0), (0, waiting))
        A = np.vstack([np.pad(joints, no_frames), frames[:waiting]])

        C = np.vstack([frames[waiting:], np.pad(positions, no_frames)])
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
        position = every[0]
        motion = every[:2]
        commands = np.vstack([every[-1], every[2 : 2 + queue]])  # u(k), u(k−1), …

        def after(time: float) -> FloatArray:
            """Return q and v `time` [s] into the period, of which the command of the period before has its part."""
            before = min(time, part)
            older = (before, commands[-1])
            newer = (time - before, commands[waiting])
            state = motion
            for span, command in (older, newer):
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
        shown = np.vstack([exposed, position])
        # The last column belongs to u(k), which is the input and no state.
        return StateSpace(new[:, :-1], new[:, -1:], shown[:, :-1], np.zeros((2, 1)))


def split(delay: float, period: float) -> tuple[int, float]:
    """Return a delay [s] as whole periods and the rest [s]."""
    periods = delay / period
    whole = round(periods)
    if abs(periods - whole) < WHOLE_PERIOD_TOLERANCE:
        return whole, 0.0
    complete = int(periods)
    return complete, delay - complete * period


@dataclass(frozen=True)
class Margins:
    """The margins of a loop, by their columns in the table of loops."""

    gain_margin: float  # the factor on the command above 1 at which the loop becomes unstable; inf if there is none
    gain_reduction_margin: float  # the factor below 1 at which it becomes unstable; 0 for none
    phase_margin_deg: float  # for all features together; inf where no locus crosses the unit circle
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

    def at_command(self) -> ComplexArray:
        """Return L broken at the command, (k, n, n)."""
        from_feature, from_joints = self._paths()
        return -(from_feature @ self.arm.jacobian) - from_joints

    def at_feature(self) -> ComplexArray:
        """Return L broken at the measured feature, (k, m, m), with the joint positions fed back."""
        from_feature, from_joints = self._paths()
        inner = np.eye(from_joints.shape[-1]) - from_joints  # the loop over joint positions
        command = np.linalg.solve(inner, from_feature)
        return -(self.arm.jacobian @ command)

    def _paths(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the controller's response times a joint's, from feature (k, n, m) and joint positions (k, n, n)."""
        m = len(self.arm.jacobian)
        z = np.exp(1j * self.frequency * self.arm.period)
        exposed, joints = self.arm.response(z)
        from_feature = exposed[:, None, None] * self.controller[:, :, :m]
        from_joints = joints[:, None, None] * self.controller[:, :, m:]
        return from_feature, from_joints

    def margins(self) -> Margins:
        """Return the margins: of the gain at the command, of the rest at the measured feature."""
        gain = gain_crossings(self.at_command())
        L = self.at_feature()
        phase, where = phase_crossings(L, self.frequency)
        # Real loops have the conjugate locus at −ω, which is as far from −1 the other way round.
        least_phase = np.minimum(phase, 2.0 * np.pi - phase).min(initial=np.inf)
        S = sensitivity(L)
        one = np.eye(S.shape[-1])
        T = one - S
        half_difference = S - one / 2.0  # (S − T)/2
        return Margins(
            gain_margin=_least(gain[gain >= 1.0]),
            gain_reduction_margin=_greatest(gain[gain < 1.0]),
            phase_margin_deg=float(np.rad2deg(least_phase)),
            delay_margin_s=_least(phase / where),
            crossover_rad_s=_greatest(where),
            sensitivity_peak=_peak(S),
            complementary_peak=_peak(T),
            disk_margin=1.0 / _peak(half_difference),
        )

    def delay_margin(self) -> float:
        """Return the additional latency at which the loop becomes unstable [s], inf if there is none."""
        phase, where = phase_crossings(self.at_feature(), self.frequency)
        return _least(phase / where)

    def gain_limit(self) -> float:
        """Return the least factor on the command at which the loop becomes unstable, inf if there is none.

        For a loop that is stable at small gains, whether or not it is at the present one.
        """
        return _least(gain_crossings(self.at_command()))


def _least(values: FloatArray) -> float:
    """Return the least of some values, inf if there is none."""
    return float(values.min(initial=np.inf))


def _greatest(values: FloatArray) -> float:
    """Return the greatest of some values above 0, 0 if there is none."""
    return float(values.max(initial=0.0))


def _peak(response: ComplexArray) -> float:
    """Return the largest singular value over all frequencies."""
    return float(largest_gain(response).max())


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
        distance = np.abs(before[:, None] - now[None, :])
        _, order = linear_sum_assignment(distance)
        now[:] = now[order]  # in place: the next pair starts from this order
    return np.asarray(values)


class Crossings(NamedTuple):
    """Where loci change the sign of a level between two frequencies."""

    row: npt.NDArray[np.intp]  # index of the frequency before, (crossings,)
    before: ComplexArray  # locus at that frequency
    after: ComplexArray  # locus at the next one
    share: FloatArray  # part of the way between both, after which the level is 0


def _crossings(values: ComplexArray, level: FloatArray) -> Crossings:
    """Return where loci (k, c) change the sign of their level (k, c), which is taken as linear in between."""
    crosses = np.sign(level[:-1]) != np.sign(level[1:])
    low = level[:-1][crosses]
    high = level[1:][crosses]
    row, _ = np.nonzero(crosses)
    return Crossings(row, values[:-1][crosses], values[1:][crosses], low / (low - high))


def gain_crossings(L: ComplexArray) -> FloatArray:
    """Return the factors at which a locus passes −1, (crossings,)."""
    values = _relevant(loci(L))
    _, before, after, share = _crossings(values, values.imag)
    real = before.real + share * (after.real - before.real)
    last = values[-1]  # at the Nyquist frequency the loci are real
    ends = last.real[np.abs(last.imag) <= NEGLIGIBLE_LOCUS * np.abs(last)]
    real = np.concatenate([real, ends])
    return -1.0 / real[real < 0.0]


def phase_crossings(L: ComplexArray, frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where loci cross the unit circle: arg λ + π in [0, 2π) [rad] and ω [rad/s], (crossings,) each."""
    values = _relevant(loci(L))
    # Between two frequencies log |λ|, arg λ and log ω are taken as linear.
    row, before, after, share = _crossings(values, np.log(np.abs(values)))
    turn = np.angle(after / before)
    phase = np.mod(np.angle(before) + share * turn + np.pi, 2.0 * np.pi)
    ratio = frequency[row + 1] / frequency[row]
    where = frequency[row] * ratio**share
    return phase, where


def _relevant(values: ComplexArray) -> ComplexArray:
    """Return the loci that are not zero by construction, as those of the null space are."""
    return values[:, np.abs(values).max(axis=0) > NEGLIGIBLE_LOCUS]
