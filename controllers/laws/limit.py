"""The limit stage: a joint step or velocity within its limits, scaled as a whole or redistributed among the joints.

An arm with more joints than features can go on when one joint is at its limit: the others take over. `redistribute`
first shrinks the wanted step until no joint exceeds its limit. The joints that have room then make the rest of the
feature's step, until one after the other has none left, always along the wanted direction of the feature.
"""

from __future__ import annotations

import numpy as np

from servobench.controllers.laws.inverses import damped_inverse
from servobench.plant.checks import FloatArray

MIN_ROOM = 1e-9  # [1] of its limit; a joint with less room is left out
REMAINDER_TOLERANCE = 1e-6  # [1] of the step that may be left undone


def largest_excess(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the largest |u_i| / limit_i, (...), of joint velocities (..., n); above 1 some joint exceeds its limit."""
    return np.asarray(np.maximum.reduce(np.abs(joint_velocity) / limit, axis=-1))


def scale_to_limit(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Shrink a joint velocity until every joint keeps its limit; the direction stays, and so does the path.

    Args:
        joint_velocity: (..., n), rad/s.
        limit: (n,), rad/s, positive.

    Returns:
        (..., n), rad/s.
    """
    excess = np.maximum.reduce(np.abs(joint_velocity) / limit, axis=-1, keepdims=True)
    return np.asarray(joint_velocity / np.maximum(excess, 1.0))


def redistribute(
    joint_step: FloatArray,
    jacobian: FloatArray,
    limit: FloatArray,
    damping: float,
    further: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Return a joint step within the limits that moves the feature by f Ĵ dq, 0 < f ≤ 1, with a large f.

    Args:
        joint_step: dq, (n,), rad, as wanted.
        jacobian: Ĵ, (m, n), m/rad.
        limit: (n,), rad, positive.
        damping: m/rad, positive; the remaining joints make little motion in directions in which they are weaker, and
            the feature's direction is kept except for what they leave out.
        further: how far a joint that takes over may go down and up in total, two arrays (n,), rad, at least 0; None:
            as far as its limit.

    Returns:
        (n,), rad; `joint_step` itself where it keeps the limits.
    """
    excess = largest_excess(joint_step, limit)
    if excess <= 1.0:
        return joint_step
    down, up = (limit, limit) if further is None else (np.minimum(limit, reach) for reach in further)
    m, least_room = len(jacobian), MIN_ROOM * limit
    dq, left = joint_step / excess, 1.0 - 1.0 / excess
    wanted = jacobian @ joint_step
    free = np.abs(dq) < limit - least_room
    while left > REMAINDER_TOLERANCE and np.count_nonzero(free) >= m:
        J = np.where(free, jacobian, 0.0)
        more = left * (damped_inverse(J, damping) @ wanted)
        room = np.where(more > 0.0, up - dq, down + dq)
        stuck = free & (room <= least_room)
        if stuck.any():
            free &= ~stuck
            continue
        share = 1.0 / max(1.0, float(np.maximum.reduce(np.abs(more[free]) / room[free])))
        dq = dq + share * more
        left *= 1.0 - share
    return np.asarray(np.clip(dq, -limit, limit))
