"""A second upper bound: nonlinear predictive control over the kinematics of the true robot."""

import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal, final

import numpy as np

from servobench.controllers.controller import (
    Controller,
    ControllerEntry,
    Delays,
    Diagnostics,
    RobotKnowledge,
)
from servobench.controllers.laws.mpc import closed_form
from servobench.controllers.laws.mpc.qp import QpProgram, QpShape, QpSolution, joint_bounds
from servobench.controllers.periods import check_preview, in_periods, sampled, whole_periods
from servobench.controllers.units import in_natural_units
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.settings import (
    Count,
    NonNegative,
    Positive,
    PositiveOrInfinite,
    settings,
)
from servobench.plant.contract.signals import Command, Observation

_PLAN_TOLERANCE = 1e-9  # [rad] a smaller change of the plan ends the iterations
# Number of exposures in a control period that are considered where frames are late by unknown times.
AGES = 4


@settings
class NmpcCalibratedConfig:
    """Settings of `nmpc_calibrated`; "tuned" = on simulated UR5s with joint lag and a command delay of one period."""

    horizon_time: Positive = 0.4
    """[s] prediction horizon; with the delay within the default preview of 0.5 s."""
    moves: Count = 8
    """[1] H, equal blocks of constant joint velocity, none shorter than a period."""
    delay: NonNegative = 0.1
    """[s] from command to joint motion, half transport, half lag; bridged."""
    decay: Positive = 20.0
    """[1/s] desired decay exp(−decay t) of the error; tuned."""
    move_weight: Positive = 0.001
    """[m²/rad²] q of Q = q I, for a joint step of 0.05 s; only settles the free joints."""
    terminal_weight: NonNegative = 0.0
    """[1] extra weight of the final error, against that of 0.05 s."""
    iterations: Count = 2
    """[1] Gauss-Newton steps per period at most; 1 is the real-time iteration."""
    image: bool = False
    """Offset-free control; false: encoders and model alone."""
    image_window: Annotated[Positive, Only(image=True)] = 0.5
    """[s] of frames for the image's offset from the model."""
    joint_acceleration_limit: PositiveOrInfinite = math.inf
    """[rad/s²] limit between two commands; inf: none."""
    limit_position: bool = True
    """Keep predicted joint positions within the plant's limits."""
    fallback: Literal["hold", "raise"] = "hold"
    """Without a solution: zero velocity, or `SolverFailed`."""


