"""The quadratic program of the predictive law: stated once in CasADi, solved by DAQP for one run at a time.

Moves dq_1 … dq_H are condensed: the predicted displacement of the feature after t moves is J S_t, S_t = Σ_{s≤t} dq_s.

    min  ½ Σ_t w_t ‖target_t − J S_t‖² + ½ Σ_t dq_tᵀ Q dq_t
    s.t. lower_t ≤ dq_t ≤ upper_t                  speed, and for t = 1 acceleration from the last move
         |dq_t − dq_{t−1}| ≤ limit, t > 1          acceleration
         lower ≤ S_t ≤ upper                       joint positions
         V J S_t ≥ margin                          ball in view, rows V of `view_rows`

Where the Jacobian varies along the horizon, as for a nonlinear model linearised along a trajectory, J is J_t.
The constant-move program has one move dq = dq_1 = … = dq_H and all position limits at S_H = H dq.

CasADi turns this statement into a function of J and the targets that returns the matrices of ½ xᵀHx + gᵀx + c and A x.
Every solve starts cold, so that a solution depends on its arguments alone: the best possible warm start would save
DAQP a sixth of its time.
"""

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, NamedTuple, final

import daqp
import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import SolverFailed
from servobench.plant.contract.signals import BoolArray, PlantSpec

# Tolerances are those of the constraints in rad: far below an encoder step, far above rounding.
_DAQP_OPTIONS = {"primal_tol": 1e-10, "dual_tol": 1e-12, "iter_limit": 2000}
_DAQP_STATUS = {
    -1: "infeasible", -2: "cycling", -3: "unbounded", -4: "iteration limit reached", -5: "not convex",
    -6: "overdetermined",
}  # fmt: skip
_any = np.logical_or.reduce  # the method `any` of an array takes twice as long


@dataclass(frozen=True, eq=False)
class QpShape:
    """The part of a program that is the same in every period."""

    weights: FloatArray  # w, (H,), weights of the predicted errors; in constant-move mode only their number counts
    move_weight: FloatArray  # diagonal of Q, (n,)
    constant_gain: float | None  # a of eq. 46 in constant-move mode, None for H free moves.
    largest_move: FloatArray  # (n,), rad
    # (n,), rad, largest change from one move to the next; None for no limit, of the first move too
    largest_change: FloatArray | None
    limit_position: bool  # whether the joint positions are limited
    view_rows: FloatArray  # V, (v, m); no rows = no limit on the view
    varying_jacobian: bool = (
        False  # whether every block has a Jacobian of its own; for free moves only
    )

    def __eq__(self, other: object) -> bool:
        """Return whether all entries are equal."""
        return isinstance(other, QpShape) and self._key() == other._key()

    def __hash__(self) -> int:
        """Return a hash of all entries."""
        return hash(self._key())

    def _key(self) -> tuple[object, ...]:
        parts = (getattr(self, field.name) for field in fields(self))
        return tuple(
            (part.shape, part.tobytes()) if isinstance(part, np.ndarray) else part for part in parts
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.move_weight)

    @property
    def m(self) -> int:
        """Number of features."""
        return int(self.view_rows.shape[1])

    @property
    def horizon(self) -> int:
        """H, number of blocks."""
        return len(self.weights)

    @property
    def moves(self) -> int:
        """Number of free moves: 1 or H."""
        return self.horizon if self.constant_gain is None else 1


class QpBounds(NamedTuple):
    """The bounds that change from period to period; many runs side by side have leading axes."""

    first_lower: FloatArray  # (..., n), rad, of the first move
    first_upper: FloatArray  # (..., n), rad
    travel_lower: FloatArray  # (..., n), rad, of S_t
    travel_upper: FloatArray  # (..., n), rad
    view_margin: FloatArray  # (..., v), smallest V J S_t


@dataclass(frozen=True, eq=False)
class QpSolution:
    """The result of a solver."""

    success: bool  # whether the rest can be used
    moves: FloatArray  # (moves, n), rad
    objective: float  # value of the criterion, m²
    # (moves·n + rows,), of the moves and of those rows that are within reach: positive at an upper bound, negative at
    # a lower one
    multiplier: FloatArray
    status: str  # the solver's own word
    iterations: float  # of the solver


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


def exceeds(
    shape: QpShape, bounds: QpBounds, J: FloatArray, plan: FloatArray, travel: FloatArray
) -> BoolArray:
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
        beyond = (travel > bounds.travel_upper[..., None, :]) | (
            travel < bounds.travel_lower[..., None, :]
        )
        broken = broken | _any(beyond, axis=(-2, -1))
    if len(shape.view_rows):
        moved = travel @ (shape.view_rows @ J).mT
        broken = broken | _any(moved < bounds.view_margin[..., None, :], axis=(-2, -1))
    return broken


