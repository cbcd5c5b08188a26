"""The limit stage: a joint step or velocity within its limits, scaled as a whole or redistributed among the joints.

An arm with more joints than features can go on when one joint is at its limit: the others take over. `redistribute`
first shrinks the wanted step until no joint exceeds its limit. The joints that have room then make the rest of the
feature's step, until one after the other has none left, always along the wanted direction of the feature.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from servobench.controllers.algebra import damped_inverse
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, repeat
from servobench.plant.contract.signals import BoolArray

MIN_ROOM = 1e-9  # [1] of its limit; a joint with less room is left out
REMAINDER_TOLERANCE = 1e-6  # [1] of the step that may be left undone


def largest_excess(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the largest |u_i| / limit_i, (...), of joint velocities (..., n); above 1 some joint exceeds its limit."""
    excess: FloatArray = np.maximum.reduce(np.abs(joint_velocity) / limit, axis=-1)
    return excess


def scale_to_limit(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Shrink a joint velocity until every joint keeps its limit; the direction stays, and so does the path.

    Args:
        joint_velocity: (..., n), rad/s.
        limit: (n,), rad/s, positive.

    Returns:
        (..., n), rad/s.
    """
    return np.asarray(joint_velocity / np.maximum(largest_excess(joint_velocity, limit), 1.0)[..., None])


class _Shared(NamedTuple):
    """A joint step that is being redistributed."""

    joint_step: FloatArray  # (..., n), rad, within the limits
    left: FloatArray  # (...), share of the wanted step that is still to be made
    free: BoolArray  # (..., n), joints that may still take over
    jacobian: FloatArray  # Ĵ, (..., m, n), m/rad
    wanted: FloatArray  # the wanted step of the feature, (..., m), m
    down: FloatArray  # (..., n), rad, how far a joint may go down in total
    up: FloatArray  # the same upwards


def redistribute(
    joint_step: FloatArray,
    jacobian: FloatArray,
    limit: FloatArray,
    damping: float,
    further: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Return a joint step within the limits that moves the feature by f Ĵ dq, 0 < f ≤ 1, with a large f.

    Args:
        joint_step: dq, (..., n), rad, as wanted.
        jacobian: Ĵ, (..., m, n), m/rad.
        limit: (n,), rad, positive.
        damping: m/rad, positive; the remaining joints make little motion in directions in which they are weaker, and
            the feature's direction is kept except for the part that they leave out.
        further: how far a joint that takes over may go down and up in total, two arrays (..., n), rad, at least 0;
            None: as far as its limit.

    Returns:
        (..., n), rad; `joint_step` itself where it keeps the limits.
    """
    if further is None:
        further = np.broadcast_to(limit, joint_step.shape), np.broadcast_to(limit, joint_step.shape)
    take_over = partial(_take_over, limit=limit, damping=damping)

    def shared(joint_step: FloatArray, jacobian: FloatArray, down: FloatArray, up: FloatArray) -> FloatArray:
        excess = largest_excess(joint_step, limit)
        dq = joint_step / excess[..., None]
        free = np.abs(dq) < limit - MIN_ROOM * limit
        wanted = np.matvec(jacobian, joint_step)
        down, up = np.minimum(limit, down), np.minimum(limit, up)
        state = _Shared(dq, 1.0 - 1.0 / excess, free, jacobian, wanted, down, up)
        # Each pass excludes a joint, brings one to its limit, or finishes: two passes for each joint are enough.
        state = repeat(_is_unfinished, take_over, state, 2 * joint_step.shape[-1] + 1)
        return np.minimum(np.maximum(state.joint_step, -limit), limit)

    return branch(largest_excess(joint_step, limit) > 1.0, shared, joint_step, jacobian, *further)


def _is_unfinished(state: _Shared) -> BoolArray:
    enough = np.add.reduce(state.free, axis=-1) >= state.jacobian.shape[-2]
    unfinished: BoolArray = (state.left > REMAINDER_TOLERANCE) & enough
    return unfinished


def _take_over(state: _Shared, limit: FloatArray, damping: float) -> _Shared:
    """Move the free joints until one reaches its limit; a joint that is at its limit already is only excluded."""
    dq, free = state.joint_step, state.free
    J = np.where(free[..., None, :], state.jacobian, 0.0)
    more = state.left[..., None] * np.matvec(damped_inverse(J, damping), state.wanted)
    room = np.where(more > 0.0, state.up - dq, state.down + dq)
    stuck = free & (room <= MIN_ROOM * limit)
    free = free & ~stuck
    use = np.divide(np.abs(more), room, where=free, out=np.zeros_like(more))
    share = (1.0 - np.logical_or.reduce(stuck, axis=-1)) / np.maximum.reduce(use, axis=-1, initial=1.0)
    return state._replace(joint_step=dq + share[..., None] * more, left=state.left * (1.0 - share), free=free)
