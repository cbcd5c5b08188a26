"""Mistakes of a log that stop people: joints in another order or direction, other units, mirrored axes, clocks.

A log that the robot's model explains down to its noise, with likely parameters, has none of them. Of any other log
each mistake is undone in turn, then each pair, and named where the log is explained far better without it.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from heapq import nsmallest
from itertools import combinations, count, groupby, islice
from typing import Final, NamedTuple

import numpy as np

from servobench.harness.run.identification import (
    MIN_FRAMES,
    OUTLIER,
    Identified,
    Log,
    fit_cameras,
    frames_of,
    identify,
)
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.hand_eye import RobotModel

MAX_RATIO: Final = 20.0  # [1] of the motion of features in m and that of the nominal robot
UNITS: Final = {"inches": 0.0254, "cm": 1e-2, "mm": 1e-3}  # [m]
UNEXPLAINED: Final = (
    1.5  # [1] residuals over the noise from frame to frame, above which something is wrong
)
REFUSED_SHARE: Final = (
    0.1  # [1] of the motion of features, from which errors that nothing explains are refused
)
MIN_SHARE: Final = (
    0.01  # [1] of the motion of features, below which residuals are small in any case
)
GAIN: Final = 0.8  # [1] of the misfit, below which undoing a mistake explains a log
PAIR_GAIN: Final = 0.5  # [1] of the residual of one mistake, below which two explain it
TIE: Final = 1.1  # [1] misfit over the best one, up to which a log cannot tell two mistakes apart
SCREENED: Final = 6  # mistakes that are looked at closely
AT_ONCE: Final = 64  # logs without a mistake that are placed before a camera side by side
FRAMES: Final = 150  # frames of a close look
DRIFT: Final = 10.0  # [ms] at once or over the log, from which clocks are apart
CERTAIN: Final = 6.0  # [1] standard deviations
SEARCHES: Final = 20  # of joint zeros
ANGLES: Final = np.radians([-120, -90, -60, -30, 30, 60, 90, 120, 180, -10, 10]).tolist()
PARTS: Final = 16  # of the log, between which the camera may have moved
JUMP: Final = 4.0  # [1] growth of the error between two parts when a camera is moved
Others = Callable[[], Mapping[str, RobotModel]]


class _Remedy(NamedTuple):
    """A mistake, and the log without it."""

    text: str
    log: Log
    model: RobotModel


def mistakes(log: Log, model: RobotModel, others: Others = dict) -> tuple[str, Identified | None]:
    """Return a line on the mistake of a log with evidence and remedy, empty for none, and else the robot.

    Args:
        log: rows.
        model: nominal robot under the sensing of the log.
        others: returns the nominal models of other arms by name; called for a log with a mistake.
    """
    found = log.joint_mistake() or log.first_jump()[0] or _units(log, model) or log.frame_mistake()
    if found:
        return found, None
    robot = identify(log, model)
    if not _is_noise(log, robot):
        if found := _moved(log, model):
            return found, None
        other = identify(log, model, begin=_zeros(log, model))
        robot = other if _is_noise(log, other) else robot
    found = _clocks(log, robot)
    if not is_explained(log, robot):
        known = (
            dict(zip(robot.names, robot.values.tolist(), strict=True))
            if _is_noise(log, robot)
            else {}
        )
        found = _undone(log, model, others, known) or found
        if not found and (large := _large_errors(log, robot)):
            found = next(
                filter(None, (_undone(half, model, others, {}) for half, _ in _halves(log))), large
            )
    return found, None if found else robot


def noise_of(log: Log) -> FloatArray:
    """Return the deviation of a feature's noise, (m,), from third differences of successive frames; 0 for too few."""
    rows = frames_of(log)
    follow = np.flatnonzero((rows[3:] - rows[:-3]) == 3 * int(np.median(np.diff(rows))))
    if not follow.size:
        return np.zeros(log.spec.m)
    third = np.diff(log.features[rows], n=3, axis=0)[follow]
    return np.asarray(1.4826 * np.median(np.abs(third), axis=0) / math.sqrt(20.0))


def is_explained(log: Log, robot: Identified) -> bool:
    """Return whether residuals are not far above the noise, and no parameter is unlikely."""
    return _is_noise(log, robot) and not robot.unlikely()


def _is_noise(log: Log, robot: Identified) -> bool:
    spread = np.sqrt(np.diag(robot.noise))
    rest = (spread > UNEXPLAINED * noise_of(log)) & (_shares(log, robot) > MIN_SHARE)
    return bool(not rest.any() and robot.inliers.mean() > 0.5)


def _shares(log: Log, robot: Identified) -> FloatArray:
    """Return the errors of a feature over its motion, (m,)."""
    return np.asarray(
        np.sqrt(np.diag(robot.noise)) / np.std(log.features[robot.rows], axis=0).max()
    )