@final
class NmpcCalibrated(Controller):
    """Predictive control with the true forward kinematics h, solved by sequential quadratic programming.

        min  ½ Σ_τ w_τ ‖y_ref(τ) − β^τ e − h(q_τ) − b‖² + ½ q Σ_τ ‖dq_τ‖²,   q_τ = q̂ + Σ_{s≤τ} dq_s

    over speed, acceleration and position limits; e = y_ref(0) − h(q̂) − b, β = exp(−decay Δ). Time τ counts blocks of
    length Δ (`Blocks`) from `delay` ahead; after it the joints are taken as ideal: q̂ = q + the steps sent in
    the last `delay` seconds. Each iteration is a Gauss-Newton step: h is linearised along the present plan, at first
    the last one shifted by one control period, and the program of `laws.mpc.qp` gives the next one. Not in the paper.

    Without `image`, b = 0: the effect of perfect calibration alone, which no feedback reaches. With it the control is
    offset-free: b is the median, component by component, of y − h(q(t − a)) over the frames of `image_window`, with the
    true age a of each frame, so that fewer than half of them may be outliers. Where frames are late by unknown times, a
    is the age within the true bounds at which the frame agrees best with the present b. Where the camera is known to
    turn, features and reference are taken into the frame of its first pose; where the tool is known to be flexible,
    commands pass an input shaper, whose delay is bridged as well.

    | here | meaning | shape | unit |
    |---|---|---|---|
    | `plan` | dq_1 … dq_H | (H, n) | rad |
    | `J` | ∂h/∂q along the plan | (H, m, n) | m/rad |
    | `b` | measured feature minus that of the model at the exposure | (m,) | m |
    """

    def __init__(self, config: NmpcCalibratedConfig, knowledge: RobotKnowledge) -> None:
        """Build the linearisation and the quadratic program.

        Raises:
            ValueError: the symbolic kinematics is not known or has another size, or the preview is too short.
        """
        knowledge = in_natural_units(knowledge)
        period = knowledge.spec.period
        blocks = closed_form.Blocks.of(config.horizon_time, config.moves, period)
        self._taps = np.ones(1)
        if config.image:
            self._taps = zero_vibration_taps(*knowledge.true_tool, period)
        shaper_delay = period * float(np.arange(len(self._taps)) @ self._taps)
        delay = config.delay + shaper_delay
        reach = blocks.count * blocks.length + delay
        check_preview(reach, knowledge.preview, period, "horizon_time + delay")
        if knowledge.true_symbolic is None:
            raise ValueError(
                "true_symbolic must be known for nmpc_calibrated; this plant has no symbolic kinematics"
            )
        self._config = config
        self._spec = knowledge.spec
        self._knowledge = knowledge
        n = self._spec.n
        m = self._spec.m
        self._model = _linearisation(knowledge.true_symbolic, n, m)
        self._blocks = blocks
        self._places = blocks.places(delay)
        self._to_come = shaped_shares(closed_form.bridging_shares(config.delay, period), self._taps)
        self._along_plan = self._model.map(blocks.count)
        self._shares = closed_form.decay_shares(blocks.count, config.decay * blocks.length)
        ages = exposure_ages(knowledge.true_delays or Delays(0.0, 0.0, 0.0), period)
        self._reach = math.ceil(ages[-1])  # periods of the past in which frames were exposed
        self._exposures = self._reach - ages
        self._change: FloatArray = np.full(n, config.joint_acceleration_limit * blocks.length)
        limited = math.isfinite(config.joint_acceleration_limit)
        terminal = config.terminal_weight / blocks.relative_length
        self._shape = QpShape(
            weights=closed_form.move_weights(blocks.count, 1.0, terminal),
            move_weight=np.full(n, config.move_weight / blocks.relative_length**2),
            constant_gain=None,
            largest_move=self._spec.joint_velocity_limit * blocks.length,
            largest_change=self._change * blocks.length if limited else None,
            limit_position=config.limit_position,
            view_rows=np.zeros((0, m)),
            varying_jacobian=True,
        )
        self._program = QpProgram(self._shape, raises=config.fallback == "raise")
        # A turn of the camera is known to act on points, not on pixels.
        self._turn = knowledge.true_camera_turn if config.image and m == 3 else 0.0
        self._frames = 1 + 2 * whole_periods(0.5 * config.image_window, period)
        self._forget()

    def _forget(self) -> None:
        """Start a run: nothing was sent, and the model counts as right until half of the offsets differ."""
        n = self._spec.n
        m = self._spec.m
        self._plan: FloatArray = np.zeros((self._blocks.count, n))
        self._sent: FloatArray = np.zeros((len(self._to_come), n))
        self._last: FloatArray = np.zeros(n)
        self._b: FloatArray = np.zeros(m)
        self._offsets: FloatArray = np.zeros((self._frames, m))
        self._past: FloatArray | None = None
        self._jacobian: FloatArray | None = None
        self._fallbacks = 0
        self._diagnostics: dict[str, float] = {}

    def reset(self, observation: Observation, seed: int) -> None:
        """Forget plan, commands sent and disturbance; nothing is random.

        Raises:
            ValueError: an observation of the wrong size.
        """
        del seed
        self._knowledge.check(observation)
        self._forget()

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the first step of the best plan as a joint velocity; see `Controller.step`.

        Raises:
            ValueError: an observation or a reference of the wrong size.
            SolverFailed: no solution, and the fallback is "raise".
        """
        self._knowledge.check(observation, reference)
        present = observation.joint_position
        feature, self._jacobian = self._evaluate(present)
        if self._config.image:
            self._observe(observation, feature)
        start = present + self._to_come @ self._sent
        times: FloatArray = observation.time + self._spec.period * np.arange(float(len(reference)))
        fixed = self._fixed(reference / self._knowledge.unit, times)
        rows = sampled(fixed, self._places)
        error = rows[0] - self._evaluate(start)[0] - self._b
        displacements = closed_form.decay_targets(error, rows[1:] - rows[0], self._shares)
        wanted = rows[0] - error + displacements - self._b
        plan = self._improve(start, wanted)
        limit = self._spec.joint_velocity_limit
        velocity = np.clip(plan[0] / self._blocks.length, -limit, limit)

        # The share of the first block that passes in this period shifts the plan.
        passed = 1.0 / self._blocks.periods
        next_blocks = np.concatenate([plan[1:], plan[-1:]])
        self._plan = (1.0 - passed) * plan + passed * next_blocks
        self._last = velocity * self._blocks.length
        sent = np.concatenate([self._sent, velocity[None] * self._spec.period])
        self._sent = sent[1:]
        if len(self._taps) > 1:
            newest_first = sent[: -1 - len(self._taps) : -1]
            shaped = self._taps @ newest_first / self._spec.period
            velocity = np.clip(shaped, -limit, limit)
        return Command(velocity)

    def diagnostics(self) -> Diagnostics:
        """Return solver success, iterations, last change of the plan, objective, fallbacks so far, predicted error."""
        return dict(self._diagnostics)

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the true Jacobian (m, n) at the last observation, or None before there was one."""
        if self._jacobian is None:
            return None
        return self._knowledge.unit * self._jacobian

    def _shared(self) -> Iterable[object]:
        return self._knowledge, self._model, self._along_plan, self._shape, self._program

    def _observe(self, observation: Observation, feature: FloatArray) -> None:
        """Estimate b from a frame, given the feature (m,) of the model at the present joint positions."""
        if self._past is None:
            self._past = np.tile(feature, (self._reach + 1, 1))
        self._past = np.vstack([self._past[1:], feature])
        if not observation.feature_valid:
            return
        exposed = observation.time - self._spec.period * (self._reach - self._exposures)
        measured = np.tile(observation.feature / self._knowledge.unit, (len(exposed), 1))
        offsets = self._fixed(measured, exposed) - sampled(self._past, self._exposures)
        # Of the possible exposures the one counts at which the frame agrees best with the present b.
        nearest = offsets[np.linalg.norm(offsets - self._b, axis=-1).argmin()]
        self._offsets = np.vstack([self._offsets[1:], nearest])
        self._b = np.median(self._offsets, axis=0)

    def _fixed(self, features: FloatArray, times: FloatArray) -> FloatArray:
        """Return features (k, m) in the frame of the camera at times (k,) [s] in that of its first pose.

        A camera that is known to turn about its optical axis by ω t shows p(t) = R_z(−ω t) p(0).
        """
        if self._turn == 0.0:
            return features
        c = np.cos(self._turn * times)
        s = np.sin(self._turn * times)
        x, y, z = features.T
        return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)

    def _evaluate(self, joint_position: FloatArray) -> tuple[FloatArray, FloatArray]:
        feature, jacobian = self._model(joint_position)
        return np.asarray(feature)[:, 0], np.asarray(jacobian)

    def _improve(self, start: FloatArray, wanted: FloatArray) -> FloatArray:
        """Return a plan, (H, n) rad, from `start`, (n,) rad, to features `wanted`, (H, m); rest without a solution."""
        last = (self._last, self._change * self._spec.period)
        bounds = joint_bounds(self._shape, self._spec, last, start, np.zeros(0))
        plan = self._plan
        change = math.inf
        iterations = 0
        while iterations < self._config.iterations and change > _PLAN_TOLERANCE:
            J, targets = self._linearise(start, plan, wanted)
            solution = self._program.solve(J, targets, bounds)
            if not solution.success:
                self._fallbacks += 1
                self._note(solution, 0, math.nan, math.nan)
                return np.zeros_like(plan)
            change = float(np.abs(solution.moves - plan).max())
            plan = solution.moves
            iterations += 1
        miss = targets[-1] - J[-1] @ plan.sum(axis=0)
        terminal_error = float(np.linalg.norm(miss))
        self._note(solution, iterations, change, terminal_error)
        return plan

    def _linearise(
        self, start: FloatArray, plan: FloatArray, wanted: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return J (H, m, n) along the plan and the targets (H, m) that J Σ dq should meet."""
        travel = np.cumsum(plan, axis=0)
        features, jacobians = self._along_plan((start + travel).T)
        stacked = (self._spec.m, self._blocks.count, self._spec.n)
        J = np.asarray(jacobians).reshape(stacked).swapaxes(0, 1)
        # h(q) ≈ h(plan) + J (Σ dq − travel) along the plan.
        return J, wanted - np.asarray(features).T + np.einsum("tij,tj->ti", J, travel)

    def _note(
        self, solution: QpSolution, iterations: int, change: float, terminal_error: float
    ) -> None:
        self._diagnostics = {
            "solver_success": float(solution.success),
            "solver_iterations": float(iterations),
            "plan_change": change,
            "objective": solution.objective if solution.success else math.nan,
            "fallbacks": float(self._fallbacks),
            "predicted_terminal_error": terminal_error,
        }


def exposure_ages(delays: Delays, period: float) -> FloatArray:
    """Return how old the newest frame may be at a control instant, [periods]: one age, or several, ascending.

    Args:
        delays: the true ones; a frame that is late by an unknown time also waits for the control instant.
        period: of control [s].
    """
    youngest = in_periods(delays.latency, period)
    spread = in_periods(delays.latency_spread, period)
    if spread == 0.0:
        return np.array([youngest])
    return youngest + np.arange(0.0, spread + 1.0, 1.0 / AGES)


def zero_vibration_taps(frequency: float, damping: float, period: float) -> FloatArray:
    """Return the taps of an input shaper after which a damped oscillator does not swing, (k,), the newest first.

    The second of two impulses, half a damped oscillation T later, cancels the first: 1/(1 + K) and K/(1 + K) with
    K = exp(−ζ ω T) (zero-vibration shaper; Singer and Seering, J. Dyn. Syst. Meas. Control 112, 1990). Between control
    instants it is shared by the two beside it.

    Args:
        frequency: ω, natural frequency [rad/s]; 0 for nothing that swings.
        damping: ζ, below 1.
        period: of control [s].
    """
    if frequency == 0.0:
        return np.ones(1)
    half = math.pi / (frequency * math.sqrt(1.0 - damping**2))
    second = 1.0 - 1.0 / (1.0 + math.exp(-damping * frequency * half))
    place = in_periods(half, period)
    taps = np.zeros(2 + int(place))
    share = place % 1.0
    taps[int(place) :] = second * np.array([1.0 - share, share])
    taps[0] += 1.0 - second
    return taps


def shaped_shares(to_come: FloatArray, taps: FloatArray) -> FloatArray:
    """Return the share of each of the last steps planned that is to come after an input shaper, the newest one last.

    Args:
        to_come: the same of steps commanded, see `bridging_shares`.
        taps: of the shaper, the newest first.
    """
    oldest = len(to_come) + len(taps) - 1
    ages = np.arange(oldest, 0, -1)[:, None] - np.arange(len(taps))
    commanded = np.concatenate([to_come[::-1], np.zeros(len(taps))])
    shares = np.where(ages <= 0, 1.0, commanded[np.maximum(ages, 1) - 1])
    return shares @ taps


def _linearisation(symbolic: Any, n: int, m: int) -> Any:  # noqa: ANN401 - an expression and a function of CasADi
    """Return q -> (h(q), ∂h/∂q) with CasADi's own differentiation.

    Raises:
        ValueError: an expression of another size than (m, 1).
    """
    import casadi  # noqa: PLC0415 - other methods start without it

    q = casadi.MX.sym("joint_position", n)
    feature = symbolic(q)
    if feature.shape != (m, 1):
        raise ValueError(
            f"true_symbolic must give an expression of shape ({m}, 1), got {feature.shape}"
        )
    function = casadi.Function("linearisation", [q], [feature, casadi.jacobian(feature, q)])
    try:
        return function.expand()
    # Foreign code, such as an FMU's, has no scalar operations; expanding only saves time.
    except RuntimeError:
        return function


ENTRY = ControllerEntry(
    name="nmpc_calibrated",
    summary="nonlinear predictive control over the true kinematics: an upper bound with limits and preview",
    config=NmpcCalibratedConfig,
    build=NmpcCalibrated,
    needs_truth=True,
)
