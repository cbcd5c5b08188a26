"""Model predictive control with a frozen Jacobian: eq. 46 generalised to free moves, preview and limits."""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.laws.law import Estimate, Law, Stage
from servobench.controllers.laws.mpc import closed_form
from servobench.controllers.laws.mpc.qp import (
    QpBounds,
    QpProgram,
    QpShape,
    exceeds,
    joint_bounds,
    view_rows,
)
from servobench.controllers.periods import check_preview, sampled
from servobench.controllers.stages.finish import scale_to_limit
from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.lanes import branch, norm, where
from servobench.plant.contract.settings import (
    Count,
    NonNegative,
    Positive,
    PositiveOrInfinite,
    settings,
)
from servobench.plant.contract.signals import BoolArray, Observation

_MIN_MULTIPLIER = 1e-10  # [m²/rad] a limit with a larger multiplier counts as active
_MAX_FORGETTING = 20.0  # [1] a block, after which an error weighs 2e-9 of the present one
_MIN_ROOM = 1e-12  # [rad/s] room of a joint whose command is at the acceleration limit


@settings
class MpcConfig:
    """Settings of the predictive law; "tuned" = on UR5s with ±15° camera, ±5 % links and 3 periods of delay."""

    horizon_time: Positive = 0.5
    """[s] prediction horizon; tuned."""
    moves: Count = 10
    """[1] H, equal blocks of constant joint velocity, none shorter than a period."""
    mode: Literal["moves", "constant"] = "moves"
    """H free moves, or one constant velocity as in the paper."""
    forgetting: NonNegative = 0.0
    """[1/s] weight exp(−forgetting t) of an error after t; 0: plain mean."""
    decay: Positive = 5.0
    """[1/s] desired decay exp(−decay t) of the error; tuned."""
    move_weight: Positive = 0.15
    """[m²/rad²] q of Q = q I, for a joint step of 0.05 s, converted for other blocks; tuned."""
    joint_weight: tuple[Positive, ...] = ()
    """[1] weight of each joint, Q = q diag(…); empty: all 1."""
    terminal_weight: NonNegative = 0.0
    """[1] extra weight of the final error, against that of 0.05 s."""
    use_preview: bool = True
    """Follow the previewed reference; false: its present value, as in the paper."""
    delay: NonNegative = 0.0
    """[s] from command to feature, bridged by the commands already sent."""
    joint_acceleration_limit: PositiveOrInfinite = math.inf
    """[rad/s²] limit between two commands; inf: none."""
    limit_position: bool = True
    """Keep predicted joint positions within the plant's limits."""
    view_tangent: tuple[Positive, ...] = ()
    """[1] (h, v): |x| ≤ z·h and |y| ≤ z·v for y = (x, y, z); empty: no limit."""
    fallback: Literal["hold", "raise"] = "hold"
    """Without a solution: zero velocity, or `SolverFailed`."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if len(self.view_tangent) not in (0, 2):
            raise ValueError(
                f"view_tangent must be empty or (horizontal, vertical), got {self.view_tangent}"
            )


class Plan(NamedTuple):
    """The moves of the last command and the result of the solver."""

    moves: FloatArray  # dq_1 … dq_H, or the one constant step, (..., moves, n), rad
    success: FloatArray  # (...), 1 where they are the optimum, 0 where the fallback was sent; NaN before a command
    iterations: FloatArray  # (...), of the solver; 0 without an active limit
    active_limits: FloatArray  # (...), NaN without a solution


class MpcState(NamedTuple):
    """The state of the predictive law."""

    sent: FloatArray  # (..., D, n), rad, the steps sent in the last `delay` seconds, the newest one last
    last: FloatArray  # (..., n), rad, the last step sent
    fallbacks: FloatArray  # (...), commands without a solution so far
    J: FloatArray  # (..., m, n), m/rad, of the last command, for the diagnostics; NaN before, as the next two
    targets: FloatArray  # (..., moves, m), targets of the last command
    final: FloatArray  # (..., m), m, error at the end of the horizon if the arm stood still
    plan: Plan  # plan of the last command


@final
class MpcLaw(Law[MpcState]):
    """Receding-horizon law on the affine prediction y(τ) = ŷ + Ĵ Σ_{s≤τ} dq_s, after eq. 46.

    Time τ counts blocks of the horizon (`Blocks`), whose length does not depend on the control rate. With e = y_ref − y
    now, r_τ = y_ref(τ) − y_ref(0), β = exp(−ρ), the predicted displacement should follow

        target_τ = r_τ + (1 − β^τ) e,   that is y_ref(τ) − y(τ) = β^τ e

    "moves":     min ½ Σ_τ w_τ ‖target_τ − Ĵ Σ_{s≤τ} dq_s‖² + ½ Σ_τ dq_τᵀ Q dq_τ
    "constant":  min ½ ∫₀ᴴ α^τ ‖target(τ) − τ Ĵ dq‖² dτ + ½ dqᵀ Q dq, plus the terminal term

    with w_τ = α^τ, plus `terminal_weight` at τ = H, over the joint limits; the velocity of the first block is sent for
    one control period, u = dq_1 / Δ. One target for both makes them one family: for a reference at rest, without active
    limits, "constant" is (a ĴᵀĴ + Q) dq = (b − c) Ĵᵀ e, eq. 46 for Q = q I. The plan without limits has a closed form;
    where it keeps all limits it is the optimum, and only the other lanes solve the quadratic program.

    | here | meaning | shape | unit |
    |---|---|---|---|
    | `J` | Ĵ, estimated ∂y/∂q, frozen over the horizon | (m, n) | m/rad |
    | `e` | y_ref − y at the instant when a command first acts | (m,) | m |
    | `dq` | joint step of one block | (n,) | rad |
    | `Δ` | length of a block | | s |
    | `Q` | diagonal of the move weight | (n,) | m²/rad² |
    | `rho`, `alpha` | decay Δ, exp(−forgetting Δ) | | – |

    Departures from the paper: limits, preview, free moves and the terminal term; the printed eq. 46 is replaced by the
    minimiser it comes from (they agree for Q = q I only). The prediction starts `delay` ahead, ŷ = y + Ĵ Σ of the
    steps sent in the last `delay` seconds; the paper has none. The printed eq. 46 with the speed limit alone is mode
    "constant", `use_preview` and `limit_position` false, and else the defaults. A position or view limit that is
    already violated may not get worse, so that noise alone never makes the program infeasible.
    """

    def __init__(self, config: MpcConfig, knowledge: RobotKnowledge) -> None:
        """Build the quadratic program.

        Raises:
            ValueError: the preview does not reach the horizon, or a setting does not fit the sizes.
        """
        spec = knowledge.spec
        blocks = closed_form.Blocks.of(config.horizon_time, config.moves, spec.period)
        if config.use_preview:
            reach = blocks.count * blocks.length + config.delay
            check_preview(reach, knowledge.preview, spec.period, "horizon_time + delay")
        if config.view_tangent and spec.m != 3:
            raise ValueError(f"view_tangent needs the 3 features x, y, z, got {spec.m} features")
        if config.forgetting * blocks.length > _MAX_FORGETTING:
            most = _MAX_FORGETTING / blocks.length
            raise ValueError(
                f"forgetting must be at most {most:g} 1/s for blocks of {blocks.length:g} s, or no error ahead counts; "
                f"got {config.forgetting:g} 1/s"
            )
        self._config = config
        self._spec = spec
        self._blocks = blocks
        self.owns = _owned_stages(config)
        self._places = blocks.places(config.delay)
        self._to_come = closed_form.bridging_shares(config.delay, spec.period)[:, None]

        constant = config.mode == "constant"
        horizon = blocks.count
        joint_weight = as_array("joint_weight", config.joint_weight or np.ones(spec.n), (spec.n,))
        # One constant velocity is weighted once, not in every block.
        power = 3 if constant else 2
        self._Q: FloatArray = config.move_weight / blocks.relative_length**power * joint_weight
        self._terminal = config.terminal_weight / blocks.relative_length

        rho = config.decay * blocks.length
        alpha = math.exp(-config.forgetting * blocks.length)
        self._shares = closed_form.decay_shares(horizon, rho)
        self._integrals = closed_form.horizon_integrals(horizon, alpha, rho)
        self._preview_weights = closed_form.preview_weights(horizon, alpha)
        weights = closed_form.move_weights(horizon, alpha, self._terminal)
        gain = self._integrals.a + self._terminal * horizon**2

        self._change: FloatArray = np.full(spec.n, config.joint_acceleration_limit * blocks.length)
        limited = math.isfinite(config.joint_acceleration_limit)
        self._shape = QpShape(
            weights=weights,
            move_weight=self._Q,
            constant_gain=gain if constant else None,
            largest_move=spec.joint_velocity_limit * blocks.length,
            largest_change=self._change * blocks.length if limited else None,
            limit_position=config.limit_position,
            view_rows=view_rows(config.view_tangent, spec.m),
        )
        if constant:
            self._unlimited = closed_form.UnlimitedPlan.of_constant_step(gain, horizon, self._Q)
        else:
            self._unlimited = closed_form.UnlimitedPlan.of_free_moves(weights, self._Q)
        self._program = QpProgram(self._shape, raises=config.fallback == "raise")

    def start(self, observation: Observation) -> MpcState:
        """Return the state of an arm at rest."""
        lead = observation.lead
        n = self._spec.n
        m = self._spec.m
        moves = self._shape.moves
        unknown = np.full(lead, np.nan)
        rest = np.zeros((*lead, moves, n))
        plan = Plan(rest, unknown, unknown, unknown)
        sent = np.zeros((*lead, len(self._to_come), n))
        last = np.zeros((*lead, n))
        fallbacks = np.zeros(lead)
        J = np.full((*lead, m, n), np.nan)
        targets = np.full((*lead, moves, m), np.nan)
        final = np.full((*lead, m), np.nan)
        return MpcState(sent, last, fallbacks, J, targets, final, plan)

    def command(
        self, state: MpcState, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[MpcState, FloatArray]:
        """Return the state and the first step of the best plan as a joint velocity; see `Law.command`.

        Raises:
            SolverFailed: no solution in at least one lane, and the fallback is "raise".
        """
        J = estimate.jacobian
        feature, error, ahead = self._look_ahead(state.sent, J, observation, reference)
        targets = self._program_targets(error, ahead)
        moves, travel = self._unlimited.minimise(J, targets)
        # A ball that is out of view already may not get further out.
        margin = np.minimum(-np.matvec(self._shape.view_rows, feature), 0.0)
        sent_in_a_block = state.last * self._blocks.periods
        change_a_period = self._change * self._spec.period
        last = (sent_in_a_block, change_a_period)
        bounds = joint_bounds(self._shape, self._spec, last, observation.joint_position, margin)
        lead = feature.shape[:-1]
        none = np.zeros(lead)
        plan = Plan(moves, success=np.ones(lead), iterations=none, active_limits=none)
        # Only where the optimum without limits exceeds one is the program solved.
        beyond = exceeds(self._shape, bounds, J, moves, travel)
        plan = branch(beyond, self._limited, plan, J, targets, bounds)
        limit = self._spec.joint_velocity_limit
        velocity = np.clip(plan.moves[..., 0, :] / self._blocks.length, -limit, limit)
        fallbacks = np.asarray(state.fallbacks + (1.0 - plan.success))
        final = error + ahead[..., -1, :]
        return MpcState(state.sent, state.last, fallbacks, J, targets, final, plan), velocity

    def restrained(
        self, state: MpcState, wanted: FloatArray, joint_velocity: FloatArray
    ) -> FloatArray:
        """Return the velocity with as much of the stages' addition as the acceleration limit leaves room for."""
        if self._shape.largest_change is None:
            return joint_velocity
        period = self._spec.period
        added = joint_velocity - wanted
        # The command has changed by `so_far` already; an addition in the same direction has less room.
        so_far = wanted - state.last / period
        limit = self._config.joint_acceleration_limit * period
        room = limit - np.sign(added) * so_far
        return wanted + scale_to_limit(added, np.maximum(room, _MIN_ROOM))

    def noted(self, state: MpcState, joint_velocity: FloatArray, limited: BoolArray) -> MpcState:
        """Return the state with the step that is sent; see `Law.noted`."""
        last = joint_velocity * self._spec.period
        sent = np.concatenate([state.sent, last[..., None, :]], axis=-2)
        return state._replace(sent=sent[..., 1:, :], last=last)

    def _look_ahead(
        self, sent: FloatArray, J: FloatArray, observation: Observation, reference: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return ŷ, e and r_1 … r_H, all at the instant when a command first acts."""
        to_come = np.add.reduce(self._to_come * sent, axis=-2)
        feature = observation.feature + np.matvec(J, to_come)
        if not self._config.use_preview:
            error = reference[..., 0, :] - feature
            return feature, error, np.zeros((self._blocks.count, self._spec.m))
        rows = sampled(reference, self._places)
        error = rows[..., 0, :] - feature
        ahead = rows[..., 1:, :] - rows[..., :1, :]
        return feature, error, ahead

    def diagnostics(self, state: MpcState) -> Diagnostics:
        """Return success and iterations of the solver, objective, fallbacks so far, active limits, predicted error.

        Without an active limit the plan is that of the closed form, after no iteration.
        """
        plan = state.plan
        blocks_a_move = self._blocks.count / self._shape.moves
        travel = plan.moves.sum(axis=-2) * blocks_a_move
        solved = plan.success > 0.0
        objective = where(solved, self._objective(state), np.asarray(math.nan))
        predicted = np.matvec(state.J, travel)
        return {
            "solver_success": plan.success,
            "solver_iterations": plan.iterations,
            "objective": objective,
            "fallbacks": state.fallbacks,
            "active_limits": plan.active_limits,
            "predicted_terminal_error": norm(state.final - predicted),
        }

    def _objective(self, state: MpcState) -> FloatArray:
        """Return the criterion of the plan, (...), m²."""
        shape = self._shape
        moves = state.plan.moves
        J = state.J
        effort = 0.5 * (self._Q * moves**2).sum(axis=(-2, -1))
        if shape.constant_gain is not None:
            step = moves @ J.mT
            criterion = 0.5 * shape.constant_gain * step**2 - state.targets * step
            return np.asarray(effort + criterion.sum(axis=(-2, -1)))
        miss = state.targets - np.cumsum(moves, axis=-2) @ J.mT
        misses = (shape.weights[:, None] * miss**2).sum(axis=(-2, -1))
        return np.asarray(effort + 0.5 * misses)

    def _program_targets(self, error: FloatArray, ahead: FloatArray) -> FloatArray:
        """Return the targets of the program, (..., H, m) m, or integrated over the horizon, (..., 1, m)."""
        targets = closed_form.decay_targets(error, ahead, self._shares)
        if self._config.mode == "moves":
            return targets
        _, b, c = self._integrals
        integral = (b - c) * error + np.vecmat(self._preview_weights, ahead)
        terminal = self._terminal * self._blocks.count * targets[..., -1, :]
        return (integral + terminal)[..., None, :]

    def _limited(self, plan: Plan, J: FloatArray, targets: FloatArray, bounds: QpBounds) -> Plan:
        """Return the best plan within the limits."""
        solve: Callable[..., tuple[npt.ArrayLike, ...]] = self._solve
        if plan.moves.ndim > 2:
            # numpy.vectorize takes one lane after the other.
            signature = "(k,n),(m,n),(k,m),(n),(n),(n),(n),(v)->(k,n),(),(),()"
            solve = np.vectorize(self._solve, signature=signature)
        return Plan(*map(np.asarray, solve(plan.moves, J, targets, *bounds)))

    def _solve(
        self, moves: FloatArray, J: FloatArray, targets: FloatArray, *bounds: FloatArray
    ) -> tuple[FloatArray, float, float, float]:
        """Return the entries of a single run's plan; `moves` are the best ones without limits."""
        solution = self._program.solve(J, targets, QpBounds(*bounds))
        if solution.success:
            active = np.count_nonzero(np.abs(solution.multiplier) > _MIN_MULTIPLIER)
            return solution.moves, 1.0, solution.iterations, float(active)
        return np.zeros_like(moves), 0.0, solution.iterations, math.nan


def _owned_stages(config: MpcConfig) -> frozenset[Stage]:
    """Return the stages of the chain that the law brings itself with these settings."""
    stages: list[Stage] = ["limit"]
    if config.use_preview:
        stages.append("preview")
    if config.delay > 0.0:
        stages.append("predict")
    return frozenset(stages)
