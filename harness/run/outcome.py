"""The outcome of a run in one word, and the pose error of its target; `status` says how the run ended.

| outcome | of | meaning |
|---|---|---|
| settled | moves | it has a settling time: it came into the settling band and stayed there; in a sequence each move |
| not_settled | moves | it did not, for none of the reasons below |
| followed | curves | the RMS error of the judged part is at most two settling bands, 10 mm on a UR5 |
| not_followed | curves | it is larger, for none of the reasons below |
| target_unreachable | both | the true arm cannot come into the band around the target or a judged part of the curve |
| joint_at_limit | both | for a second a joint was at its stop while the error was outside the band |
| a status | both | the run did not complete |

The first word that applies counts, from the good ones over `target_unreachable` to `joint_at_limit`: a target out of
reach drives joints to their stops, not the other way round. The band of a curve is two settling bands wide.
"""

import math

import numpy as np

from servobench.controllers.algebra import nearest_rotation
from servobench.harness.run.log import Steps
from servobench.harness.run.metrics import move_times
from servobench.harness.run.references import ImageReference, Reference
from servobench.harness.run.scenario import Scenario
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray, NamedArrays
from servobench.plant.contract.lanes import norm
from servobench.plant.robot.hand_eye import HandEyeModel, RobotModel
from servobench.plant.robot.inverse import closest_distance

SETTLED, NOT_SETTLED = "settled", "not_settled"
FOLLOWED, NOT_FOLLOWED = "followed", "not_followed"
TARGET_UNREACHABLE, JOINT_AT_LIMIT = "target_unreachable", "joint_at_limit"
ACHIEVED = (SETTLED, FOLLOWED)
# The outcomes of runs that complete.
OUTCOMES = (*ACHIEVED, NOT_SETTLED, NOT_FOLLOWED, TARGET_UNREACHABLE, JOINT_AT_LIMIT)
FOLLOWING_BANDS = 2.0  # settling bands: an RMS error of 10 mm on the UR5
AT_STOP = 1e-6  # [rad] from a joint's stop
HELD = 1.0  # [s] at a stop
CURVE_POINTS = 32  # points of the judged part of a curve that must be in reach


def find_outcome(
    steps: Steps,
    scenario: Scenario,
    settling_time: float,
    rms_error_evaluated: float,
    robot: RobotModel | None,
) -> str:
    """Return the outcome of a run that completed.

    Args:
        steps: its rows.
        scenario: its task.
        settling_time: [s]; NaN if it never settled.
        rms_error_evaluated: of the judged part [unit of the feature].
        robot: the true arm with the camera as it is at the end of the run; None if only the plant knows it. Reach is
            checked only where the features are positions.
    """
    move = scenario.kind != "curve"
    band = (1.0 if move else FOLLOWING_BANDS) * steps.spec.feature.band
    if scenario.kind == "sequence":
        achieved = not np.isnan(move_times(steps, scenario.moves)).any()
    elif move:
        achieved = not math.isnan(settling_time)
    else:
        achieved = rms_error_evaluated <= band
    if achieved:
        return SETTLED if move else FOLLOWED
    if isinstance(robot, HandEyeModel) and _is_out_of_reach(
        steps, robot, scenario.evaluate_from, band
    ):
        return TARGET_UNREACHABLE
    if joint_rests_at_limit(steps, band):
        return JOINT_AT_LIMIT
    return NOT_SETTLED if move else NOT_FOLLOWED


def joint_rests_at_limit(steps: Steps, band: float) -> bool:
    """Return whether a joint of a single run stays at its stop for a second while the error is outside the band."""
    q = steps.joint_position
    spec = steps.spec
    at_upper = q >= spec.joint_upper - AT_STOP
    at_lower = q <= spec.joint_lower + AT_STOP
    outside = steps.error_norm() > band
    held = (at_upper | at_lower) & outside[:, None]
    rows = max(1, math.ceil(HELD / spec.period - 1e-9))
    # The difference of two running counts is the number of held rows between them.
    start = np.zeros((1, spec.n), dtype=np.intp)
    count = np.vstack([start, np.cumsum(held, axis=0)])
    return bool((count[rows:] - count[:-rows] == rows).any())


def _is_out_of_reach(steps: Steps, robot: HandEyeModel, evaluate_from: float, band: float) -> bool:
    """Return whether the target, or a point of the judged part of a curve, is farther out of reach than the band."""
    spec = steps.spec
    judged = steps.reference[np.searchsorted(steps.time, evaluate_from - 1e-9) :]
    stride = max(1, len(judged) // CURVE_POINTS)
    points: FloatArray = np.unique(judged[::stride], axis=0)
    places = robot.to_base(points)
    distances = closest_distance(robot.arm, places, spec.joint_lower, spec.joint_upper)
    return bool((distances > band).any())


def pose_errors(robot: RobotModel | None, reference: Reference, steps: Steps) -> NamedArrays:
    """Return distance and angle of the target from its reference pose, (k,), as columns; none where not judged.

    Where the camera is moved during the run, the target is still judged by its taught pose.
    """
    if not (
        isinstance(robot, SetupModel)
        and robot.setup.judges_pose
        and isinstance(reference, ImageReference)
    ):
        return {}
    distance, angle = pose_error(robot.points(steps.joint_position), reference.points(steps.time))
    return {"pose_error_mm": 1e3 * distance, "pose_error_deg": np.degrees(angle)}


def pose_error(points: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance and angle of a rigid target from its reference pose.

    Args:
        points: (..., p, 3), at least three points that are not on a line [m].
        wanted: (..., p, 3) [m].

    Returns:
        Distance of the means, (...) [m], and the angle of the rotation between the two, (...) [rad], by the singular
        value decomposition of their correlation (Kabsch).
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a quarter of a second, which lists do not need

    middle = points.mean(axis=-2)
    goal = wanted.mean(axis=-2)
    about_middle = points - middle[..., None, :]
    about_goal = wanted - goal[..., None, :]
    matrices = nearest_rotation(about_middle.mT @ about_goal)
    angles = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).magnitude()
    return norm(middle - goal), angles.reshape(middle.shape[:-1])
