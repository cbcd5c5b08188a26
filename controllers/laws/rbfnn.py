"""The control law of the proposed method: a controller matrix that learns from its own predicted errors (eqs. 7–27)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final, get_args

import numpy as np

from controllers.controller import Diagnostics, RobotKnowledge
from controllers.laws.law import Law, scale_to_limit
from controllers.laws.roll_out import RollOut, descent_direction, roll_out, update_step
from controllers.networks import ControllerNetwork, controller_output
from plant.signals import FloatArray, Observation, check_number

Position = Literal["measured", "commanded"]
POSITIONS: tuple[str, ...] = get_args(Position)


@dataclass(frozen=True)
class RbfnnConfig:
    """Settings of the online update; the structure of the network (L_e, L_c, N_h, kernel) belongs to its training."""

    horizon: int = 8  # T, predicted steps
    k: float = 0.1  # share of the predicted error that one update removes, 0 < k < 2; large k: fast, less damped
    epsilon: float = 1e-3  # ε, m⁴: updates fade where predicted errors are millimetres
    preview: bool = True  # predict with the known future of the reference; False: with its present value
    position: Position = "measured"  # q in ξ: the encoders'; "commanded": the sum of all commands, as in the paper
    row_space_only: bool = True  # keep what is learned out of the null space of Ĵ; False as in the paper
    anti_windup: bool = True  # learn nothing that drives a limited command further; False as in the paper

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("horizon", self.horizon, at_least=1)
        check_number("k", self.k, above=0.0, below=2.0)
        check_number("epsilon", self.epsilon, at_least=0.0)
        if self.position not in POSITIONS:
            raise ValueError(f"position must be one of {', '.join(POSITIONS)}, got {self.position!r}")


@final
class RbfnnLaw(Law):
    """u(k) = (ψ(k) ξ(k) − q) / dt, with ψ_j = W_j h(ξ) learned online.

        ξ(k) = [e(k) … e(k−L_e+1), q(k−1) … q(k−L_c)]                        (eq. 11)
        h_l = exp(−‖ξ − c_l‖ / γ_l²)                                          (eq. 16)
        W_j ← W_j + α Σ_{t=1..T} [Ĵᵀ e(k+t)] ξ_j(k+t−1) h(k+t−1)ᵀ             (eqs. 18, 19)
        α = k Σ ‖e(k+t)‖² / (ε + ‖Σ_t …‖²_F),   0 < k < 2                     (eq. 23)

    e(k+t) come from `roll_out`; the command uses the new weights. Symbols: e = y_ref − y (m,) m; q joint position (n,)
    rad; Ĵ (m, n) m/rad; W_j (n, N_h); T horizon; α step size.

    Departures from the paper:
    - ε, and the joint-speed limit in prediction and command.
    - "q(k−1)" is by default the measured position at instant k, from which the next step starts: the sum of all
      commands drifts away from the arm where a joint saturates or does not reach its commanded speed.
    - The weights integrate Ĵᵀe. As the arm moves, Ĵ turns, and with n > m a part of what was learned comes to lie in
      the null space of Ĵ, where no error can ever unlearn it: it drives the arm into ever new postures. With
      `row_space_only` the learned part W − W(0) is projected on the row space of Ĵ, which leaves Ĵ Δq as it was.
    - Without anti-windup the weights grow as long as a limited command cannot follow.
    - Without a valid feature nothing is learned; the last error is held.
    """

    def __init__(self, config: RbfnnConfig, network: ControllerNetwork, knowledge: RobotKnowledge) -> None:
        """Take the settings, the offline network, limits, period and preview.

        Raises:
            ValueError: a network of other sizes than the plant, or a preview shorter than the horizon.
        """
        spec = knowledge.spec
        if (network.n, network.m) != (spec.n, spec.m):
            raise ValueError(
                f"network must be of {spec.n} joints and {spec.m} features, got {network.n} and {network.m}"
            )
        if config.preview and knowledge.preview < config.horizon:
            raise ValueError(
                f"preview must be at least the horizon of {config.horizon} rows, got {knowledge.preview}; "
                "lengthen it, shorten the horizon or switch the law's preview off"
            )
        self._config = config
        self._network = network
        self._period = spec.period
        self._step_limit = spec.joint_velocity_limit * spec.period
        self._forget()

    @property
    def weights(self) -> FloatArray:
        """W as it is now, (n, p, N_h); a copy."""
        return np.asarray(self._network.weights + self._learned)

    def _forget(self) -> None:
        self._learned = np.zeros(self._network.weights.shape)
        self._errors: FloatArray | None = None
        self._positions: FloatArray | None = None
        self._step_size = 0.0
        self._saturated = False
        self._criterion, self._predicted_error = 0.0, 0.0

    def reset(self, observation: Observation) -> None:
        """Restore the offline network and empty both histories."""
        self._forget()

    def command(self, jacobian: FloatArray, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return u, (n,), rad/s; see `Law.command`."""
        config, network = self._config, self._network
        self._errors = _pushed(self._errors, reference[0] - observation.feature, network.error_history)
        if self._positions is None or config.position == "measured":
            self._positions = _pushed(self._positions, observation.joint_position, network.position_history)
        if config.row_space_only:
            self._learned = project_to_row_space(self._learned, jacobian)
        ahead = self._predict(jacobian, reference)
        xi, h, q = ahead.xi[0], ahead.h[0], self._positions[0]
        wanted = controller_output(self.weights, xi, h) - q
        if observation.feature_valid:
            wanted = self._learn(jacobian, ahead, wanted)
        step = scale_to_limit(wanted, self._step_limit)
        if config.position == "commanded":
            self._positions = _pushed(self._positions, q + step, network.position_history)
        self._saturated = self._excess(wanted) > 1.0
        return step / self._period

    def diagnostics(self) -> Diagnostics:
        """Return criterion I_c (m²), step size α, predicted error ‖e(k+T)‖ (m), norms of weights, saturation."""
        return {
            "criterion": self._criterion,
            "step_size": self._step_size,
            "predicted_error": self._predicted_error,
            "controller_weight_norm": float(np.linalg.norm(self.weights)),
            "learned_weight_norm": float(np.linalg.norm(self._learned)),
            "saturated": float(self._saturated),
        }

    def _predict(self, jacobian: FloatArray, reference: FloatArray) -> RollOut:
        """Roll the loop ahead with the present weights."""
        assumed = reference[: self._config.horizon + 1]
        if not self._config.preview:
            assumed = np.repeat(reference[:1], self._config.horizon + 1, axis=0)
        history = _known(self._errors), _known(self._positions)
        steps = np.diff(assumed, axis=0)
        ahead = roll_out(self._network, self.weights, jacobian, history, steps, self._step_limit)
        self._criterion = ahead.criterion
        self._predicted_error = float(np.linalg.norm(ahead.errors[-1]))
        return ahead

    def _learn(self, jacobian: FloatArray, ahead: RollOut, wanted: FloatArray) -> FloatArray:
        """Update the weights and return the joint step that the new ones want, (n,), rad.

        Anti-windup: where the old weights exceed the limit, an update that exceeds it further is dropped.
        """
        direction = descent_direction(jacobian, ahead)
        alpha = update_step(direction, ahead, self._config.k, self._config.epsilon)
        renewed = wanted + alpha * controller_output(direction, ahead.xi[0], ahead.h[0])
        before = self._excess(wanted)
        if self._config.anti_windup and before > 1.0 and self._excess(renewed) > before:
            self._step_size = 0.0
            return wanted
        self._step_size = alpha
        self._learned = self._learned + alpha * direction
        return renewed

    def _excess(self, step: FloatArray) -> float:
        return float(np.max(np.abs(step) / self._step_limit))


def project_to_row_space(weights: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return Ĵ⁺Ĵ W: the part of the weights (n, p, N_h) whose output moves the feature under `jacobian` (m, n)."""
    projector = np.linalg.pinv(jacobian) @ jacobian
    return np.asarray((projector @ weights.reshape(len(weights), -1)).reshape(weights.shape))


def _pushed(history: FloatArray | None, newest: FloatArray, length: int) -> FloatArray:
    """Return the history (length, …), the newest first; a first value fills it."""
    if history is None:
        return np.repeat(newest[None], length, axis=0)
    return np.concatenate([newest[None], history[:-1]])


def _known(history: FloatArray | None) -> FloatArray:
    if history is None:
        raise ValueError("command must have been called before anything can be predicted")
    return history
