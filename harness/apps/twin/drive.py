"""Delay and lag of a drive, from commands and joint positions of a log: τ v̇ = u(t − d) − v."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from servobench.harness.apps.twin.identification import correlation_time
from servobench.harness.apps.twin.log import Log
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray

MAX_LAG = 0.5  # [s] longest delay and longest lag of joints behind commands
# The delays and lags from which a fit may start.
MAX_FIRST_DELAY = 0.2  # [s]
DELAY_STEP = 0.1  # [periods]
FIRST_LAGS = (0.01, 0.03, 0.1)  # [s]
# Commands may be clipped at another level if the largest speeds of commands and joints differ by this factor.
CLIPPED_RATIO = 1.05  # [1]
# Commands may be mistaken if the drive leaves more than this share of the motion unexplained.
SUSPECT_SHARE = 0.1  # [1]
# A log tells no drive that leaves more than this share of the motion unexplained.
MAX_UNEXPLAINED = 0.5  # [1]
SHIFTS = (0.0, 0.1, 0.2, 0.3)  # [s] tried delays of joints behind their commands
MIN_CORRELATION = 0.7  # [1] correlation of a joint with a command that it follows
# A joint follows another one's command if its correlation with its own is below this share of that.
MAX_OWN_SHARE = 0.6  # [1]
MIN_MOTION = 0.05  # [rad] range of a joint that moves
# [1] Commands over joint speeds; in deg/s they are 57 times as large.
MAX_SPEED_RATIO = 20.0
POSITION_TOLERANCE = 0.1  # [rad] Commands that are joint positions are no farther from these.
# Another level of clipping has to leave less than this share of the squared errors.
MIN_GAIN = 0.5  # [1]


class Response(NamedTuple):
    """How joints answer to commands."""

    delay: float  # [s]
    lag: float  # [s]
    covariance: FloatArray  # covariance of both, (2, 2) [s²]
    unexplained: float  # [1] share of the motion
    level: float  # [rad/s] at which commands are clipped on their way; infinite for the limits of the robot


def command_response(log: Log) -> Response | None:
    """Return delay and lag of the joints; None for a log that does not tell them, see `untold_response`.

    Where joints and commands reach other speeds, and clipping at another level than the robot's limits leaves less of
    the motion, the level is a third parameter.
    """
    spec = log.spec
    steps = np.diff(log.joints, axis=0)
    # By this row nothing is left of the rest before the log.
    first = int(np.ceil(2.0 * MAX_LAG / spec.period))
    steps_judged = steps[first:]
    logged = log.commands
    if logged is None or not np.ptp(logged, axis=0).any() or not steps_judged.any():
        return None
    drive = _Drive(logged, steps, first, spec.period, spec.joint_velocity_limit)
    reached = np.abs(steps).max() / spec.period
    solved = drive.fit()
    level = np.inf
    largest = np.abs(np.clip(logged, -drive.limit, drive.limit)).max()
    if not 1.0 / CLIPPED_RATIO < largest / reached < CLIPPED_RATIO:
        clipped = drive.fit(reached)
        if clipped.cost < MIN_GAIN * solved.cost:
            solved = clipped
            found = float(clipped.x[2])
            level = found if found < np.abs(logged).max() else np.inf
    delay = float(solved.x[0])
    lag = float(solved.x[1])
    left = float(np.mean(solved.fun**2))
    moved = float(np.mean(steps_judged**2))
    by_delay = float(np.mean(solved.jac[:, 0] ** 2))
    share = math.sqrt(left / moved)
    at_bound = max(delay, lag) > 0.99 * MAX_LAG
    if share > MAX_UNEXPLAINED or at_bound or by_delay == 0.0:
        return None
    if share > SUSPECT_SHARE and command_mistake(log):
        return None
    variance = left * correlation_time(solved.fun.reshape(-1, spec.n)) + 1e-16
    covariance = variance * np.linalg.pinv(solved.jac.T @ solved.jac)[:2, :2]
    # The residual of a drive that is no first-order lag may be one of the delay, which the lag makes up for.
    covariance += 0.25 * left / by_delay * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return Response(delay, lag, covariance, share, level)


class _Drive(NamedTuple):
    """The fit of delay, lag and, if wanted, level of clipping to joint motions."""

    commands: FloatArray  # u, (k, n) [rad/s]
    steps: FloatArray  # joint motions from row to row, (k − 1, n) [rad]
    first: int  # the first of them that counts
    period: float  # [s]
    limit: FloatArray  # speed limits of the robot, (n,) [rad/s]

    def errors(self, x: FloatArray) -> FloatArray:
        """Return the errors of the motions for x = (delay, lag) or (delay, lag, level), flat [rad]."""
        delay, lag, *level = x
        bound = level[0] if level else self.limit
        clipped = np.clip(self.commands, -bound, bound)
        errors = self.steps - joint_steps(clipped, self.period, delay, lag)
        return errors[self.first :].ravel()

    def fit(self, *level: float) -> Any:  # noqa: ANN401 - of SciPy
        """Return the least squares, from the best of a grid of delays and lags; a level stays within a factor of 2."""
        delays = np.arange(0.0, MAX_FIRST_DELAY, DELAY_STEP * self.period)
        starts = [np.array([delay, lag, *level]) for delay in delays for lag in FIRST_LAGS]
        best = min(starts, key=lambda x: float(np.sum(self.errors(x) ** 2)))
        lower = [0.0, 1e-4, *(0.5 * each for each in level)]
        upper = [MAX_LAG, MAX_LAG, *(2.0 * each for each in level)]
        return least_squares(
            self.errors,
            best,
            bounds=(lower, upper),
            x_scale=0.01,
            diff_step=[1e-4] * len(best),
        )


def untold_response(log: Log) -> str:
    """Return why a log tells no delay and lag."""
    if log.commands is None:
        return "the log has no command of each joint"
    mistake = command_mistake(log)
    return mistake or f"none up to {MAX_LAG:g} s explain the joint motion by the commands"


def command_mistake(log: Log) -> str:
    """Name the likely fault of the commands of a log; empty for none, or no commands."""
    q = log.joints
    u = log.commands
    if u is None or len(q) < 3:
        return ""
    if np.allclose(u, q, atol=POSITION_TOLERANCE):
        return "commands of the log are its joint positions, and wanted are velocities"
    speed = np.diff(q, axis=0) / log.spec.period
    ratio = float(np.linalg.norm(u)) / max(float(np.linalg.norm(speed)), 1e-9)
    if ratio > MAX_SPEED_RATIO:
        return f"commands are {ratio:.0f} times the joint speeds; if they are in deg/s, write them in rad/s"
    shifts = [round(each / log.spec.period) for each in SHIFTS]
    correlations = np.array(
        [_correlations(speed[k:], u[: len(speed) - k]) for k in shifts if k < len(q) - 2]
    )
    # Entry (i, j): the most and the least correlation of joint i with command j over all shifts.
    most = correlations.max(axis=0, initial=0.0)
    least = correlations.min(axis=0, initial=0.0)
    moving = np.ptp(q, axis=0) > MIN_MOTION
    found = _exchanged(np.maximum(most, -least), moving, log.spec.joint_names)
    with_own = np.diag(most)
    against_own = -np.diag(least)
    strongly = against_own > MIN_CORRELATION
    against = moving & strongly & (with_own < MAX_OWN_SHARE * against_own)
    for name, reversed_ in zip(log.spec.joint_names, against, strict=True):
        if reversed_:
            found.append(f"{name} moves against its command")
    if not found:
        return ""
    faults = ", ".join(found)
    if against.sum() == moving.sum() > 1:
        faults = "every joint moves against its command"
    return f"{faults}; give each joint its own command, in its direction"


def _exchanged(correlation: FloatArray, moving: BoolArray, names: Sequence[str]) -> list[str]:
    """Name joints that follow another one's command, given how much joint i follows command j, (n, n)."""
    found = []
    for i, j in enumerate(correlation.argmax(axis=1).tolist()):
        most_of_own = MAX_OWN_SHARE * correlation[i, j]
        follows = most_of_own > MAX_OWN_SHARE * MIN_CORRELATION
        if moving[i] and follows and correlation[i, i] < most_of_own:
            found.append(f"{names[i]} follows the command of {names[j]}")
    return found


