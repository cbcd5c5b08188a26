"""Delay and lag of a drive, from commands and joint positions of a log: τ v̇ = u(t − d) − v."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from servobench.harness.run.identification import Log, correlation_time
from servobench.plant.contract.checks import FloatArray

MAX_LAG: Final = 0.5  # [s] of commands and joints
APART: Final = 1.05  # [1] ratio of the largest speeds of commands and joints, from which they may be clipped elsewhere
SUSPECT: Final = (
    0.1  # [1] share of the motion that a drive leaves, from which commands may be mistaken
)
MAX_LEFT: Final = 0.5  # [1] of the motion of a drive that is told
SHIFTS: Final = (0.0, 0.1, 0.2, 0.3)  # [s] by which joints may follow their commands
MIN_ALIKE: Final = 0.7  # [1] correlation of a joint with a command that it follows
LESS: Final = 0.6  # [1] of it, with its own command
MIN_MOTION: Final = 0.05  # [rad] of a joint that moves
MAX_SPEEDS: Final = 20.0  # [1] ratio of commands and joint speeds in one unit
SAME: Final = 0.1  # [rad] by which commands may be apart from joint positions
MIN_GAIN: Final = (
    0.5  # [1] share of the squared errors that another level of clipping leaves at most
)


class Response(NamedTuple):
    """How joints answer to commands."""

    delay: float  # [s]
    lag: float  # [s]
    covariance: FloatArray  # of both, (2, 2)
    unexplained: float  # [1] share of the motion
    level: float  # [rad/s] at which commands are clipped on their way; infinite for the limits of the robot


def command_response(log: Log) -> Response | None:
    """Return delay and lag of the joints; None for a log that does not tell them, see `untold_response`.

    Where joints and commands reach other speeds, and clipping at another level than the robot's limits leaves less of
    the motion, the level is a third parameter.
    """
    spec, steps, logged = log.spec, np.diff(log.joints, axis=0), log.commands
    first = int(np.ceil(2.0 * MAX_LAG / spec.period))
    if logged is None or not np.ptp(logged, axis=0).any() or not steps[first:].any():
        return None
    limit, reached = spec.joint_velocity_limit, np.abs(steps).max() / spec.period

    def errors(x: FloatArray) -> FloatArray:
        bound = x[2] if len(x) > 2 else limit
        return (steps - joint_steps(np.clip(logged, -bound, bound), spec.period, *x[:2]))[
            first:
        ].ravel()

    def fit(*level: float) -> Any:  # noqa: ANN401 - of SciPy
        times = [
            (delay, lag)
            for delay in np.arange(0.0, 0.2, 0.1 * spec.period)
            for lag in (0.01, 0.03, 0.1)
        ]
        best = min(times, key=lambda each: float(np.sum(errors(np.array([*each, *level])) ** 2)))
        bounds = [0.0, 1e-4, *np.multiply(0.5, level)], [MAX_LAG, MAX_LAG, *np.multiply(2.0, level)]
        return least_squares(
            errors,
            [*best, *level],
            bounds=bounds,
            x_scale=0.01,
            diff_step=[1e-4] * (2 + len(level)),
        )

    solved, level = fit(), np.inf
    if not 1.0 / APART < np.abs(np.clip(logged, -limit, limit)).max() / reached < APART:
        clipped = fit(reached)
        if clipped.cost < MIN_GAIN * solved.cost:
            solved = clipped
            level = float(clipped.x[2]) if clipped.x[2] < np.abs(logged).max() else np.inf
    left, moved, late = (
        float(np.mean(each**2)) for each in (solved.fun, steps[first:], solved.jac[:, 0])
    )
    share = math.sqrt(left / moved)
    lost = share > MAX_LEFT or max(solved.x[:2]) > 0.99 * MAX_LAG or late == 0.0
    if lost or (share > SUSPECT and command_mistake(log)):
        return None
    variance = left * correlation_time(solved.fun.reshape(-1, spec.n)) + 1e-16
    covariance = variance * np.linalg.pinv(solved.jac.T @ solved.jac)[:2, :2]
    # The residual of a drive that is no first-order lag may be one of the delay, which the lag makes up for.
    covariance += 0.25 * left / late * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return Response(float(solved.x[0]), float(solved.x[1]), covariance, share, level)


def untold_response(log: Log) -> str:
    """Return why a log tells no delay and lag."""
    if log.commands is None:
        return "the log has no command of each joint"
    return (
        command_mistake(log) or f"none up to {MAX_LAG:g} s explain the joint motion by the commands"
    )


def command_mistake(log: Log) -> str:
    """Name the likely fault of the commands of a log; empty for none, or no commands."""
    q, u, names = log.joints, log.commands, log.spec.joint_names
    if u is None or len(q) < 3:
        return ""
    if np.allclose(u, q, atol=SAME):
        return "commands of the log are its joint positions, and wanted are velocities"
    speed = np.diff(q, axis=0) / log.spec.period
    if (ratio := float(np.linalg.norm(u)) / max(float(np.linalg.norm(speed)), 1e-9)) > MAX_SPEEDS:
        return f"commands are {ratio:.0f} times the joint speeds; if they are in deg/s, write them in rad/s"
    shifts = [k for each in SHIFTS if (k := round(each / log.spec.period)) < len(q) - 2]
    alike = np.array([_correlations(speed[k:], u[: len(speed) - k]) for k in shifts])
    moving = np.ptp(q, axis=0) > MIN_MOTION
    most, least = alike.max(axis=0, initial=0.0), alike.min(axis=0, initial=0.0)
    size = np.maximum(most, -least)
    found = [
        f"{names[i]} follows the command of {names[j]}"
        for i, j in enumerate(size.argmax(axis=1).tolist())
        if moving[i] and size[i, i] < LESS * size[i, j] > LESS * MIN_ALIKE
    ]
    against = moving & (np.diag(least) < -MIN_ALIKE) & (np.diag(most) < LESS * -np.diag(least))
    found += [
        f"{name} moves against its command"
        for name, wrong in zip(names, against, strict=True)
        if wrong
    ]
    every = "every joint moves against its command" if against.sum() == moving.sum() > 1 else ""
    return (
        f"{every or ', '.join(found)}; give each joint its own command, in its direction"
        if found
        else ""
    )


def _correlations(values: FloatArray, others: FloatArray) -> FloatArray:
    """Return the correlations of n columns with n others, (n, n); 0 for those that do not change."""
    values, others = (each - each.mean(axis=0) for each in (values, others))
    sizes = np.linalg.norm(values, axis=0)[:, None] * np.linalg.norm(others, axis=0)
    return np.asarray(values.T @ others / np.maximum(sizes, 1e-9))


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
