"""The quadratic programs of the predictive law, built once in CasADi and solved with new parameters every period.

Moves dq_1 … dq_H are condensed: the predicted displacement of the feature after t moves is J S_t, S_t = Σ_{s≤t} dq_s.

    min  ½ Σ_t w_t ‖target_t − J S_t‖² + ½ Σ_t dq_tᵀ Q dq_t
    s.t. lower_t ≤ dq_t ≤ upper_t                  speed, and for t = 1 acceleration from the last move
         |dq_t − dq_{t−1}| ≤ limit, t > 1          acceleration
         lower ≤ S_t ≤ upper                       joint positions
         V J S_t ≥ margin                          ball in view, rows V of `view_rows`

Where the Jacobian varies along the horizon, as for a nonlinear model linearised along a trajectory, J is J_t.
The constant-move program has one move dq = dq_1 = … = dq_H and all position limits at S_H = H dq.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from servobench.plant.checks import FloatArray

Solver: TypeAlias = Literal["daqp", "qpoases"]
# Tolerances are those of the constraints in rad: far below an encoder step, far above rounding.
_SOLVER_OPTIONS: Final[dict[Solver, dict[str, Any]]] = {
    "daqp": {"daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12, "iter_limit": 2000}},
    "qpoases": {"printLevel": "none", "nWSR": 2000, "terminationTolerance": 1e-12},
}


@dataclass(frozen=True, eq=False)
class QpShape:
    """What fixes the structure of a program.

    Attributes:
        n: joints.
        m: features.
        weights: w, (H,), weights of the predicted errors; in constant-move mode only their number counts.
        move_weight: diagonal of Q, (n,).
        constant_gain: a of eq. 46 in constant-move mode, None for H free moves.
        limit_acceleration: whether rows for the acceleration are wanted.
        limit_position: whether rows for the joint positions are wanted.
        view_rows: V, (v, m); no rows = no limit on the view.
        varying_jacobian: whether every period has a Jacobian of its own; for free moves only.
    """

    n: int
    m: int
    weights: FloatArray
    move_weight: FloatArray
    constant_gain: float | None
    limit_acceleration: bool
    limit_position: bool
    view_rows: FloatArray
    varying_jacobian: bool = False

    @property
    def horizon(self) -> int:
        """H, periods."""
        return len(self.weights)

    @property
    def moves(self) -> int:
        """Number of free moves: 1 or H."""
        return self.horizon if self.constant_gain is None else 1


@dataclass(frozen=True, eq=False)
class QpBounds:
    """Bounds of one solve.

    Attributes:
        move_lower: (moves, n), rad.
        move_upper: (moves, n), rad.
        change: (n,), rad, largest change from one move to the next.
        travel_lower: (n,), rad, of S_t.
        travel_upper: (n,), rad, of S_t.
        view_margin: (v,), least V J S_t.
    """

    move_lower: FloatArray
    move_upper: FloatArray
    change: FloatArray
    travel_lower: FloatArray
    travel_upper: FloatArray
    view_margin: FloatArray


@dataclass(frozen=True, eq=False)
class QpSolution:
    """What a solver returned.

    Attributes:
        success: whether the rest can be used.
        moves: (moves, n), rad.
        objective: value of the criterion without its constant part, m².
        bound_multiplier: (moves·n,), positive at an upper bound and negative at a lower one.
        row_multiplier: (rows,), the same for the linear rows.
        status: the solver's own word.
        iterations: NaN where the solver does not report them.
    """

    success: bool
    moves: FloatArray
    objective: float
    bound_multiplier: FloatArray
    row_multiplier: FloatArray
    status: str
    iterations: float


class QpProgram:
    """A parametric quadratic program with its solver and warm start; the parameters are J and the targets.

    In free-moves mode there are H targets (m,) in m; in constant-move mode there is one, already integrated over the
    horizon: ∫ τ α^τ target(τ) dτ.
    """

    def __init__(self, shape: QpShape, solver: Solver) -> None:
        """Build the program.

        Args:
            shape: sizes, weights and the kinds of rows.
            solver: its name.
        """
        self._shape = shape
        self._solver = solver
        self.x, self.p, self.objective, self.rows = _expressions(shape)
        self.reset()

    def reset(self) -> None:
        """Forget the warm start; the solver is made anew because it may keep a working set of its own."""
        import casadi  # noqa: PLC0415 - other methods start without it

        problem = {"x": self.x, "p": self.p, "f": self.objective, "g": self.rows}
        options = {"error_on_fail": False, "print_time": False, **_SOLVER_OPTIONS[self._solver]}
        with contextlib.redirect_stdout(io.StringIO()):  # qpOASES greets when it is made and first used
            self._function = casadi.qpsol("mpc", self._solver, problem, options)
            self._connect()
            self._evaluate()

    def __deepcopy__(self, memo: dict[int, Any]) -> QpProgram:
        """Return a program with a solver of its own at the same warm start."""
        copy = QpProgram.__new__(QpProgram)
        copy._shape, copy._solver = self._shape, self._solver
        copy.x, copy.p, copy.objective, copy.rows = self.x, self.p, self.objective, self.rows
        copy.reset()
        for name, array in self._arrays.items():
            copy._arrays[name][:] = array
        for name, array in self._results.items():
            copy._results[name][:] = array
        return copy

    def _connect(self) -> None:
        """Give the solver views of our arrays, so that a solve converts nothing; all start at zero."""
        buffer: Any
        buffer, self._evaluate = self._function.buffer()
        self._buffer = buffer
        inputs, outputs = self._function.name_in(), self._function.name_out()
        self._arrays = {name: np.zeros(self._function.numel_in(i)) for i, name in enumerate(inputs)}
        self._results = {name: np.zeros(self._function.numel_out(i)) for i, name in enumerate(outputs)}
        for i, name in enumerate(inputs):
            buffer.set_arg(i, self._arrays[name].data)
        for i, name in enumerate(outputs):
            buffer.set_res(i, self._results[name].data)

    def solve(self, J: FloatArray, targets: FloatArray, bounds: QpBounds) -> QpSolution:
        """Solve for new parameters, starting from the last solution shifted by one move.

        Args:
            J: (m, n), or (H, m, n) where it varies, m/rad.
            targets: (moves, m).
            bounds: finite or infinite, lower ≤ upper.
        """
        arrays, results = self._arrays, self._results
        arrays["p"][:] = np.concatenate([np.swapaxes(J, -1, -2).ravel(), targets.ravel()])
        arrays["lbx"][:], arrays["ubx"][:] = bounds.move_lower.ravel(), bounds.move_upper.ravel()
        arrays["lbg"][:], arrays["ubg"][:] = self._row_bounds(bounds)
        self._evaluate()
        stats = self._buffer.stats()
        moves = results["x"].reshape(self._shape.moves, self._shape.n).copy()
        success = bool(stats["success"]) and bool(np.isfinite(moves).all())
        if success:
            self._warm_start(moves)
        return QpSolution(
            success=success,
            moves=moves,
            objective=float(results["f"][0]),
            bound_multiplier=results["lam_x"].copy(),
            row_multiplier=results["lam_g"].copy(),
            status=str(stats["unified_return_status"]),
            iterations=float(stats["iter_count"]) if stats["iter_count"] >= 0 else float("nan"),
        )

    def _warm_start(self, moves: FloatArray) -> None:
        self._arrays["x0"][:] = np.concatenate([moves[1:], moves[-1:]]).ravel()
        self._arrays["lam_x0"][:] = self._results["lam_x"]
        self._arrays["lam_g0"][:] = self._results["lam_g"]

    def _row_bounds(self, bounds: QpBounds) -> tuple[FloatArray, FloatArray]:
        """The bounds of the rows, in the order in which `_expressions` stacks them."""
        shape = self._shape
        lower, upper = [], []
        if shape.limit_acceleration:
            lower.append(_repeat(-bounds.change, shape.moves - 1))
            upper.append(_repeat(bounds.change, shape.moves - 1))
        if shape.limit_position:
            lower.append(_repeat(bounds.travel_lower, shape.moves))
            upper.append(_repeat(bounds.travel_upper, shape.moves))
        lower.append(_repeat(bounds.view_margin, shape.moves))
        upper.append(np.full(lower[-1].size, np.inf))
        return np.concatenate(lower), np.concatenate(upper)


def _repeat(row: FloatArray, count: int) -> FloatArray:
    """Return `row` `count` times in a row; numpy's own `tile` costs as much as a small solve."""
    return np.broadcast_to(row, (count, row.size)).ravel()


def _expressions(shape: QpShape) -> tuple[Any, Any, Any, Any]:
    """Return variables, parameters, criterion and rows as SX expressions."""
    import casadi  # noqa: PLC0415 - other methods start without it

    blocks = shape.horizon if shape.varying_jacobian else 1
    J = [casadi.SX.sym(f"J{t}", shape.m, shape.n) for t in range(blocks)]
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
    rows = []
    if shape.limit_acceleration:
        rows.append(casadi.vec(dq[:, 1:] - dq[:, :-1]))
    if shape.limit_position:
        rows.append(casadi.vec(travel))
    if len(shape.view_rows):
        rows.append(casadi.vec(casadi.DM(shape.view_rows) @ shift))
    parameters = casadi.vertcat(*(casadi.vec(block) for block in (*J, targets)))
    return casadi.vec(dq), parameters, cost, casadi.vertcat(*rows)
