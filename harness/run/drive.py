"""Delay and lag of a drive, from commands and joint positions of a log: τ v̇ = u(t − d) − v."""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from servobench.harness.run.identification import Log, correlation_time
from servobench.plant.contract.checks import FloatArray

MAX_LAG: Final = 0.5  # [s] of commands and joints
APART: Final = 1.05  # [1] ratio of the largest speeds of commands and joints, from which they may be clipped elsewhere
MIN_GAIN: Final = 0.5  # [1] share of the squared errors that another level of clipping leaves at most


class Response(NamedTuple):
    """How joints answer to commands."""

    delay: float  # [s]
    lag: float  # [s]
    covariance: FloatArray  # of both, (2, 2)
    unexplained: float  # [1] share of the motion
    level: (
        float  # [rad/s] at which commands are clipped on their way; infinite for those within the limits of the robot
    )


def command_response(log: Log) -> Response | None:
    """Return delay and lag of the joints; None for a log without commands, or without motion.

    Where joints and commands reach other speeds, and clipping at another level than the robot's limits leaves less of
    the motion, the level is a third parameter.
    """
    if log.commands is None or not np.ptp(log.commands, axis=0).any():
        return None
    spec, steps, logged = log.spec, np.diff(log.joints, axis=0), log.commands
    limit, reached = spec.joint_velocity_limit, np.abs(steps).max() / spec.period
    first = int(np.ceil(2.0 * MAX_LAG / spec.period))

    def errors(x: FloatArray) -> FloatArray:
        bound = x[2] if len(x) > 2 else limit
        return (steps - joint_steps(np.clip(logged, -bound, bound), spec.period, *x[:2]))[first:].ravel()

    def fit(*level: float) -> Any:  # noqa: ANN401 - of SciPy
        times = [(delay, lag) for delay in np.arange(0.0, 0.2, 0.1 * spec.period) for lag in (0.01, 0.03, 0.1)]
        best = min(times, key=lambda each: float(np.sum(errors(np.array([*each, *level])) ** 2)))
        most = [2.0 * each for each in level]
        bounds = [0.0, 1e-4, *(0.5 * each for each in level)], [MAX_LAG, MAX_LAG, *most]
        return least_squares(errors, [*best, *level], bounds=bounds, x_scale=0.01, diff_step=[1e-4] * (2 + len(level)))

    solved, level = fit(), np.inf
    if not 1.0 / APART < np.abs(np.clip(logged, -limit, limit)).max() / max(reached, 1e-9) < APART:
        clipped = fit(reached)
        if clipped.cost < MIN_GAIN * solved.cost:
            solved = clipped
            level = float(clipped.x[2]) if clipped.x[2] < np.abs(logged).max() else np.inf
    left = solved.fun.reshape(-1, spec.n)
    variance = float(np.mean(left**2)) * correlation_time(left) + 1e-16
    covariance = variance * np.linalg.pinv(solved.jac.T @ solved.jac)[:2, :2]
    # What is left of a drive that is no first-order lag may be one of the delay, which the lag makes up for.
    covariance += 0.25 * np.mean(left**2) / np.mean(solved.jac[:, 0] ** 2) * np.array([[1.0, -1.0], [-1.0, 1.0]])
    share = float(np.sqrt(np.mean(left**2) / np.mean(steps[first:] ** 2)))
    return Response(float(solved.x[0]), float(solved.x[1]), covariance, share, level)


def joint_steps(commands: FloatArray, period: float, delay: float, lag: float) -> FloatArray:
    """Return the joint motions from row to row, (k − 1, n) rad, from rest, in closed form.

    Args:
        commands: u, (k, n) [rad/s], held for a period each.
        period: [s].
        delay: d [s].
        lag: τ [s], above 0.
    """
    from scipy.signal import lfilter  # noqa: PLC0415 - slow to load

    whole, later = divmod(delay, period)
    rest = np.zeros((int(whole) + 1, commands.shape[1]))
    padded = np.concatenate([rest, commands])[: len(commands)]
    before, now = padded[:-1], np.concatenate([rest[1:], commands])[: len(commands) - 1]
    kept, first, second = np.exp(-np.array([period, later, period - later]) / lag)
    driven = second * (1.0 - first) * before + (1.0 - second) * now
    v = lfilter([1.0], [1.0, -kept], driven, axis=0)
    change = np.diff(v, axis=0, prepend=0.0)
    return np.asarray(later * before + (period - later) * now - lag * change)
