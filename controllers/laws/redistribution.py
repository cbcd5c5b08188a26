"""A joint step within its limits that moves the feature as far as wanted, or further than by shrinking the whole step.

An arm with more joints than features can go on when one joint is at its limit: the others take over. First the wanted
step is shrunk until no joint exceeds its limit. What is left of the feature's step is then made by the joints that have
room, one after the other running out of it, always along the wanted direction of the feature.
"""

from __future__ import annotations

import numpy as np

from servobench.controllers.laws.damped_inverse import damped_inverse
from servobench.plant.checks import FloatArray

NONE = 1e-9  # of its limit: a joint with less room than that has none
DONE = 1e-6  # share of the step that need not be made


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
        damping: m/rad, positive; directions in which the remaining joints are weaker than this are not chased, and up
            to what that leaves out the feature's direction is kept.
        further: how far a joint that takes over may go down and up in all, two arrays (n,), rad, at least 0; None: as
            far as its limit.

    Returns:
        (n,), rad; `joint_step` itself where it keeps the limits.
    """
    excess = float(np.maximum.reduce(np.abs(joint_step) / limit))
    if excess <= 1.0:
        return joint_step
    down, up = (limit, limit) if further is None else (np.minimum(limit, reach) for reach in further)
    m, none = len(jacobian), NONE * limit
    dq, left = joint_step / excess, 1.0 - 1.0 / excess
    wanted = jacobian @ joint_step
    free = np.abs(dq) < limit - none
    while left > DONE and np.count_nonzero(free) >= m:
        J = np.where(free, jacobian, 0.0)
        more = left * (damped_inverse(J, damping) @ wanted)
        room = np.where(more > 0.0, up - dq, down + dq)
        stuck = free & (room <= none)
        if stuck.any():
            free &= ~stuck
            continue
        share = 1.0 / max(1.0, float(np.maximum.reduce(np.abs(more[free]) / room[free])))
        dq = dq + share * more
        left *= 1.0 - share
    return np.asarray(np.clip(dq, -limit, limit))
