"""The control law of the proposed method: a controller matrix that learns from its own predicted errors (eqs. 7–27)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
from annotated_types import Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.inverses import project_to_row_space
from servobench.controllers.laws.law import Law, Stage
from servobench.controllers.laws.limit import largest_excess, scale_to_limit
from servobench.controllers.laws.prediction import pushed
from servobench.controllers.laws.roll_out import RollOut, descent_direction, roll_out, update_step
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import controller_output
from servobench.plant.checks import FloatArray
from servobench.plant.settings import Count, NonNegative, Positive, settings
from servobench.plant.signals import Observation


@settings
class RbfnnConfig:
    """Settings of the online update; the structure of the network (L_e, L_c, N_h, kernel) belongs to its training."""

    horizon: Count = 8
    """[periods] T, predicted steps."""
    k: Annotated[Positive, Lt(2.0)] = 0.1
    """[1] share of the predicted error that one update removes; a large one is fast and little damped."""
    epsilon: NonNegative = 1e-3
    """[m⁴] ε; updates fade where predicted errors are millimetres."""
    preview: bool = True
    """Predict with the known future of the reference; false: with its present value."""
    position: Literal["measured", "commanded"] = "measured"
    """The joint position q in ξ: as the encoders report it, or the sum of all commands as in the paper."""
    row_space_only: bool = True
    """Keep what is learned out of the null space of Ĵ; false as in the paper."""
    anti_windup: bool = True
    """Learn nothing that drives a limited command further; false as in the paper."""


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

    owns: ClassVar[frozenset[Stage]] = frozenset({"posture", "limit"})

    def __init__(self, config: RbfnnConfig, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:
        """Take the settings, the offline networks, limits, period and preview.

        Raises:
            ValueError: a network of other sizes than the plant, or a preview shorter than the horizon.
        """
        spec, network = knowledge.spec, networks.controller
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

    @property
    def wanted(self) -> FloatArray:
        """The joint step of the last command before it was limited, (n,), rad."""
        return self._wanted

    def _forget(self) -> None:
        self._learned = np.zeros(self._network.weights.shape)
        self._errors: FloatArray | None = None
        self._positions: FloatArray | None = None
        self._step_size = 0.0
        self._wanted = np.zeros(self._network.n)
        self._ahead: RollOut | None = None

    def reset(self, observation: Observation) -> None:
        """Restore the offline network and empty both histories."""
        self._forget()

    def command(self, estimate: Estimate, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return u, (n,), rad/s; see `Law.command`."""
        config, network, jacobian = self._config, self._network, estimate.jacobian
        self._errors = pushed(self._errors, reference[0] - observation.feature, network.error_history)
        if self._positions is None or config.position == "measured":
            self._positions = pushed(self._positions, observation.joint_position, network.position_history)
        if config.row_space_only:
            self._learned = project_to_row_space(self._learned, jacobian)
        history, reference_steps = (self._errors, self._positions), self._reference_steps(reference)
        ahead = self._ahead = roll_out(network, self.weights, jacobian, history, reference_steps, self._step_limit)
        wanted = self._wanted = self._learn(jacobian, ahead) if observation.feature_valid else ahead.wanted
        step = scale_to_limit(wanted, self._step_limit)
        if config.position == "commanded":
            self._positions = pushed(self._positions, self._positions[0] + step, network.position_history)
        return step / self._period

    def diagnostics(self) -> Diagnostics:
        """Return criterion I_c (m²), step size α, predicted error ‖e(k+T)‖ (m), norms of weights, saturation."""
        return {
            "criterion": self._ahead.criterion if self._ahead else 0.0,
            "step_size": self._step_size,
            "predicted_error": float(np.linalg.norm(self._ahead.errors[-1])) if self._ahead else 0.0,
            "controller_weight_norm": float(np.linalg.norm(self.weights)),
            "learned_weight_norm": float(np.linalg.norm(self._learned)),
            "saturated": float(largest_excess(self._wanted, self._step_limit) > 1.0),
        }

    def _reference_steps(self, reference: FloatArray) -> FloatArray:
        """Return how the reference is assumed to move in each of the T steps, (T, m), m."""
        if not self._config.preview:
            return np.zeros((self._config.horizon, self._network.m))
        return reference[1 : self._config.horizon + 1] - reference[: self._config.horizon]

    def _learn(self, jacobian: FloatArray, ahead: RollOut) -> FloatArray:
        """Update the weights and return the joint step that the new ones want, (n,), rad.

        Anti-windup: where the old weights exceed the limit, an update that exceeds it further is dropped.
        """
        direction = descent_direction(jacobian, ahead)
        alpha = update_step(direction, ahead, self._config.k, self._config.epsilon)
        renewed = ahead.wanted + alpha * controller_output(direction, ahead.xi[0], ahead.h[0])
        before = largest_excess(ahead.wanted, self._step_limit)
        if self._config.anti_windup and before > 1.0 and largest_excess(renewed, self._step_limit) > before:
            self._step_size = 0.0
            return ahead.wanted
        self._step_size = alpha
        self._learned = self._learned + alpha * direction
        return renewed
