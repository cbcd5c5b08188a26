"""Inverse kinematics within the joint limits by damped least squares (Levenberg and Marquardt).

The position of the ball, from many starts at once. With the error e = p* − p(q), for each start and point by itself,

    Δq = Jᵀ (J Jᵀ + λ I)⁻¹ e,        q ← clip(q + Δq, lower, upper)   if that brings the ball nearer

where J is the arm's position Jacobian without the columns of joints that are at a stop and would leave their range.
The damping λ shrinks after a step that is taken and grows after one that is not. A point within reach has many
solutions, and most starts find one; for a point out of reach the nearest position of the ball is found.

The pose of the flange, from one start, with the geometric Jacobian J (6×n) and lengths divided by that of the arm, ℓ:

    Δq = Jᵀ (J Jᵀ + λ I)⁻¹ [ℓ⁻¹ (p* − p); log(R* Rᵀ)],        q ← clip(q + Δq, lower, upper)   if the error shrinks
"""

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm, plus_diagonal, solve, take
from servobench.plant.robot.arm import SerialArm

STARTS = 16
ITERATIONS = 120
CLOSE_ENOUGH = 1e-6  # [m] a point counts as reached, and the search for it ends
FIRST_DAMPING = 1e-2  # [m²]
DAMPING_BOUNDS = (1e-9, 1e6)  # [m²]
# Factors on the damping after an accepted and after a rejected step
SHRINK = 0.3
GROW = 4.0
Limits = tuple[FloatArray, FloatArray]  # lower and upper joint positions, (n,) and (n,) [rad]


def closest_distance(
    arm: SerialArm, point: npt.ArrayLike, lower: npt.ArrayLike, upper: npt.ArrayLike
) -> FloatArray:
    """Return the distance to which the ball can approach a point.

    Args:
        arm: one arm, or arms whose leading axes are the last ones of the points'.
        point: (..., 3), in the base frame [m].
        lower: (n,), joint limits [rad].
        upper: (n,) [rad].

    Returns:
        (...) [m]; for a point that can be reached, at most `CLOSE_ENOUGH`.
    """
    target = np.asarray(point, dtype=np.float64)
    low = np.asarray(lower, dtype=np.float64)
    high = np.asarray(upper, dtype=np.float64)
    lead = target.shape[:-1]
    n = len(low)
    # All points have the same starts, within a turn.
    within_turn = np.maximum(low, -np.pi), np.minimum(high, np.pi)
    drawn = np.random.default_rng(0).uniform(*within_turn, (STARTS, n))
    drawn = drawn.reshape(STARTS, *(1,) * len(lead), n)
    starts = np.broadcast_to(drawn, (STARTS, *lead, n))
    _, distance = _search(arm, target, starts, (low, high), one_is_enough=True)
    return distance.min(axis=0)


