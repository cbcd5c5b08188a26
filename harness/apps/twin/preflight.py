"""Mistakes of a log that stop people: joints in another order or direction, other units, mirrored axes, clocks.

A log that the robot's model explains down to its noise, with likely parameters, has none of them. Of any other log
each mistake is undone in turn, then each pair, and named where the log is explained far better without it.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from heapq import nsmallest
from itertools import combinations, count, groupby, islice
from typing import NamedTuple

import numpy as np

from servobench.harness.apps.twin.drive import MIN_MOTION
from servobench.harness.apps.twin.identification import OUTLIER, Identified, fit_cameras, identify
from servobench.harness.apps.twin.log import MIN_FRAMES, Log, frames_of
from servobench.harness.apps.twin.search import searched
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.twin import Parameters

# Features in m that move farther than the nominal robot's by this factor are in another unit.
MAX_MOTION_RATIO = 20.0  # [1]
FAR_SHARE = 0.05  # [1] share of the frames by which motions are compared
LEAST_MOTION = 5e-3  # [m] below which an arm tells no unit
UNITS = {"inches": 0.0254, "cm": 1e-2, "mm": 1e-3}  # [m]
# Something is wrong if residuals exceed the noise from frame to frame by this factor.
MAX_NOISE_RATIO = 1.5  # [1]
# Errors that nothing explains are refused from this share of the motion of features on.
REFUSED_SHARE = 0.1  # [1]
# Residuals below this share of the motion of features are small in any case.
MIN_SHARE = 0.01  # [1]
# One remedy explains a log if it leaves less than this share of the misfit, two if they leave less of that of one.
REMEDY_GAIN = 0.8  # [1]
PAIR_GAIN = 0.5  # [1]
# A log cannot tell mistakes apart whose remedies leave at most this many times the least misfit.
TIE_RATIO = 1.1  # [1]
# [1] Share of the frames above which the others may be false ones, and no part of the log that does not fit.
INLIER_SHARE = 0.8
# The robot of a search is taken if it leaves less than this share of the squared residuals.
SEARCH_GAIN = 0.8  # [1]
SCREENED = 6  # number of remedies that are fitted, those with the least errors
REMEDIES_AT_ONCE = 64  # remedies for which cameras are placed side by side
FRAMES = 150  # frames for fits of remedies
MIN_DRIFT = 10.0  # [ms] between clocks, at once or over the log, from which they count as apart
CERTAIN = 6.0  # [1] standard deviations from none that leave no doubt
PARTS = 16  # parts of the log, between which the camera may have moved
JUMP_RATIO = 4.0  # [1] growth of the error between two parts when a camera is moved

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
    jump, _ = log.first_jump()
    found = log.joint_mistake() or jump or _rest(log) or _units(log, model) or log.frame_mistake()
    if found:
        return found, None
    robot = identify(log, model)
    if not _is_noise(log, robot):
        found = _moved(log, model)
        if found:
            return found, None
    if _above_noise(log, robot).any():
        other = _far_robot(log, model)
        if _is_noise(log, other) and _explains_more(other, robot):
            robot = other
    found = _clocks(log, robot)
    if not is_explained(log, robot):
        # A mistake whose remedy explains the log comes before clocks, which may only seem to drift.
        known = robot.values_by_name() if _is_noise(log, robot) else {}
        found = _named_remedies(log, model, others, known) or found
        if not found:
            found = _large_errors_named(log, robot, model, others)
    return found, None if found else robot


def _far_robot(log: Log, model: RobotModel) -> Identified:
    """Return the robot of the arm that explains a log best, however far it is from the nominal one."""
    as_it_is = _Remedy("", log, model)
    noise = _noise_for_misfits(log)

    def misfit(begin: Parameters) -> float:
        return _misfit(_fit(as_it_is, begin), noise)

    return identify(log, model, begin=min(searched(log, model), key=misfit))


def _large_errors_named(log: Log, robot: Identified, model: RobotModel, others: Others) -> str:
    """Name large errors by the mistakes of one half of the log, if there are any; empty for small errors."""
    large = _large_errors(log, robot)
    if not large:
        return ""
    for half, _ in _halves(log):
        found = _named_remedies(half, model, others, {})
        if found:
            return found
    return large


def noise_of(log: Log) -> FloatArray:
    """Return the deviation of a feature's noise, (m,), from third differences of successive frames; 0 for too few.

    The third difference of white noise, y_3 − 3 y_2 + 3 y_1 − y_0, has 1 + 9 + 9 + 1 = 20 times its variance.
    """
    rows = frames_of(log)
    usual_gap = int(np.median(np.diff(rows)))
    spans = rows[3:] - rows[:-3]
    successive = np.flatnonzero(spans == 3 * usual_gap)
    if not successive.size:
        return np.zeros(log.spec.m)
    third = np.diff(log.features[rows], n=3, axis=0)[successive]
    return 1.4826 * np.median(np.abs(third), axis=0) / math.sqrt(20.0)


def is_explained(log: Log, robot: Identified) -> bool:
    """Return whether residuals are not far above the noise, and no parameter is unlikely."""
    return _is_noise(log, robot) and not robot.unlikely()


def _above_noise(log: Log, robot: Identified) -> BoolArray:
    """Return which features have residuals far above the noise, (m,)."""
    spread = np.sqrt(np.diag(robot.noise))
    return spread > MAX_NOISE_RATIO * noise_of(log)


def _is_noise(log: Log, robot: Identified) -> bool:
    """Return whether residuals are not far above the noise, or small beside the motion, for most of the frames."""
    rest = _above_noise(log, robot) & (_shares(log, robot) > MIN_SHARE)
    return bool(not rest.any() and robot.inliers.mean() > INLIER_SHARE)


def _explains_more(one: Identified, other: Identified) -> bool:
    """Return whether one robot leaves clearly less than another, or is the first that most frames belong to."""
    if other.inliers.mean() <= 0.5:
        return True
    return bool(np.trace(one.noise) < SEARCH_GAIN * np.trace(other.noise))


def _shares(log: Log, robot: Identified) -> FloatArray:
    """Return the errors of a feature over its motion, (m,)."""
    motion = np.std(log.features[robot.rows], axis=0).max()
    return np.sqrt(np.diag(robot.noise)) / motion


def _rest(log: Log) -> str:
    """Name an arm at rest, to whose noise parameters would be fitted."""
    motion = np.ptp(log.joints[frames_of(log)], axis=0).max()
    if motion >= MIN_MOTION:
        return ""
    return f"no joint moves by more than {motion:.2g} rad, which tells nothing of an arm: lead it through its region"


def _units(log: Log, model: RobotModel) -> str:
    """Name features that are likely in a smaller unit than m."""
    rows = frames_of(log)
    modelled_distances = _distances(model.feature(log.joints[rows]))
    # Where the arm is farthest: most of the time it may be at rest
    far = modelled_distances >= np.quantile(modelled_distances, 1.0 - FAR_SHARE)
    modelled = float(np.median(modelled_distances[far]))
    logged = float(np.median(_distances(log.features[rows])[far]))
    if log.spec.feature.unit != "m" or modelled < LEAST_MOTION:
        return ""
    if logged <= MAX_MOTION_RATIO * modelled:
        return ""
    ratio = logged / modelled
    unit = min(UNITS, key=lambda unit: abs(math.log(ratio * UNITS[unit])))
    return (
        f"features move by {logged:.3g} where this arm moves its ball by {modelled:.3g} m: they are likely in "
        f"{unit}; write them in m"
    )


def _distances(values: FloatArray) -> FloatArray:
    """Return the distances of values (k, m) from their median, (k,)."""
    return np.linalg.norm(values - np.median(values, axis=0), axis=1)


def _spread(values: FloatArray) -> FloatArray:
    """Return the robust standard deviation of values (k, m), by the median of their distances from the median: (m,)."""
    distances = np.abs(values - np.median(values, axis=0))
    return 1.4826 * np.median(distances, axis=0)


def _large_errors(log: Log, robot: Identified) -> str:
    """Name errors that are a large part of the motion."""
    share = float(_shares(log, robot).max())
    if share < REFUSED_SHARE or _is_noise(log, robot):
        return ""
    return (
        f"errors are {share:.0%} of the motion, and neither one mistake nor two explain them: check order, "
        "directions and zeros of the joints, the axes of the camera, and whether it was moved"
    )


def _clocks(log: Log, robot: Identified) -> str:
    """Name clocks of which one is behind the other, or gains on it."""
    latency, deviation = robot.estimate("latency")
    if log.clocks is None and 1e3 * latency < -max(CERTAIN * 1e3 * deviation, MIN_DRIFT):
        return (
            f"frames come {-1e3 * latency:.0f} ms before the joints are where they show them, as clocks of camera "
            "and joints are apart: stamp both with one"
        )
    drift, deviation = robot.estimate("drift")
    # Larger where fast frames are late by changing times.
    deviation = max(deviation, _drift_scatter(log, robot))
    total = 1e3 * float(np.ptp(log.time))  # [ms]
    if abs(drift) < max(CERTAIN * deviation, MIN_DRIFT / total):
        return ""
    word = "later" if drift > 0.0 else "earlier"
    return (
        f"frames come {abs(drift) * total:.0f} ± {1.96 * deviation * total:.1g} ms {word} at the end than at the "
        "beginning, as clocks of camera and joints drift: stamp both with one"
    )


def _drift_scatter(log: Log, robot: Identified) -> float:
    """Return the deviation of the drift by the scatter of each frame's lateness.

    A frame that is late by s leaves a residual s ẏ: the drift is the slope of s over time, weighted with ‖ẏ‖².
    """
    time = log.time[robot.rows]
    rates = robot.rates(log) * robot.inliers[:, None]
    shifts = np.sum(rates * robot.residuals, axis=1)  # s ‖ẏ‖²
    speeds = np.sum(rates**2, axis=1)  # ‖ẏ‖²
    weights = time - np.average(time, weights=speeds)
    noise = math.sqrt(robot.correlation * np.sum((weights * shifts) ** 2))
    return noise / float(np.sum(weights**2 * speeds))


def _moved(log: Log, model: RobotModel) -> str:
    """Name a camera that was moved during the log: one half is explained, and errors of its robot jump in the other."""
    rows = frames_of(log)
    for half, way in _halves(log):
        robot = identify(half, model)
        if not is_explained(half, robot):
            continue
        errors = np.linalg.norm(robot.errors(log, model), axis=1)
        sizes = np.array([np.median(each) for each in np.array_split(errors, PARTS)])
        growth = (sizes[1:] / sizes[:-1]) ** way
        if growth.max() <= JUMP_RATIO:
            continue
        part = int(growth.argmax()) + 1
        row = rows[part * len(rows) // PARTS]
        size = float(np.median(errors[(rows - row) * way >= 0]))
        time = log.time[row]
        unit = log.spec.feature.unit
        jump = f"features jump by {size:.2g} {unit} about {time:.0f} s after the beginning"
        shift = _shift(log, model, time)
        if abs(shift) > 0.5 * log.spec.period:
            return (
                f"{jump}: frames come {1e3 * shift:+.0f} ms later from there on, as where one is lost or doubled; "
                "cut the log there, or shift them"
            )
        return f"{jump}: the camera or the ball was moved, or a frame is lost; cut the log there"
    return ""


def _shift(log: Log, model: RobotModel, time: float) -> float:
    """Return by how much the latency grows at a time [s]; 0 where a side has too few frames to tell it."""
    before = log._replace(valid=log.valid & (log.time < time))
    after = log._replace(valid=log.valid & (log.time >= time))
    if min(len(frames_of(before)), len(frames_of(after))) < MIN_FRAMES:
        return 0.0
    latency_before, _ = identify(before, model).estimate("latency")
    latency_after, _ = identify(after, model).estimate("latency")
    return latency_after - latency_before


def _halves(log: Log) -> Iterator[tuple[Log, int]]:
    """Yield the log with the frames of each half, if they are enough, and the direction of the other half, 1 or −1."""
    rows = frames_of(log)
    middle = len(rows) // 2
    for half, way in ((rows[:middle], 1), (rows[middle:], -1)):
        if len(half) >= MIN_FRAMES:
            in_half = np.isin(np.arange(len(log.time)), half)
            yield log._replace(valid=in_half), way


def _named_remedies(log: Log, model: RobotModel, others: Others, known: Parameters) -> str:
    """Name the one or two mistakes without which the log is explained far better, and others that do so as well.

    Where unlikely parameters explain the log, `known`, a mistake leaves likely ones and explains it as well.
    """
    rows = frames_of(log, FRAMES)
    noise = _noise_for_misfits(log)
    explained = MAX_NOISE_RATIO**2 * log.spec.m * len(rows)
    as_it_is = _misfit(_fit(_Remedy("", log, model), known), noise)
    stages = [(_remedies, REMEDY_GAIN), (_pairs, PAIR_GAIN)]
    if known:
        stages = [(_remedies, TIE_RATIO)]
    least = as_it_is
    names = []
    for remedies, gain in stages:
        fits = []
        for *_, remedy in nsmallest(SCREENED, _placed(remedies(log, model, others), rows)):
            robot = _fit(remedy)
            refuted = known and robot.unlikely()
            fits.append((np.inf if refuted else _misfit(robot, noise), remedy.text))
        fits.sort()
        best, _ = fits[0]
        if best < gain * least:
            least = best
            names = [text for misfit, text in fits if misfit <= TIE_RATIO * least]
        if names and least < explained:
            break
    if not names:
        return ""
    left = math.sqrt(least / max(least, as_it_is))
    which = "; a log cannot tell which" if len(names) > 1 else ""
    return f"{', or '.join(names)} (undone, {left:.0%} of the error is left{which})"


def _fit(remedy: _Remedy, begin: Parameters | None = None) -> Identified:
    """Return the robot behind a remedy, by a few frames."""
    return identify(remedy.log, remedy.model, FRAMES, fits=2, begin=begin)


def _noise_for_misfits(log: Log) -> FloatArray:
    """Return the deviation of a feature's noise, (m,), or a small share of the motion where that is more."""
    rows = frames_of(log, FRAMES)
    return np.maximum(noise_of(log), 2e-3 * _spread(log.features[rows]).max())


def _misfit(robot: Identified, noise: FloatArray) -> float:
    """Return the squared errors of a robot over the noise, (m,), and its squared prior deviations."""
    distances = np.sum((robot.residuals / noise) ** 2, axis=1)
    error = np.minimum(distances, OUTLIER * len(noise))
    return float(error.sum()) + sum(size**2 for size in robot.sizes().values())


def _placed(remedies: Iterator[_Remedy], rows: FloatArray) -> Iterator[tuple[float, int, _Remedy]]:
    """Yield the error of some rows of each log before a camera where it fits, a number that counts up, and the log."""
    numbers = count()
    while part := list(islice(remedies, REMEDIES_AT_ONCE)):
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
