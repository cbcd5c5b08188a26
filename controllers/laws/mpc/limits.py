"""The limits of a robot as bounds of a predictive program, and the check of plans against them for all runs at once."""

from __future__ import annotations

import numpy as np

from servobench.controllers.laws.mpc.qp import QpBounds, QpShape
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import transposed
from servobench.plant.contract.signals import BoolArray, PlantSpec

_any = np.logical_or.reduce  # the method `any` of an array takes twice as long


def view_rows(tangent: tuple[float, ...], m: int) -> FloatArray:
    """Return V with V y ≥ 0 inside the pyramid |x| ≤ z·h, |y| ≤ z·v: (4, 3), or no rows without tangents (h, v)."""
    if not tangent:
        return np.zeros((0, m))
    h, v = tangent
    return np.array([[1.0, 0.0, h], [-1.0, 0.0, h], [0.0, 1.0, v], [0.0, -1.0, v]])


def joint_bounds(
    shape: QpShape,
    spec: PlantSpec,
    last: tuple[FloatArray, FloatArray],
    joint_position: FloatArray,
    view_margin: FloatArray,
) -> QpBounds:
    """Return the bounds on the steps from `joint_position` on.

    A joint beyond its position limit may not go further out, and need not be back at once: noise on an encoder never
    makes the program infeasible.

    Args:
        shape: limits that do not change.
        spec: limits of the joint positions.
        last: the last velocity sent, as the step of a block, (..., n), rad, and by how much the first move may differ
            from it, (n,), rad; without a limit it is infinite.
        joint_position: (..., n), rad.
        view_margin: (..., v), see `QpBounds`.
    """
    largest, (last_step, change) = shape.largest_move, last
    return QpBounds(
        first_lower=np.maximum(last_step - change, -largest),
        first_upper=np.minimum(last_step + change, largest),
        travel_lower=np.minimum(spec.joint_lower - joint_position, 0.0),
        travel_upper=np.maximum(spec.joint_upper - joint_position, 0.0),
        view_margin=view_margin,
    )


def exceeds(shape: QpShape, bounds: QpBounds, J: FloatArray, plan: FloatArray, travel: FloatArray) -> BoolArray:
    """Return whether a plan breaks any limit, (...).

    Args:
        shape: kinds of limits.
        bounds: of these runs.
        J: (..., m, n), m/rad.
        plan: dq_t, (..., moves, n), rad.
        travel: S_t, (..., moves, n), rad.
    """
    broken = _any(np.abs(plan) > shape.largest_move, axis=(-2, -1))
    if shape.largest_change is not None:
        first, changes = plan[..., 0, :], plan[..., 1:, :] - plan[..., :-1, :]
        broken = broken | _any((first > bounds.first_upper) | (first < bounds.first_lower), axis=-1)
        broken = broken | _any(np.abs(changes) > shape.largest_change, axis=(-2, -1))
    if shape.limit_position:
        beyond = (travel > bounds.travel_upper[..., None, :]) | (travel < bounds.travel_lower[..., None, :])
        broken = broken | _any(beyond, axis=(-2, -1))
    if len(shape.view_rows):
        seen = travel @ transposed(shape.view_rows @ J)
        broken = broken | _any(seen < bounds.view_margin[..., None, :], axis=(-2, -1))
    return np.asarray(broken)