@final
class QpProgram:
    """A parametric quadratic program; the parameters are J, the targets and the bounds.

    In free-moves mode there are H targets (m,) in m; in constant-move mode there is one, already integrated over the
    horizon: ∫ τ α^τ target(τ) dτ.
    """

    def __init__(self, shape: QpShape, *, raises: bool) -> None:
        """Build the function of the matrices.

        Args:
            shape: sizes, weights and the kinds of rows.
            raises: whether `SolverFailed` is raised where there is no solution.
        """
        self._shape, self._raises = shape, raises
        self._largest = np.tile(shape.largest_move, shape.moves)
        self._function = _matrices(shape)
        count = self._largest.size
        self._J = np.zeros(self._function.numel_in(0))
        self._targets = np.zeros(self._function.numel_in(1))
        self._H, self._g, self._c = np.zeros((count, count)), np.zeros(count), np.zeros(1)
        self._A = np.zeros((self._function.numel_out(3) // count, count))
        # Keep both: the evaluation does not hold the buffer
        self._buffer, self._evaluate = self._function.buffer()
        for i, array in enumerate((self._J, self._targets)):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate((self._H, self._g, self._c, self._A)):
            if array.size:
                self._buffer.set_res(i, array.data)

    def solve(self, J: FloatArray, targets: FloatArray, bounds: QpBounds) -> QpSolution:
        """Solve for new parameters.

        Args:
            J: (m, n), or (H, m, n) where it varies, m/rad.
            targets: (moves, m).
            bounds: finite or infinite, lower ≤ upper.

        Raises:
            SolverFailed: there is no solution, and that is to be raised.
        """
        self._J[:], self._targets[:] = J.ravel(), targets.ravel()
        self._evaluate()
        n, lower, upper = self._shape.n, -self._largest, self._largest.copy()
        lower[:n], upper[:n] = bounds.first_lower, bounds.first_upper
        row_lower, row_upper = self._row_bounds(bounds)
        # Rows beyond the reach of all moves within their limits cost time only.
        reach = np.abs(self._A) @ self._largest
        near = (row_lower > -reach) | (row_upper < reach)
        lower, upper = (
            np.concatenate([lower, row_lower[near]]),
            np.concatenate([upper, row_upper[near]]),
        )
        x, value, flag, found = daqp.solve(
            self._H, self._g, self._A[near], upper, lower, **_DAQP_OPTIONS
        )
        status = ""
        if flag != 1:
            status = _DAQP_STATUS.get(flag, f"exit flag {flag}")
        success = not status and bool(np.isfinite(x).all())
        if self._raises and not success:
            raise SolverFailed(f"daqp found no solution within the limits: {status}")
        return QpSolution(
            success,
            x.reshape(-1, n),
            value + float(self._c[0]),
            found["lam"],
            status,
            float(found["iterations"]),
        )

    def _row_bounds(self, bounds: QpBounds) -> tuple[FloatArray, FloatArray]:
        """Return the bounds of the rows in the order in which `_matrices` stacks them."""
        shape, change = self._shape, self._shape.largest_change
        rows = [(bounds.view_margin, np.full(len(shape.view_rows), math.inf))] * shape.moves
        if shape.limit_position:
            rows = [(bounds.travel_lower, bounds.travel_upper)] * shape.moves + rows
        if change is not None:
            rows = [(-change, change)] * (shape.moves - 1) + rows
        lower, upper = zip(*rows, strict=True)
        return np.concatenate(lower), np.concatenate(upper)


@lru_cache(maxsize=16)
def _matrices(shape: QpShape) -> Any:  # noqa: ANN401 - casadi.Function
    """Return (J, targets) -> H, g, c, Aᵀ of the criterion ½ xᵀHx + gᵀx + c and the rows A x, as dense matrices.

    CasADi stores columns first: its inputs and outputs are transposed here, so that numpy has rows first. Building
    takes longer than many a run, so that controllers of equal programs share the function.
    """
    import casadi  # noqa: PLC0415 - other methods start without it

    blocks = shape.horizon if shape.varying_jacobian else 1
    transposed = [casadi.SX.sym(f"J{t}", shape.n, shape.m) for t in range(blocks)]
    J = [block.T for block in transposed]
    dq = casadi.SX.sym("dq", shape.n, shape.moves)
    targets = casadi.SX.sym("targets", shape.m, shape.moves)
    travel = casadi.cumsum(dq, 1) if shape.constant_gain is None else shape.horizon * dq
    shift = casadi.horzcat(*(J[t % blocks] @ travel[:, t] for t in range(shape.moves)))
    if shape.constant_gain is None:
        weights = casadi.repmat(casadi.DM(shape.weights).T, shape.m, 1)
        cost = 0.5 * casadi.dot(weights, (targets - shift) ** 2)
    else:
        step = J[0] @ dq
        cost = 0.5 * shape.constant_gain * casadi.dot(step, step) - casadi.dot(targets, step)
    cost += 0.5 * casadi.dot(casadi.repmat(casadi.DM(shape.move_weight), 1, shape.moves), dq**2)
    rows = [casadi.SX(0, 1)]
    if shape.largest_change is not None:
        rows.append(casadi.vec(dq[:, 1:] - dq[:, :-1]))
    if shape.limit_position:
        rows.append(casadi.vec(travel))
    if len(shape.view_rows):
        rows.append(casadi.vec(casadi.DM(shape.view_rows) @ shift))
    x = casadi.vec(dq)
    A, _ = casadi.linear_coeff(casadi.vertcat(*rows), x)
    results = casadi.cse([casadi.densify(part) for part in (*casadi.quadratic_coeff(cost, x), A.T)])
    return casadi.Function("program", [casadi.horzcat(*transposed), targets], results)
