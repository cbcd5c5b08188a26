"""The limits of a robot's joints as bounds of a predictive program."""

from __future__ import annotations

import numpy as np

from controllers.laws.mpc_qp import QpBounds
from plant.signals import FloatArray, PlantSpec


def joint_bounds(
    spec: PlantSpec,
    moves: int,
    last_step: FloatArray,
    *,
    acceleration_limit: float,
    joint_position: FloatArray,
    view_margin: FloatArray,
) -> QpBounds:
    """Return the bounds on `moves` steps from `joint_position` on.

    A joint beyond its position limit may not go further out, and need not be back at once: noise on an encoder never
    makes the program infeasible.

    Args:
        spec: limits and period.
        moves: number of free moves.
        last_step: the step before the first move, (n,), rad.
        acceleration_limit: rad/s², may be infinite.
        joint_position: (n,), rad.
        view_margin: (v,), see `QpBounds`.
    """
    largest = spec.joint_velocity_limit * spec.period
    change = np.full(spec.n, acceleration_limit * spec.period**2)
    lower, upper = np.tile(-largest, (moves, 1)), np.tile(largest, (moves, 1))
    lower[0] = np.maximum(lower[0], last_step - change)
    upper[0] = np.minimum(upper[0], last_step + change)
    return QpBounds(
        move_lower=lower,
        move_upper=upper,
        change=change,
        travel_lower=np.minimum(spec.joint_lower - joint_position, 0.0),
        travel_upper=np.maximum(spec.joint_upper - joint_position, 0.0),
        view_margin=view_margin,
    )
