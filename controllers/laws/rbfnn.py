"""The control law of the proposed method: a controller matrix that learns from its own predicted errors (eqs. 7–27).

With Ĵ and the weights frozen, for t = 1 … T, in steps of the length for which the network was trained:

    q(k+t−1) = limit(ψ(ξ) ξ),   e(k+t) = y_ref(k+t) − y_ref(k+t−1) + e(k+t−1) − Ĵ Δq(k+t−1)
    G_j = Σ_t [Ĵᵀ e(k+t)] ξ_j(k+t−1) h(k+t−1)ᵀ,   α = k Σ_t ‖e(k+t)‖² / (ε + ‖G‖²_F),   W_j ← W_j + α G_j

−G is the gradient of I_c = ½ Σ ‖e(k+t)‖² with the paper's truncation (eq. 18): each term is differentiated through its
own step only.
"""

import math
from dataclasses import replace
from functools import cache
from typing import Annotated, Literal, NamedTuple, final

import numpy as np
from annotated_types import Lt

from servobench.controllers.algebra import project_to_row_space
from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.laws.law import Estimate, Law
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import (
    ControllerNetwork,
    controller_output,
    information_vector,
)
from servobench.controllers.periods import check_preview, in_periods, sampled
from servobench.controllers.stages.finish import largest_excess
from servobench.controllers.stages.prediction import pushed
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm
from servobench.plant.contract.settings import Count, NonNegative, Positive, settings
from servobench.plant.contract.signals import BoolArray, Observation


class RollOut(NamedTuple):
    """The trajectory of the predicted loop."""

    errors: FloatArray  # e(k+1) … e(k+T), (..., T, m), m
    xi: FloatArray  # ξ(k) … ξ(k+T−1), (..., T, p)
    h: FloatArray  # h(k) … h(k+T−1), (..., T, N_h)
    wanted: FloatArray  # ψ(ξ) ξ less `ControllerNetwork.origin`, (..., n), rad, the first step before its limit


def roll_out(
    network: ControllerNetwork,
    weights: FloatArray,
    jacobian: FloatArray,
    history: tuple[FloatArray, FloatArray],
    reference_steps: FloatArray,
    step_limit: FloatArray,
) -> RollOut:
    """Predict the loop T steps ahead with frozen weights and Jacobian.

    Args:
        network: structure, centres and widths.
        weights: W, (..., n, p, N_h), as they are now.
        jacobian: Ĵ, (..., m, n), m/rad.
        history: errors e(k) …, (..., L_e, m), and joint positions q(k−1) …, (..., L_c, n), the newest first.
        reference_steps: y_ref(k+t) − y_ref(k+t−1) for t = 1 … T, (..., T, m), m.
        step_limit: (n,), rad, largest joint step.

    Returns:
        Errors, information vectors and hidden layers.
    """
    *lead, horizon, m = reference_steps.shape
    n, p, hidden = weights.shape[-3:]
    errors, positions = history
    shift = _shift(m, n, errors.shape[-2], positions.shape[-2])
    A = np.broadcast_to(shift, (*lead, p, p + n + m)).copy()
    A[..., :m, p : p + n] = -jacobian
    # A state is [ξ, Δq, y_ref(k+t) − y_ref(k+t−1)], and A times it is the next ξ.
    states = np.empty((*lead, horizon + 1, p + n + m))
    hs = np.empty((*lead, horizon, hidden))
    xis = states[..., :p]
    xis[..., 0, :] = information_vector(errors, positions)
    states[..., :-1, p + n :] = reference_steps
    reach = 1.0 / step_limit
    wanted = np.zeros((*lead, n))
    for t in range(horizon):
        state = states[..., t, :]
        xi = xis[..., t, :]
        h = network.features(xi)
        hs[..., t, :] = h
        dq = controller_output(weights, xi, h) - network.origin(xi)
        if t == 0:
            wanted = dq
        # The joint that exceeds its limit most sets the scale of all, as the stage "limit" does.
        excess = np.maximum.reduce(np.abs(dq) * reach, axis=-1, keepdims=True, initial=1.0)
        state[..., p : p + n] = dq / excess
        np.matvec(A, state, out=xis[..., t + 1, :])
    return RollOut(xis[..., 1:, :m].copy(), xis[..., :-1, :].copy(), hs, wanted)


