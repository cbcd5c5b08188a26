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
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from annotated_types import Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.inverses import damped_inverse
from servobench.controllers.laws.law import Law, Stage
from servobench.controllers.laws.learned_correction import LearnedCorrection
from servobench.controllers.laws.limit import largest_excess, redistribute, scale_to_limit
from servobench.controllers.laws.prediction import Predictor, shifted
from servobench.controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import ControllerNetwork
from servobench.controllers.rotation import nearest_rotation
from servobench.plant.checks import FloatArray
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


@final
class RbfnnBridgedLaw(Law):
    """u = dq / dt with dq as above, limited such that the feature's direction stays.

    Symbols: e error (m,) m; q joint position (n,) rad; Ĵ (m, n) m/rad; z, ŷ feature (m,) m; d delay of the camera,
    periods, from the estimate; lead, periods, a fraction: between two instants the reference is interpolated,
    beyond the preview it goes on as in its last period.
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
        self._n, self._m = spec.n, spec.m
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
            spec.n,
            bridge=config.bridge,
            response_length=config.response_length,
            observe=config.observe,
            feature_noise=config.feature_noise,
            find_noise=config.find_noise,
            model_error=config.model_error,
        )
        self._wanted = np.zeros(self._n)

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

    def reset(self, observation: Observation) -> None:
        """Forget everything that was learned and seen."""
        self._law.reset(observation)
        self._predictor.reset()
        self._wanted = np.zeros(self._n)

    def command(self, estimate: Estimate, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return u, (n,), rad/s; see `Law.command`.

        Raises:
            ValueError: a delay beyond what the law keeps of the past.
        """
        config, J = self._config, estimate.jacobian
        bound = self._predictor.predict(estimate, observation)
        ahead = shifted(reference, bound.lead, self._rows)
        wanted = self._wanted = self._wanted_step(J, bound.feature, bound.joint_position, ahead, observation)
        if config.redistribute:
            lower, upper = self._region
            further = np.maximum(bound.joint_position - lower, 0.0), np.maximum(upper - bound.joint_position, 0.0)
            dq = redistribute(wanted, J, self._limit, config.damping, further)
        else:
            dq = scale_to_limit(wanted, self._limit)
        self._predictor.note(dq)
        return dq / self._period

    def diagnostics(self) -> Diagnostics:
        """Return criterion, α, predicted error, norm of what was learned, lead (periods), saturation."""
        learned = self._law.diagnostics()
        saturated = float(largest_excess(self._wanted, self._limit) > 1.0)
        return {**{name: learned[name] for name in LEARNED}, "lead": self._predictor.lead, "saturated": saturated}

    def _wanted_step(
        self, jacobian: FloatArray, y: FloatArray, q: FloatArray, reference: FloatArray, observation: Observation
    ) -> FloatArray:
        """Return the joint step before it is limited, (n,), rad, for predicted feature and joints."""
        config, law, forward = self._config, self._law, np.zeros(self._m)
        if config.feedforward:
            forward = reference[1] - reference[0]
        if isinstance(law, LearnedCorrection):
            return law.step(jacobian, reference[0] - y, q, forward, observation.feature_valid)
        if config.feedforward:
            reference = np.repeat(reference[:1], len(reference), axis=0)
        F = self._frame(jacobian, q)
        predicted = Observation(observation.time, q, F @ y, observation.feature_valid)
        law.command(Estimate(F @ jacobian), predicted, reference @ F.T)
        return np.asarray(law.wanted + damped_inverse(jacobian, config.damping) @ forward)

    def _frame(self, jacobian: FloatArray, q: FloatArray) -> FloatArray:
        """Return the rotation from the camera's frame into that of the model, (m, m): the nearest of Ĵ to the model."""
        if not self._config.frame:
            return np.eye(self._m)
        return nearest_rotation(self._model.jacobian(q) @ jacobian.T)
