"""Inverse kinematics of a flange's pose: the joint positions at which it is where it is wanted, as wanted.

    Δq = Jᵀ (J Jᵀ + λ I)⁻¹ [ℓ⁻¹ (p* − p); log(R* Rᵀ)],        q ← clip(q + Δq, lower, upper)   if the error shrinks

with the geometric Jacobian J (6×n), its translations divided by the length ℓ of the arm. The damping λ shrinks after a
step that is taken and grows after one that is not (Levenberg and Marquardt).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.arm import SerialArm

ITERATIONS: Final = 100
CLOSE_ENOUGH: Final = 1e-9  # norm of the error, of lengths over the arm's and angles [rad], at which the search ends
FIRST_DAMPING: Final = 1e-3
SHRINK, GROW = 0.2, 5.0  # of the damping after a step that is taken, and after one that is not


def reach_pose(
    arm: SerialArm, pose: FloatArray, start: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, float]:
    """Return joint positions near a start at which the flange has a pose.

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
    q, damping = np.clip(start, lower, upper), FIRST_DAMPING
    error, J = _error(arm, pose, q, length)
    for _ in range(ITERATIONS):
        if np.linalg.norm(error) <= CLOSE_ENOUGH:
            break
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
        tried = np.clip(q + step, lower, upper)
        new_error, new_J = _error(arm, pose, tried, length)
        if np.linalg.norm(new_error) < np.linalg.norm(error):
            q, error, J, damping = tried, new_error, new_J, damping * SHRINK
        else:
            damping *= GROW
    return q, float(np.linalg.norm(error))


def _error(arm: SerialArm, pose: FloatArray, q: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the error, (6,), and the geometric Jacobian, (6, n), with lengths over that of the arm."""
    frames = arm.frames(q)
    flange, axes = frames[-1], frames[: arm.n, :3, 2] * arm.gear_ratio[:, None]
    turn = Rotation.from_matrix(pose[:3, :3] @ flange[:3, :3].T).as_rotvec()
    moves = np.cross(axes, flange[:3, 3] - frames[: arm.n, :3, 3]) / length
    return np.concatenate([(pose[:3, 3] - flange[:3, 3]) / length, turn]), np.vstack([moves.T, axes.T])