@cache
def _shift(m: int, n: int, error_history: int, position_history: int) -> FloatArray:
    """Return A with ξ(k+t) = A [ξ(k+t−1), Δq, Δy_ref] where Ĵ = 0, (p, p + n + m).

    The newest error is e + Δy_ref and the newest position q + Δq; older ones move on by one place.
    """
    positions = m * error_history  # where positions begin in ξ
    p = positions + n * position_history
    A = np.zeros((p, p + n + m))
    _push_entries(A, 0, positions, size=m, added=p + n)
    _push_entries(A, positions, p, size=n, added=p)
    A.flags.writeable = False
    return A


def _push_entries(A: FloatArray, begin: int, end: int, size: int, added: int) -> None:
    """Fill the rows of a history from `begin` to `end`, `size` entries each, whose newest grows by those at `added`."""
    newest = slice(begin, begin + size)
    older = slice(begin + size, end)
    A[newest, newest] = np.eye(size)
    A[newest, added : added + size] = np.eye(size)
    A[older, begin : end - size] = np.eye(end - begin - size)


def descent_direction(jacobian: FloatArray, ahead: RollOut) -> FloatArray:
    """Return G = −∂I_c/∂W with the paper's truncation, (..., n, p, N_h) (eq. 18)."""
    pull = ahead.errors @ jacobian
    outer = pull[..., :, None] * ahead.xi[..., None, :]
    *lead, horizon, n, p = outer.shape
    flat = outer.reshape(*lead, horizon, n * p)
    return np.asarray(flat.mT @ ahead.h).reshape(*lead, n, p, -1)


def update_step(direction: FloatArray, ahead: RollOut, k: float, epsilon: float) -> FloatArray:
    """Return α = k Σ‖e(k+t)‖² / (ε + ‖G‖²_F), (...), (eq. 23 with ε); 0 where there is nothing to descend."""
    wanted = k * sum_of_squares(ahead.errors, 2)
    size = epsilon + sum_of_squares(direction, 3)
    return wanted * (size > 0.0) / (size + (size == 0.0))


def sum_of_squares(array: FloatArray, axes: int) -> FloatArray:
    """Return the sum of squares over the last axes, (...)."""
    flat = array.reshape(*array.shape[:-axes], -1)
    return np.vecdot(flat, flat)


@settings
class RbfnnConfig:
    """Settings of the online update; the structure of the network (L_e, L_c, N_h, kernel) belongs to its training."""

    horizon: Count = 8
    """[1] T, predicted steps of `training.controller.step`."""
    k: Annotated[Positive, Lt(2.0)] = 0.1
    """[1] share of the predicted error removed per step; large: fast and little damped."""
    epsilon: NonNegative = 1e-3
    """[m⁴] ε; updates fade at predicted errors of millimetres."""
    preview: bool = True
    """Predict with the previewed reference; false: with its present value."""
    position: Literal["measured", "commanded"] = "measured"
    """Joint position q in ξ: by the encoders, or the sum of all commands as in the paper."""
    offset_free: bool = False
    """Subtract the trained command at rest instead of q; not the paper's."""
    row_space_only: bool = True
    """Learn only outside the null space of Ĵ; false as in the paper."""
    anti_windup: bool = True
    """Learn nothing that drives a limited command further; false as in the paper."""


class RbfnnState(NamedTuple):
    """The state of the law."""

    learned: FloatArray  # W − W(0), (..., n, p, N_h)
    errors: FloatArray  # e, the newest first, a row for each period, (..., rows, m), m; NaN before the first command
    positions: FloatArray  # q, likewise, (..., rows, n), rad
    predicted: FloatArray  # e(k+1) … e(k+T), (..., T, m), m, as the last command predicted them
    step_size: FloatArray  # α at the last update, (...)