def _zeros(log: Log, model: RobotModel) -> dict[str, float]:
    """Return zeros of the joints, by a search along one after the other with the camera where it fits."""
    rows, draws, n = frames_of(log, FRAMES // 3), np.random.default_rng(0), log.spec.n
    q, y = log.joints[rows], log.features[rows]
    zeros, errors = draws.uniform(-math.pi, math.pi, (SEARCHES, n)), np.full(SEARCHES, np.inf)
    left = np.arange(SEARCHES)
    while left.size:
        before = errors[left]
        for joint in range(1, n - 1):  # the first and the last one turn camera and ball
            tried = np.repeat(zeros[left, None], len(ANGLES), axis=1)
            tried[..., joint] += ANGLES
            _, found = fit_cameras(model, q + tried.reshape(-1, 1, n), y)
            found = found.reshape(len(left), -1)
            best, less = found.argmin(axis=1), found.min(axis=1) < errors[left]
            zeros[left[less]], errors[left[less]] = tried[less, best[less]], found[less, best[less]]
        left = left[errors[left] < before]
    zero = (zeros[errors.argmin()] + math.pi) % (2.0 * math.pi) - math.pi
    return {
        f"zero_{name}": each for name, each in zip(log.spec.joint_names, zero.tolist(), strict=True)
    }


def _units(log: Log, model: RobotModel) -> str:
    """Name features that are likely in a smaller unit than m."""
    rows = frames_of(log)
    made, moved = (
        np.linalg.norm(_spread(each))
        for each in (model.feature(log.joints[rows]), log.features[rows])
    )
    if log.spec.feature.unit == "m" and moved > MAX_RATIO * made:
        found = f"features move by {moved:.3g} where this arm moves its ball by {made:.3g} m"
        unit = min(
            UNITS, key=lambda unit: abs(math.log(moved / max(float(made), 1e-9) * UNITS[unit]))
        )
        return f"{found}: they are likely in {unit}; write them in m"
    return ""


def _spread(values: FloatArray) -> FloatArray:
    return np.asarray(1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0))


def _large_errors(log: Log, robot: Identified) -> str:
    """Name errors that are a large part of the motion."""
    share = float(_shares(log, robot).max())
    if share < REFUSED_SHARE or _is_noise(log, robot):
        return ""
    found = f"errors are {share:.0%} of the motion, and neither one mistake nor two explain them"
    return f"{found}: check order, directions and zeros of the joints, the axes of the camera, and whether it was moved"


def _clocks(log: Log, robot: Identified) -> str:
    """Name clocks of which one is behind the other, or gains on it."""
    latency, deviation = robot.estimate("latency")
    if 1e3 * latency < -max(CERTAIN * 1e3 * deviation, DRIFT):
        before = f"frames come {-1e3 * latency:.0f} ms before the joints are where they show them"
        return f"{before}, as clocks of camera and joints are apart: stamp both with one"
    drift, deviation = robot.estimate("drift")
    time, rates = log.time[robot.rows], robot.rates(log) * robot.inliers[:, None]
    shifts, speeds = np.sum(rates * robot.residuals, axis=1), np.sum(rates**2, axis=1)
    weights = time - np.average(time, weights=speeds)  # of the lateness of each frame in the drift
    scatter = math.sqrt(robot.correlation * np.sum((weights * shifts) ** 2)) / float(
        np.sum(weights**2 * speeds)
    )
    deviation = max(deviation, scatter)  # larger where fast frames are late by changing times
    total = 1e3 * float(np.ptp(log.time))  # [ms]
    if abs(drift) < max(CERTAIN * deviation, DRIFT / total):
        return ""
    word = f"{abs(drift) * total:.0f} ± {1.96 * deviation * total:.1g} ms {'later' if drift > 0.0 else 'earlier'}"
    return f"frames come {word} at the end than at the begin, as clocks of camera and joints drift: stamp both with one"


