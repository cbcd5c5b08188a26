"""Model predictive control with a frozen Jacobian: eq. 46 generalised to free moves, preview and limits."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated, ClassVar, Final, Literal, final

import numpy as np
from annotated_types import Le

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.law import Law, Stage
from servobench.controllers.laws.limit import scale_to_limit
from servobench.controllers.laws.mpc.closed_form import (
    constant_step,
    decay_targets,
    free_moves,
    horizon_integrals,
    move_weights,
    preview_weights,
)
from servobench.controllers.laws.mpc.limits import LimitedProgram, joint_bounds
from servobench.controllers.laws.mpc.qp import QpBounds, QpShape, QpSolution, Solver
from servobench.plant.checks import FloatArray, as_vector
from servobench.plant.faults import SolverFailed
from servobench.plant.settings import Count, NonNegative, Periods, Positive, PositiveOrInfinite, settings
from servobench.plant.signals import Observation

_MIN_MULTIPLIER: Final = 1e-10  # [m²/rad] a limit with a larger multiplier counts as active


@settings
class MpcConfig:
    """Settings of the predictive law; "tuned" = on UR5s with ±15° camera, ±5 % links and 3 periods of delay."""

    horizon: Count = 10
    """[periods] H; tuned."""
    mode: Literal["moves", "constant"] = "moves"
    """H free moves, or one constant step as in the paper."""
    alpha: Annotated[Positive, Le(1.0)] = 1.0
    """[1] α, weight of an error against the one a period earlier; 1 is the plain mean."""
    rho: Positive = 0.25
    """[1/period] ρ; the error should decay as exp(−ρ τ); tuned."""
    move_weight: Positive = 0.15
    """[m²/rad²] q of Q = q I; tuned."""
    joint_weight: tuple[Positive, ...] = ()
    """[1] relative weight of each joint, Q = q diag(…); empty: all 1."""
    terminal_weight: NonNegative = 0.0
    """[1] extra weight of the error after H periods; 0 is the paper's criterion."""
    use_preview: bool = True
    """Follow the previewed reference; false: hold the present one, as in the paper."""
    delay_periods: Periods = 0
    """[periods] until a command shows in the feature; bridged by the commands already sent."""
    joint_acceleration_limit: PositiveOrInfinite = math.inf
    """[rad/s²] limit of the change between two commands; inf: none."""
    limit_position: bool = True
    """Keep the predicted joint positions within the plant's limits."""
    view_tangent: tuple[Positive, ...] = ()
    """[1] (horizontal, vertical): |x| ≤ z·h and |y| ≤ z·v for y = (x, y, z); empty: no limit."""
    solver: Solver = "daqp"
    """Solver of the quadratic programs: the fastest of CasADi's here, or another for a cross-check."""
    fallback: Literal["hold", "closed_form", "raise"] = "hold"
    """Without a solution: zero velocity, the law without limits scaled to the speed limit, or `SolverFailed`."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if len(self.view_tangent) not in (0, 2):
            raise ValueError(f"view_tangent must be empty or (horizontal, vertical), got {self.view_tangent}")


@final
class MpcLaw(Law):
    """Receding-horizon law on the affine prediction y(k+τ) = ŷ + Ĵ Σ_{s≤τ} dq_s, after eq. 46.

    With e = y_ref − y now, r_τ = y_ref(k+τ) − y_ref(k), β = exp(−ρ), the predicted displacement should follow

        target_τ = r_τ + (1 − β^τ) e,   that is y_ref(k+τ) − y(k+τ) = β^τ e

    "moves":     min ½ Σ_τ w_τ ‖target_τ − Ĵ Σ_{s≤τ} dq_s‖² + ½ Σ_τ dq_τᵀ Q dq_τ
    "constant":  min ½ ∫₀ᴴ α^τ ‖target(τ) − τ Ĵ dq‖² dτ + ½ dqᵀ Q dq, plus the terminal term

    with w_τ = α^τ, plus `terminal_weight` at τ = H, over the joint limits; the first step is sent, u = dq / dt.
    One target for both makes them one family: for a reference at rest, without active limits, "constant" is
    (a ĴᵀĴ + Q) dq = (b − c) Ĵᵀ e, eq. 46 for Q = q I.

    | here | meaning | shape | unit |
    |---|---|---|---|
    | `J` | Ĵ, estimated ∂y/∂q, frozen over the horizon | (m, n) | m/rad |
    | `e` | y_ref − y at the instant when a command first acts | (m,) | m |
    | `dq` | joint step of one period | (n,) | rad |
    | `Q` | diagonal of the move weight | (n,) | m²/rad² |
    | `rho`, `alpha` | decay rate ρ and forgetting α | | 1/period, – |

    Departures from the paper: limits, preview, free moves and the terminal term; the printed eq. 46 is replaced by the
    minimiser it comes from (they agree for Q = q I only). With `delay_periods` = d the prediction starts d periods
    ahead, ŷ(k+d) = y + Ĵ Σ of the last d steps sent; the paper has d = 0. A position or view limit that is already
    violated may not get worse, so that noise alone never makes the program infeasible.
    """

    owns: ClassVar[frozenset[Stage]] = frozenset({"predict", "limit"})

    def __init__(self, config: MpcConfig, knowledge: RobotKnowledge) -> None:
        """Build the quadratic program.

        Raises:
            ValueError: the preview does not reach the horizon, or a setting does not fit the sizes.
        """
        spec, preview = knowledge.spec, knowledge.preview
        reach = config.horizon + config.delay_periods
        if config.use_preview and preview < reach:
            raise ValueError(f"preview must be at least horizon + delay_periods = {reach}, got {preview}")
        if config.view_tangent and spec.m != 3:
            raise ValueError(f"view_tangent needs the 3 features x, y, z, got {spec.m} features")
        self._config, self._spec = config, spec
        weight = as_vector("joint_weight", config.joint_weight or np.ones(spec.n), spec.n)
        self._Q: FloatArray = config.move_weight * weight
        self._weights = move_weights(config.horizon, config.alpha, config.terminal_weight)
        self._integrals = horizon_integrals(config.horizon, config.alpha, config.rho)
        self._preview_weights = preview_weights(config.horizon, config.alpha)
        self._gain = self._integrals.a + config.terminal_weight * config.horizon**2
        self._view = _view_rows(config.view_tangent, spec.m)
        constant = config.mode == "constant"
        shape = QpShape(
            n=spec.n,
            m=spec.m,
            weights=self._weights,
            move_weight=self._Q,
            constant_gain=self._gain if constant else None,
            limit_acceleration=math.isfinite(config.joint_acceleration_limit) and not constant,
            limit_position=config.limit_position,
            view_rows=self._view,
        )
        self._program = LimitedProgram(shape, config.solver)
        self._forget()

    def reset(self, observation: Observation) -> None:
        """Forget the warm start and the commands sent; the arm is at rest."""
        del observation
        self._program.reset()
        self._forget()

    def command(self, estimate: Estimate, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return the first step of the best plan as a joint velocity; see `Law.command`.

        Raises:
            SolverFailed: no solution, and the fallback is "raise".
        """
        config, delay, jacobian = self._config, self._config.delay_periods, estimate.jacobian
        feature = observation.feature + jacobian @ sum(self._sent, np.zeros(self._spec.n))
        rows = reference[delay : delay + config.horizon + 1] if config.use_preview else reference[:1]
        error = rows[0] - feature
        travel = rows[1:] - rows[0] if config.use_preview else np.zeros((config.horizon, self._spec.m))
        targets = self._program_targets(error, travel)
        bounds = self._bounds(observation.joint_position, feature)
        solution = self._program.solve(jacobian, targets, bounds)
        step = solution.moves[0] if solution.success else self._fall_back(jacobian, targets, solution.status)
        self._note(solution, error + travel[-1], jacobian, step)
        limit = self._spec.joint_velocity_limit
        velocity = np.clip(step / self._spec.period, -limit, limit)
        self._last = velocity * self._spec.period
        self._sent.append(self._last)
        return np.asarray(velocity)

    def diagnostics(self) -> Diagnostics:
        """Return success and iterations of the solver, objective, fallbacks so far, active limits, predicted error."""
        return dict(self._diagnostics)

    def _forget(self) -> None:
        delay, n = self._config.delay_periods, self._spec.n
        self._last = np.zeros(n)
        self._sent: deque[FloatArray] = deque([np.zeros(n)] * delay, maxlen=delay)
        self._fallbacks = 0
        self._diagnostics: dict[str, float] = {}

    def _program_targets(self, error: FloatArray, travel: FloatArray) -> FloatArray:
        """The targets of the program, (H, m) m, or integrated over the horizon, (1, m), in constant-move mode."""
        targets = decay_targets(error, travel, self._config.rho)
        if self._config.mode == "moves":
            return targets
        integral = (self._integrals.b - self._integrals.c) * error + self._preview_weights @ travel
        terminal = self._config.terminal_weight * self._config.horizon * targets[-1]
        return np.asarray((integral + terminal)[None, :])

    def _bounds(self, joint_position: FloatArray, feature: FloatArray) -> QpBounds:
        config = self._config
        moves = config.horizon if config.mode == "moves" else 1
        # A ball that is out of view already may not get further out.
        margin = np.minimum(-self._view @ feature, 0.0)
        return joint_bounds(
            self._spec,
            moves,
            self._last,
            acceleration_limit=config.joint_acceleration_limit,
            joint_position=joint_position,
            view_margin=margin,
        )

    def _fall_back(self, jacobian: FloatArray, targets: FloatArray, status: str) -> FloatArray:
        """Return the step to send without a solution, (n,) rad."""
        self._fallbacks += 1
        if self._config.fallback == "raise":
            raise SolverFailed(f"{self._config.solver} found no solution within the limits: {status}")
        if self._config.fallback == "hold":
            return np.zeros(self._spec.n)
        if self._config.mode == "constant":
            step = constant_step(jacobian, targets[0], self._gain, self._Q)
        else:
            step = free_moves(jacobian, targets, self._weights, self._Q)[0]
        return scale_to_limit(step, self._spec.joint_velocity_limit * self._spec.period)

    def _note(self, solution: QpSolution, final: FloatArray, J: FloatArray, step: FloatArray) -> None:
        """Keep the diagnostics; `final` is the error after H periods if the arm stood still, (m,) m."""
        horizon, count = self._config.horizon, len(solution.moves)
        travel = solution.moves.sum(axis=0) * (horizon / count) if solution.success else horizon * step
        multipliers = np.concatenate([solution.bound_multiplier, solution.row_multiplier])
        active = float(np.count_nonzero(np.abs(multipliers) > _MIN_MULTIPLIER)) if solution.success else math.nan
        self._diagnostics = {
            "solver_success": float(solution.success),
            "solver_iterations": solution.iterations,
            "objective": solution.objective if solution.success else math.nan,
            "fallbacks": float(self._fallbacks),
            "active_limits": active,
            "predicted_terminal_error": float(np.linalg.norm(final - J @ travel)),
        }


def _view_rows(tangent: tuple[float, ...], m: int) -> FloatArray:
    """Return V with V y ≥ 0 inside the pyramid |x| ≤ z·h, |y| ≤ z·v: (4, 3), or no rows without tangents."""
    if not tangent:
        return np.zeros((0, m))
    h, v = tangent
    return np.array([[1.0, 0.0, h], [-1.0, 0.0, h], [0.0, 1.0, v], [0.0, -1.0, v]])
