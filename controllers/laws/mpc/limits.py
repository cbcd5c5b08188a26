"""The limits of a robot's joints as bounds of a predictive program, and the program that drops those out of reach."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import numpy as np

from servobench.controllers.laws.mpc.qp import QpBounds, QpProgram, QpShape, QpSolution, Solver
from servobench.plant.checks import FloatArray
from servobench.plant.signals import PlantSpec


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
    upper = np.empty((moves, spec.n))
    upper[:] = largest
    lower = -upper
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


@final
class LimitedProgram:
    """A `QpProgram` that leaves the position rows out while no joint can reach a limit within the horizon.

    Rows that no feasible plan touches change nothing but the time: they are a third of it for six joints and ten moves.
    """

    def __init__(self, shape: QpShape, solver: Solver) -> None:
        """Build the program, twice where the shape limits positions."""
        self._horizon = shape.horizon
        self._without = QpProgram(replace(shape, limit_position=False), solver)
        self._with = QpProgram(shape, solver) if shape.limit_position else self._without

    def reset(self) -> None:
        """Forget the warm starts."""
        self._without.reset()
        if self._with is not self._without:
            self._with.reset()

    def solve(self, J: FloatArray, targets: FloatArray, bounds: QpBounds) -> QpSolution:
        """Solve for new parameters; see `QpProgram.solve`."""
        reach = self._horizon * np.maximum(bounds.move_upper[-1], -bounds.move_lower[-1])
        free = (bounds.travel_upper > reach).all() and (bounds.travel_lower < -reach).all()
        program = self._without if free else self._with
        return program.solve(J, targets, bounds)