def _moved(log: Log, model: RobotModel) -> str:
    """Name a camera that was moved during the log: one half is explained, and errors of its robot jump in the other."""
    rows = frames_of(log)
    for half, way in _halves(log):
        if not is_explained(half, robot := identify(half, model)):
            continue
        errors = np.linalg.norm(robot.errors(log, model), axis=1)
        sizes = np.array([np.median(each) for each in np.array_split(errors, PARTS)])
        growth = (sizes[1:] / sizes[:-1]) ** way
        if growth.max() > JUMP:
            row = rows[(int(growth.argmax()) + 1) * len(rows) // PARTS]
            size, unit = float(np.median(errors[(rows - row) * way >= 0])), log.spec.feature.unit
            jump = f"features jump by {size:.2g} {unit} about {log.time[row]:.0f} s after the begin"
            shift = _shift(log, model, log.time[row])
            if abs(shift) > 0.5 * log.spec.period:
                frames = f"frames come {1e3 * shift:+.0f} ms later from there on, as where one is lost or doubled"
                return f"{jump}: {frames}; cut the log there, or shift them"
            return (
                f"{jump}: the camera or the ball was moved, or a frame is lost; cut the log there"
            )
    return ""


def _shift(log: Log, model: RobotModel, time: float) -> float:
    """Return by how much the latency grows at a time [s]; 0 where a side has too few frames to tell it."""
    sides = (log.time < time, log.time >= time)
    parts = [log._replace(valid=log.valid & side) for side in sides]
    if min(len(frames_of(part)) for part in parts) < MIN_FRAMES:
        return 0.0
    before, after = (identify(part, model).estimate("latency")[0] for part in parts)
    return after - before


def _halves(log: Log) -> Iterator[tuple[Log, int]]:
    """Yield the log with the frames of each half, if they are enough, and the direction of the other half, 1 or −1."""
    rows = frames_of(log)
    for half, way in ((rows[: len(rows) // 2], 1), (rows[len(rows) // 2 :], -1)):
        if len(half) >= MIN_FRAMES:
            yield log._replace(valid=np.isin(np.arange(len(log.time)), half)), way


def _undone(log: Log, model: RobotModel, others: Others, known: Mapping[str, float]) -> str:
    """Name the one or two mistakes without which the log is explained far better, and others that do so as well.

    Where unlikely parameters explain the log, `known`, a mistake leaves likely ones and explains it as well.
    """
    rows = frames_of(log, FRAMES)
    noise = np.maximum(noise_of(log), 2e-3 * _spread(log.features[rows]).max())

    def misfit(each: _Remedy, begin: Mapping[str, float] | None = None) -> float:
        robot = identify(each.log, each.model, FRAMES, fits=2, begin=begin)
        if known and begin is None and robot.unlikely():
            return np.inf
        error = np.minimum(np.sum((robot.residuals / noise) ** 2, axis=1), OUTLIER * len(noise))
        return float(error.sum()) + sum(size**2 for size in robot.sizes().values())

    as_it_is = least = misfit(_Remedy("", log, model), known)
    names = []
    stages = ((_remedies, TIE),) if known else ((_remedies, GAIN), (_pairs, PAIR_GAIN))
    for remedies, gain in stages:
        tried = nsmallest(SCREENED, _placed(remedies(log, model, others), rows))
        found = sorted((misfit(each), each.text) for *_, each in tried)
        if found[0][0] < gain * least:
            least = found[0][0]
            names = [text for own, text in found if own <= TIE * least]
        if names and least < UNEXPLAINED**2 * log.spec.m * len(rows):
            break
    if not names:
        return ""
    which = "; a log cannot tell which" if len(names) > 1 else ""
    return f"{', or '.join(names)} (undone, {math.sqrt(least / max(least, as_it_is)):.0%} of the error is left{which})"


def _placed(remedies: Iterator[_Remedy], rows: FloatArray) -> Iterator[tuple[float, int, _Remedy]]:
    """Yield the error of some rows of each log before a camera where it fits, a number that counts up, and the log."""
    numbers = count()
    while part := list(islice(remedies, AT_ONCE)):
        for _, same in groupby(part, key=lambda each: id(each.model)):
            group = list(same)
            joints = np.stack([each.log.joints[rows] for each in group])
            features = np.stack([each.log.features[rows] for each in group])
            _, errors = fit_cameras(group[0].model, joints, features)
            yield from zip(errors.tolist(), numbers, group, strict=False)


def _pairs(log: Log, model: RobotModel, others: Others) -> Iterator[_Remedy]:
    """Yield the log without two mistakes each."""
    for k, one in enumerate(_remedies(log, model, others)):
        for other in islice(_remedies(one.log, one.model, others), k + 1, None):
            yield other._replace(text=f"{one.text}, and {other.text}")


def _remedies(log: Log, model: RobotModel, others: Others) -> Iterator[_Remedy]:
    """Yield the log without one mistake each."""
    q, y, names = log.joints, log.features, log.spec.joint_names
    n = len(names)

    def changed(text: str, joints: FloatArray = q, features: FloatArray = y) -> _Remedy:
        return _Remedy(text, log._replace(joints=joints, features=features), model)

    for i, j in combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        yield changed(f"joints {names[i]} and {names[j]} are exchanged", joints=q[:, order])
    alphabetical = np.argsort(np.argsort(names))
    yield changed("joints are in alphabetical order, as in ROS", joints=q[:, alphabetical])
    yield changed("joints are in reverse order", joints=q[:, ::-1])
    yield changed("the directions of all joints are reversed", joints=-q)
    for i, name in enumerate(names):
        sign = np.where(np.arange(n) == i, -1.0, 1.0)
        yield changed(f"the direction of joint {name} is reversed", joints=q * sign)
        for turn in (90, -90, 180):
            offset = np.where(np.arange(n) == i, math.radians(turn), 0.0)
            yield changed(f"the zero of joint {name} is {turn}° off", joints=q + offset)
    if log.spec.feature.unit == "m":
        yield changed(
            "an axis of the camera is mirrored, or two are exchanged", features=y * (1, 1, -1)
        )
    else:
        size = 2.0 * np.median(y, axis=0)
        yield changed("an axis of the image is mirrored", features=(size - y) * (1, 0) + y * (0, 1))
        yield changed("u and v are exchanged", features=y[:, ::-1])
    for name, other in others().items():
        if other.arm.n == n:
            yield _Remedy(f"the arm is a {name}", log, other)
