"""The true pose error of a target, for sensing set-ups that are judged by it: how far and how much turned it is."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from servobench.harness.run.log import Steps
from servobench.harness.run.metrics import FINAL_SPAN
from servobench.harness.run.references import ImageReference, Reference
from servobench.plant.cameras.model import SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm
from servobench.plant.robot.hand_eye import RobotModel


def pose_errors(robot: RobotModel | None, reference: Reference, steps: Steps) -> tuple[FloatArray, FloatArray] | None:
    """Return distance (k,) [mm] and angle (k,) [deg] of the target from where it should be; None where not judged.

    Where the camera is moved during the run, the target is still judged by where it was taught.
    """
    if not (isinstance(robot, SetupModel) and robot.setup.judges_pose and isinstance(reference, ImageReference)):
        return None
    distance, angle = pose_error(robot.points(steps.joint_position), reference.points(steps.time))
    return 1e3 * distance, np.degrees(angle)


def final_pose_error(distance: FloatArray, angle: FloatArray, period: float) -> dict[str, float]:
    """Return the means of the last second as columns of the table of runs.

    Args:
        distance: (k,) [mm].
        angle: (k,) [deg].
        period: of control [s].
    """
    rows = max(1, round(FINAL_SPAN / period))
    return {"pose_error_mm": float(distance[-rows:].mean()), "pose_error_deg": float(angle[-rows:].mean())}


def pose_error(points: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far a rigid target is from where it should be.

    Args:
        points: (..., p, 3), at least three points that are not on a line [m].
        wanted: (..., p, 3) [m].

    Returns:
        Distance of the means, (...) [m], and the angle of the rotation between the two, (...) [rad], by the singular
        value decomposition of their correlation (Kabsch).
    """
    middle, goal = points.mean(axis=-2), wanted.mean(axis=-2)
    correlation = (points - middle[..., None, :]).mT @ (wanted - goal[..., None, :])
    left, _, right = np.linalg.svd(correlation)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    rotation = Rotation.from_matrix((left @ right).reshape(-1, 3, 3))
    return norm(middle - goal), rotation.magnitude().reshape(middle.shape[:-1])