def reach_for(
    arm: SerialArm, point: FloatArray, starts: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return joint positions near a point, found from each of many starts.

    Args:
        arm: one arm.
        point: (3,), in the base frame [m].
        starts: (k, n) [rad].
        lower: (n,), joint limits [rad].
        upper: (n,) [rad].

    Returns:
        Joint positions (k, n) [rad], and how far the ball is from the point (k,) [m].
    """
    target = np.broadcast_to(point, (len(starts), 3))
    return _search(arm, target, starts, (lower, upper), one_is_enough=False)


def _search(
    arm: SerialArm,
    target: FloatArray,
    q: FloatArray,
    limits: Limits,
    *,
    one_is_enough: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return joint positions (starts, ..., n) rad near targets (..., 3) m, and their distances from it (starts, ...) m.

    The search begins at `q`, (starts, ..., n) rad. It ends for each start by itself that reaches its target, or with
    `one_is_enough` for a target from all starts as soon as one of them reaches it.
    """
    arm_axes = arm.translation.ndim - 2
    q = q.copy()
    target = np.broadcast_to(target, (*q.shape[:-1], 3))
    error, J = _error(arm, target, q)
    distance = norm(error)
    damping = np.full(q.shape[:-1], FIRST_DAMPING)
    for _ in range(ITERATIONS):
        is_open = distance > CLOSE_ENOUGH
        if one_is_enough:
            is_open = ~(distance.min(axis=0) <= CLOSE_ENOUGH)
        left = np.nonzero(np.broadcast_to(is_open, distance.shape))
        if not left[0].size:
            break
        tried = _step(q[left], error[left], J[left], damping[left], *limits)
        own_arm = arm
        if arm_axes:
            own_arm = take(arm, left[-arm_axes:])
        new_error, new_J = _error(own_arm, target[left], tried)
        new_distance = norm(new_error)
        nearer = new_distance < distance[left]
        factor = np.where(nearer, SHRINK, GROW)
        damping[left] = np.clip(damping[left] * factor, *DAMPING_BOUNDS)
        moved = tuple(index[nearer] for index in left)
        q[moved] = tried[nearer]
        distance[moved] = new_distance[nearer]
        error[moved] = new_error[nearer]
        J[moved] = new_J[nearer]
    return q, distance


def _error(arm: SerialArm, target: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the error, (..., 3) m, and the position Jacobian, (..., 3, n) m/rad."""
    ball, J = arm.ball_and_jacobian(q)
    return target - ball, np.ascontiguousarray(J)


def _step(
    q: FloatArray,
    error: FloatArray,
    J: FloatArray,
    damping: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
) -> FloatArray:
    """Return the joint positions after a damped step, (..., n) rad, within the limits."""
    downhill = np.vecmat(error, J)
    leaves_below = (q <= lower) & (downhill < 0.0)
    leaves_above = (q >= upper) & (downhill > 0.0)
    free = ~(leaves_below | leaves_above)
    J = J * free[..., None, :]
    damped = plus_diagonal(J @ J.mT, damping[..., None])
    weighted = solve(damped, error)
    step = np.vecmat(weighted, J)
    return np.clip(q + step, lower, upper)


POSE_ITERATIONS = 100
# The search ends at this norm of the error, with lengths over the arm's and angles in rad.
POSE_TOLERANCE = 1e-9  # [1]
FIRST_POSE_DAMPING = 1e-3
# Factors on the damping after an accepted and after a rejected step
POSE_SHRINK = 0.2
POSE_GROW = 5.0


def reach_pose(
    arm: SerialArm, pose: FloatArray, start: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, float]:
    """Return joint positions near a start that give the flange a pose.

    Args:
        arm: one arm.
        pose: X_BF, (4, 4), that is wanted.
        start: (n,), where the search begins [rad].
        lower: (n,), joint limits [rad].
        upper: (n,) [rad].

    Returns:
        (n,) rad, and the norm of the error that is left: of the length over the arm's and the angle [rad].
    """
    length = float(np.linalg.norm(arm.translation, axis=-1).sum())
    q = np.clip(start, lower, upper)
    damping = FIRST_POSE_DAMPING
    error, J = _pose_error(arm, pose, q, length)
    for _ in range(POSE_ITERATIONS):
        if np.linalg.norm(error) <= POSE_TOLERANCE:
            break
        damped = J @ J.T + damping * np.eye(6)
        step = J.T @ np.linalg.solve(damped, error)
        tried = np.clip(q + step, lower, upper)
        new_error, new_J = _pose_error(arm, pose, tried, length)
        if np.linalg.norm(new_error) < np.linalg.norm(error):
            q = tried
            error = new_error
            J = new_J
            damping *= POSE_SHRINK
        else:
            damping *= POSE_GROW
    return q, float(np.linalg.norm(error))


def _pose_error(
    arm: SerialArm, pose: FloatArray, q: FloatArray, length: float
) -> tuple[FloatArray, FloatArray]:
    """Return the error, (6,), and the geometric Jacobian, (6, n), with lengths over that of the arm."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a quarter of a second, which lists do not need

    frames = arm.frames(q)
    R = frames[-1, :3, :3]
    p = frames[-1, :3, 3]
    shift = (pose[:3, 3] - p) / length
    turn = Rotation.from_matrix(pose[:3, :3] @ R.T).as_rotvec()
    axes = frames[: arm.n, :3, 2] * arm.gear_ratio[:, None]
    origins = frames[: arm.n, :3, 3]
    moves = np.cross(axes, p - origins) / length
    return np.concatenate([shift, turn]), np.vstack([moves.T, axes.T])