def _correlations(values: FloatArray, others: FloatArray) -> FloatArray:
    """Return the correlations of n columns with n others, (n, n); 0 for those that do not change."""
    values = values - values.mean(axis=0)
    others = others - others.mean(axis=0)
    sizes = np.linalg.norm(values, axis=0)[:, None] * np.linalg.norm(others, axis=0)
    return values.T @ others / np.maximum(sizes, 1e-9)


def joint_steps(commands: FloatArray, period: float, delay: float, lag: float) -> FloatArray:
    """Return the joint motions from row to row, (k − 1, n) rad, from rest, in closed form.

    A command arrives d = w T + l after it was given, w whole periods T and a rest l of one. So in each period the drive
    follows the command of w + 1 periods ago for l, and then that of w periods ago for T − l.

    Args:
        commands: u, (k, n) [rad/s], held for a period each.
        period: T [s].
        delay: d [s].
        lag: τ [s], above 0.
    """
    from scipy.signal import lfilter  # noqa: PLC0415 - slow to load

    whole, rest = divmod(delay, period)
    standstill = np.zeros((int(whole) + 1, commands.shape[1]))
    padded = np.concatenate([standstill, commands])[: len(commands)]
    before = padded[:-1]
    now = np.concatenate([standstill[1:], commands])[: len(commands) - 1]
    # What is left of a speed after a period, and after its first and second part.
    kept, first, second = np.exp(-np.array([period, rest, period - rest]) / lag)
    driven = second * (1.0 - first) * before + (1.0 - second) * now
    v = lfilter([1.0], [1.0, -kept], driven, axis=0)
    change = np.diff(v, axis=0, prepend=0.0)
    return rest * before + (period - rest) * now - lag * change