@final
class RbfnnLaw(Law[RbfnnState]):
    """u(k) = (ψ(k) ξ(k) − q) / s, with ψ_j = W_j h(ξ) learned online.

        ξ(k) = [e(k) … e(k−L_e+1), q(k−1) … q(k−L_c)]                        (eq. 11)
        h_l = exp(−‖ξ − c_l‖ / γ_l²)                                          (eq. 16)
        W_j ← W_j + α Σ_{t=1..T} [Ĵᵀ e(k+t)] ξ_j(k+t−1) h(k+t−1)ᵀ             (eqs. 18, 19)
        α = k' Σ ‖e(k+t)‖² / (ε + ‖Σ_t …‖²_F),   0 < k' < 2                    (eq. 23)

    All of it counts in steps of s seconds, the step for which the network was trained, and not in control periods of dt
    seconds: k ± 1 is s later or earlier. An update of a control period has k' = 1 − (1 − k)^(dt / s), so that those of
    s seconds remove the share k together, and at most k (`update_share`). Command and learning per second therefore do
    not depend on the control rate. The paper has s = dt.

    e(k+t) come from `roll_out`; the command uses the new weights. Symbols: e = y_ref − y (..., m) m; q joint position
    (..., n) rad; Ĵ (..., m, n) m/rad; W_j (..., n, N_h); T horizon; α step size;
    s step [s].

    Departures from the paper:
    - ε, the joint-speed limit in prediction and command, and α > 0 where the paper writes a negative α into an update
      with the opposite sign.
    - "q(k−1)" is by default the measured position at instant k, from which the next step starts: the sum of all
      commands drifts away from the arm where a joint saturates or does not reach its commanded speed.
    - A network fitted offline does not rest where e = 0: far outside of its region it asks for more than 1 rad/s there,
      and the weights learn too little against small errors to cancel that. `offset_free` steps from the trained command
      without errors instead of q, u = [ψ(ξ) ξ − ψ₀(0, q) (0, q)] / s; the trained posture of the arm is cancelled too.
    - The weights integrate Ĵᵀe. As the arm moves, Ĵ turns, and with n > m a part of the learned weights comes to lie in
      the null space of Ĵ, where no error can ever unlearn it: it drives the arm into ever new postures. With
      `row_space_only` the learned part W − W(0) is projected on the row space of Ĵ, which leaves Ĵ Δq as it was.
    - Without anti-windup the weights grow as long as a limited command cannot follow.
    - Without a valid feature nothing is learned; the last error is held.
    """

    in_model_frame = True

    def __init__(
        self, config: RbfnnConfig, knowledge: RobotKnowledge, networks: TrainedNetworks
    ) -> None:
        """Take the settings, the offline networks, limits, period and preview.

        Raises:
            ValueError: a preview shorter than the horizon.
        """
        spec = knowledge.spec
        network = replace(networks.controller, offset_free=config.offset_free)
        self.owns = frozenset()
        if config.preview:
            reach = config.horizon * network.step
            check_preview(reach, knowledge.preview, spec.period, "the law's horizon")
            self.owns = frozenset({"preview"})
        self._config = config
        self._network = network
        self._period = spec.period
        self._step = network.step
        self._step_limit = spec.joint_velocity_limit * network.step
        self._share = update_share(config.k, spec.period, network.step)
        rate = in_periods(network.step, spec.period)
        self._preview_places = rate * np.arange(config.horizon + 1.0)
        self._error_places = rate * np.arange(float(network.error_history))
        self._position_places = rate * np.arange(float(network.position_history))
        self._error_rows = 1 + math.ceil(float(self._error_places[-1]))
        self._position_rows = 1 + math.ceil(float(self._position_places[-1]))

    def start(self, observation: Observation) -> RbfnnState:
        """Return the state of the offline network."""
        network = self._network
        lead = observation.lead
        q = observation.joint_position
        learned = np.zeros((*lead, *network.weights.shape))
        unknown = np.full((*lead, self._error_rows, network.m), np.nan)
        positions = np.repeat(q[..., None, :], self._position_rows, axis=-2)
        predicted = np.zeros((*lead, self._config.horizon, network.m))
        step_size = np.zeros(lead)
        return RbfnnState(learned, unknown, positions, predicted, step_size)

    def command(
        self, state: RbfnnState, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[RbfnnState, FloatArray]:
        """Return the new state and u, (..., n), rad/s; see `Law.command`."""
        config = self._config
        jacobian = estimate.jacobian
        errors = pushed(state.errors, reference[..., 0, :] - observation.feature)
        # The first error fills its history.
        begins = np.isnan(errors[..., -1, 0])
        errors = branch(begins, self._filled, errors)
        positions = state.positions
        if config.position == "measured":
            positions = pushed(positions, observation.joint_position)
        learned = state.learned
        if config.row_space_only:
            learned = project_to_row_space(learned, jacobian)
        weights = self._network.weights + learned
        steps = self._reference_steps(reference)
        history = (sampled(errors, self._error_places), sampled(positions, self._position_places))
        ahead = roll_out(self._network, weights, jacobian, history, steps, self._step_limit)
        direction = descent_direction(jacobian, ahead)
        alpha, wanted = self._update(direction, ahead, observation.feature_valid)
        direction *= alpha[..., None, None, None]
        # Weights are large: the update goes into the array of the direction, and no further one is made.
        learned = np.add(learned, direction, out=direction)
        alpha = np.where(observation.feature_valid, alpha, state.step_size)[()]
        new = RbfnnState(learned, errors, positions, ahead.errors, alpha)
        return new, wanted / self._step

    def noted(
        self, state: RbfnnState, joint_velocity: FloatArray, limited: BoolArray
    ) -> RbfnnState:
        """Return the state with the step that is sent among the commanded positions; see `Law.noted`."""
        if self._config.position == "measured":
            return state
        newest = state.positions[..., 0, :] + joint_velocity * self._period
        return state._replace(positions=pushed(state.positions, newest))

    def diagnostics(self, state: RbfnnState) -> Diagnostics:
        """Return I_c = ½ Σ ‖e(k+t)‖² (eq. 15, m²), step size α, ‖e(k+T)‖ (m), norms of weights."""
        weights = self._network.weights + state.learned
        weight_square = sum_of_squares(weights, 3)
        learned_square = sum_of_squares(state.learned, 3)
        last = state.predicted[..., -1, :]
        return {
            "criterion": 0.5 * sum_of_squares(state.predicted, 2),
            "step_size": state.step_size,
            "predicted_error": norm(last),
            "controller_weight_norm": np.sqrt(weight_square),
            "learned_weight_norm": np.sqrt(learned_square),
        }

    def _filled(self, errors: FloatArray) -> FloatArray:
        """Return a history of which every error is the newest one."""
        return np.repeat(errors[..., :1, :], self._error_rows, axis=-2)

    def _reference_steps(self, reference: FloatArray) -> FloatArray:
        """Return the assumed steps of the reference in the T steps of the horizon, (..., T, m), m."""
        horizon = self._config.horizon
        if not self._config.preview:
            return np.zeros((*reference.shape[:-2], horizon, self._network.m))
        rows = sampled(reference, self._preview_places)
        return rows[..., 1:, :] - rows[..., :-1, :]

    def _update(
        self, direction: FloatArray, ahead: RollOut, valid: bool | BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return α, (...), and the joint step of the weights with the update α G, (..., n), rad.

        α is 0 without a valid feature. Anti-windup: where the old weights exceed the limit, an update that exceeds it
        further is dropped.
        """
        alpha = update_step(direction, ahead, self._share, self._config.epsilon) * valid
        push = controller_output(direction, ahead.xi[..., 0, :], ahead.h[..., 0, :])
        if self._config.anti_windup:
            renewed = ahead.wanted + alpha[..., None] * push
            before = largest_excess(ahead.wanted, self._step_limit)
            after = largest_excess(renewed, self._step_limit)
            alpha = alpha * ((before <= 1.0) | (after <= before))
        return alpha, ahead.wanted + alpha[..., None] * push


def update_share(k: float, period: float, step: float) -> float:
    """Return k', the share of the predicted error that one update removes, below 2.

    Args:
        k: that of the updates of one step, below 2.
        period: of control, in which one update is made [s].
        step: [s].

    Returns:
        1 − (1 − k)^(period / step): as many updates as a step has periods remove k together; k period / step for k of 1
        and more, which removes more than all of the error. No update removes more than k: its effect shows after the
        loop's delay only, and where a period is longer than the step, updates that do not wait for it add up.
    """
    steps = in_periods(period, step)
    if k >= 1.0:
        return min(k * steps, k)
    return min(-math.expm1(steps * math.log1p(-k)), k)
