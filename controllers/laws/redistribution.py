"""A joint step within its limits that moves the feature as far as wanted, or further than by shrinking the whole step.

An arm with more joints than features can go on when one joint is at its limit: the others take over. First the wanted
step is shrunk until no joint exceeds its limit. What is left of the feature's step is then made by the joints that have
room, one after the other reaching its limit, always along the wanted direction of the feature.
"""

from __future__ import annotations

import numpy as np

from plant.signals import FloatArray

FULL = 1.0 - 1e-9  # of its limit, from which on a joint has no room left
DONE = 1e-6  # share of the step that need not be made


def redistribute(joint_step: FloatArray, jacobian: FloatArray, limit: FloatArray, damping: float) -> FloatArray:
    """Return a joint step within the limits that moves the feature by f Ĵ dq, 0 < f ≤ 1, with a large f.

    Args:
        joint_step: dq, (n,), rad, as wanted.
        jacobian: Ĵ, (m, n), m/rad.
        limit: (n,), rad, positive.
        damping: m/rad; directions in which the remaining joints are weaker than this are not chased. With a damping
            the feature's direction is kept up to what the damping leaves out.

    Returns:
        (n,), rad; `joint_step` itself where it keeps the limits.
    """
    excess = float(np.maximum.reduce(np.abs(joint_step) / limit))
    if excess <= 1.0:
        return joint_step
    m = len(jacobian)
    dq, left = joint_step / excess, 1.0 - 1.0 / excess
    wanted = jacobian @ joint_step
    free = np.abs(dq) < FULL * limit
    while left > DONE and np.count_nonzero(free) >= m:
        J = jacobian[:, free]
        more = left * (J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(m), wanted))
        room = limit[free] - np.sign(more) * dq[free]
        share = 1.0 / max(1.0, float(np.maximum.reduce(np.abs(more) / room)))
        dq[free] += share * more
        left *= 1.0 - share
        free &= np.abs(dq) < FULL * limit
    return np.asarray(np.clip(dq, -limit, limit))
