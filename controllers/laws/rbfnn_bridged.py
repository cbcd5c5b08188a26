"""Law of `rbfnn_mfac_plus`: the proposed law on a feature that is predicted past all delays. Not in the paper.

    ŷ = z + Ĵ (q(k) − q(k−d) + flight)              where the feature will be when all commands are done
    q̂ = q(k) + flight                               and the joints
    e = y_ref(k + lead) − ŷ                         against the reference of that time
    dq = law(e, q̂) + Ĵ⁺ (y_ref(k + lead + 1) − y_ref(k + lead))

z is the feature at its exposure, d periods ago (`feature_filter`); flight and lead are what commands have not yet done
(`joint_response`); the law is that of `learned_correction`, or the unchanged one of `rbfnn_mfac` in the frame of the
model that its networks were trained on. What exceeds the limits of joint speed is redistributed (`redistribution`).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, final

import numpy as np
from annotated_types import Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.inverses import damped_inverse
from servobench.controllers.laws.law import Law, Stage
from servobench.controllers.laws.learned_correction import LearnedCorrection
from servobench.controllers.laws.limit import largest_excess, redistribute, scale_to_limit
from servobench.controllers.laws.prediction import Predictor, PredictorState, shifted
from servobench.controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import ControllerNetwork
from servobench.controllers.rotation import nearest_rotation
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import transposed
from servobench.plant.settings import Count, NonNegative, Positive, Share, settings
from servobench.plant.signals import Observation

LEARNED = ("criterion", "step_size", "predicted_error", "learned_weight_norm")  # diagnostics that both bases have


@settings
class RbfnnBridgedConfig:
    """Settings of the law; each addition to `rbfnn` can be switched off."""

    base: Literal["jacobian", "network"] = "jacobian"
    """To what the learned part is added: Ĵ⁺ as estimated, or the offline network as in `rbfnn`."""
    horizon: Count = 8
    """[periods] T, predicted steps; base "network" only."""
    k: Annotated[NonNegative, Lt(2.0)] = 0.1
    """[1] share of the predicted error that one update removes; 0 learns nothing."""
    epsilon: NonNegative = 1e-3
    """[m⁴] ε; updates fade where predicted errors are millimetres."""
    leak: Share = 0.02
    """[1/period] l, share of what was learned that is forgotten; base "jacobian" only."""
    gain: Positive = 14.0
    """[1/s] K_p; the error shrinks by exp(−K_p dt) per period; base "jacobian" only."""
    posture_gain: NonNegative = 0.2
    """[1/s] K_n, towards the middle of the training region; base "jacobian" only."""
    damping: Positive = 0.02
    """[m/rad] δ, damping of every inverse of Ĵ."""
    frame: bool = True
    """Apply the law in the frame of the networks' model; base "network" only."""
    bridge: bool = True
    """Predict past the camera's delay and past the part of the commands that is still to come."""
    response_length: Count = 12
    """[periods] N, within which joints respond to a command."""
    observe: bool = True
    """Filter the feature with the motion of the joints."""
    feature_noise: Positive = 0.001
    """[m] σ, standard deviation of the feature per axis; the initial guess."""
    find_noise: bool = True
    """Estimate σ; false: it is as given."""
    model_error: NonNegative = 0.2
    """[1] c, error of Ĵ as a share of its size."""
    feedforward: bool = True
    """Add the reference's own motion; needs a preview of at least 1."""
    redistribute: bool = True
    """Let joints with room make up for those at their limit."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if self.base == "network" and self.k == 0.0:
            raise ValueError("k must be above 0 for base 'network', got 0")


class BridgedState(NamedTuple):
    """The state of the law.

    Attributes:
        learned: of `LearnedCorrection` or of `RbfnnLaw`.
        predictor: of the predict stage.
        wanted: (..., n), rad, the joint step of the last command before it was limited.
    """

    learned: Any
    predictor: PredictorState
    wanted: FloatArray


@final
class RbfnnBridgedLaw(Law[BridgedState]):
    """u = dq / dt with dq as above, limited such that the feature's direction stays.

    Symbols: e error (..., m) m; q joint position (..., n) rad; Ĵ (..., m, n) m/rad; z, ŷ feature (..., m) m;
    d delay of the camera, periods, from the estimate; lead, periods, a fraction: between two instants the reference is
    interpolated, beyond the preview it goes on as in its last period.
    """

    owns: ClassVar[frozenset[Stage]] = frozenset({"predict", "posture", "limit"})

    def __init__(self, config: RbfnnBridgedConfig, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:
        """Take the settings, the offline networks, limits, period and preview.

        Raises:
            ValueError: networks that do not fit, a preview that is too short.
        """
        spec, network = knowledge.spec, networks.controller
        if (network.n, network.m) != (spec.n, spec.m):
            raise ValueError(
                f"network must be of {spec.n} joints and {spec.m} features, got {network.n} and {network.m}"
            )
        if config.feedforward and knowledge.preview < 1:
            raise ValueError(f"preview must be at least 1 for feedforward, got {knowledge.preview}")
        self._config, self._period = config, spec.period
        self._m = spec.m
        self._limit: FloatArray = spec.joint_velocity_limit * spec.period
        self._model = networks.jacobian
        centres = networks.jacobian.centres
        self._region = centres.min(axis=(0, 1)), centres.max(axis=(0, 1))  # where the networks were trained
        if config.base == "network":
            settings = RbfnnConfig(config.horizon, config.k, config.epsilon, preview=not config.feedforward)
            self._law: LearnedCorrection | RbfnnLaw = RbfnnLaw(settings, knowledge, networks)
        else:
            self._law = self._correction(network, centres.mean(axis=(0, 1)))
        self._rows = 1 + knowledge.preview if config.base == "network" else 1 + int(config.feedforward)
        self._predictor = Predictor(
            bridge=config.bridge,
            response_length=config.response_length,
            observe=config.observe,
            feature_noise=config.feature_noise,
            find_noise=config.find_noise,
            model_error=config.model_error,
        )

    def _correction(self, network: ControllerNetwork, posture: FloatArray) -> LearnedCorrection:
        config = self._config
        return LearnedCorrection(
            network,
            posture,
            self._limit,
            k=config.k,
            epsilon=config.epsilon,
            leak=config.leak,
            error_share=1.0 - math.exp(-config.gain * self._period),
            posture_share=1.0 - math.exp(-config.posture_gain * self._period),
            damping=config.damping,
        )

    def start(self, observation: Observation) -> BridgedState:
        """Return the state of one that has learned and seen nothing."""
        zero = np.zeros_like(observation.joint_position)
        return BridgedState(self._law.start(observation), self._predictor.start(observation), zero)

    def command(
        self, state: BridgedState, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[BridgedState, FloatArray]:
        """Return the new state and u, (..., n), rad/s; see `Law.command`.

        Raises:
            ValueError: a delay beyond what the law keeps of the past.
        """
        config, J = self._config, estimate.jacobian
        predictor, bound = self._predictor.predict(state.predictor, estimate, observation)
        q, later = bound.joint_position, shifted(reference, bound.lead, self._rows)
        learned, wanted = self._wanted_step(state, J, observation.seen_as(q, bound.feature), later)
        if config.redistribute:
            lower, upper = self._region
            further = np.maximum(q - lower, 0.0), np.maximum(upper - q, 0.0)
            dq = redistribute(wanted, J, self._limit, config.damping, further)
        else:
            dq = scale_to_limit(wanted, self._limit)
        return BridgedState(learned, self._predictor.note(predictor, dq), wanted), dq / self._period

    def diagnostics(self, state: BridgedState) -> Diagnostics:
        """Return criterion, α, predicted error, norm of what was learned, lead (periods), saturation."""
        learned = self._law.diagnostics(state.learned)
        saturated = largest_excess(state.wanted, self._limit) > 1.0
        lead = state.predictor.response.lead
        return {**{name: learned[name] for name in LEARNED}, "lead": lead, "saturated": saturated}

    def _wanted_step(
        self, state: BridgedState, jacobian: FloatArray, ahead: Observation, reference: FloatArray
    ) -> tuple[Any, FloatArray]:
        """Return the new state of the inner law and the joint step before it is limited, (..., n), rad."""
        config, law, y, q = self._config, self._law, ahead.feature, ahead.joint_position
        forward = reference[..., 1, :] - reference[..., 0, :] if config.feedforward else np.zeros_like(y)
        if isinstance(law, LearnedCorrection):
            return law.step(state.learned, jacobian, reference[..., 0, :] - y, q, forward, ahead.feature_valid)
        if config.feedforward:
            reference = np.repeat(reference[..., :1, :], reference.shape[-2], axis=-2)
        F = self._frame(jacobian, q)
        turned = ahead.seen_as(q, np.matvec(F, y))
        learned, _ = law.command(state.learned, Estimate(F @ jacobian), turned, reference @ transposed(F))
        return learned, learned.wanted + np.matvec(damped_inverse(jacobian, config.damping), forward)

    def _frame(self, jacobian: FloatArray, q: FloatArray) -> FloatArray:
        """Return the rotation from the camera's frame into that of the model, (..., m, m): nearest of Ĵ to the model.

        Without `frame` it is the identity.
        """
        if not self._config.frame:
            return np.eye(self._m)
        return nearest_rotation(self._model.jacobian(q) @ transposed(jacobian))
