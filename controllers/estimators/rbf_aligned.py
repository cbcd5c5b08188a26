"""Estimator of `rbfnn_mfac_plus`: the Jacobian network seen through an estimated map and with an estimated delay.

    Ĵ(q) = M̄ Ĵ_net(q),   Δy(k) ≈ M̄ Ĵ_net Δq(k − d)

The network models the arm and the map M the camera: a turned camera is a rotation in front of the whole Jacobian, which
a map learns from two motions and a network cannot learn. Not in the paper.
"""

from __future__ import annotations

import math
from typing import Annotated, final

import numpy as np
from annotated_types import Le, Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import MAX_DELAY, Estimate
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.map_bank import map_update, near_rotation
from servobench.controllers.estimators.pairing import MAX_GAP, MotionHistory
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray
from servobench.plant.settings import Count, NonNegative, Periods, Positive, settings

MIN_JUMP_RATIO = 2.0  # [1] to the longest predicted step; a longer step of the feature is no motion of the arm
MIN_JUMP_DEVIATIONS = 10.0  # [σ] above which it is no noise either
NIS_CAP = 50.0  # [1] of ‖ν‖²/s, the normalised innovation squared (NIS), of one motion in the score of a delay
CUSUM_DRIFT = 3.0  # [1] NIS per feature that is subtracted at each motion; 1 is its expectation
CUSUM_CAP = 10.0  # [1] NIS per feature of one motion, so that one outlier cannot reach the gate


@settings
class RbfAlignedConfig:
    """Settings of the network's update, of the map and of the delay."""

    window: Count = 1
    """[motions] T, from which the network learns at once."""
    k2: Annotated[Positive, Lt(2.0)] = 0.5
    """[1] k₂, step size of the network."""
    epsilon: NonNegative = 0.03
    """[rad²] ε as for `rbf`, at the initial guess of the noise; it grows with σ²."""
    learn: bool = True
    """Let the network learn online, from motions that the map's rotation turns into its frame."""
    align: bool = True
    """Estimate the map; false: M = I."""
    initial_deviation: Positive = 1.0
    """[1] of an entry of M = I at first: any camera is possible."""
    walk: NonNegative = 0.3
    """[1/√m] w, deviation of an entry of M after the feature has moved by a metre."""
    model_error: NonNegative = 0.1
    """[1] c, share of a step that the model does not explain."""
    rotation_deviation: NonNegative = 0.2
    """[1] ς, of an entry of M from the nearest rotation; 0: M is the rotation."""
    feature_noise: Positive = 0.001
    """[m] σ, standard deviation of the feature per axis; the initial guess."""
    find_noise: bool = True
    """Estimate σ; false: it is as given."""
    confidence: Positive = 0.5
    """[1] deviation of an entry of M below which the network learns."""
    find_delay: bool = True
    """Estimate the delay; false: 0."""
    longest_delay: Annotated[Periods, Le(MAX_DELAY)] = 5
    """[periods] D, the longest delay that is considered."""
    forgetting: Annotated[Positive, Le(1.0)] = 1.0
    """[1] γ, of a candidate's score per motion; below 1 for a latency that changes."""
    margin: NonNegative = 6.0
    """[1] by which a delay must be better than the present one, in −2 log likelihood."""
    detect_moves: bool = True
    """Forget what is known of the map when the camera seems to have been moved."""
    gate: Positive = 12.0
    """[1] sum of innovations (CUSUM) beyond which it seems so."""


@final
class RbfAlignedEstimator(Estimator):
    """Jacobian network, map and delay.

        P ← P + w² ‖x_d‖ I, no larger than P₀;   M, P ← map_update(x_d, Δy)   for each delay d   (`map_bank`)
        d = argmin ℓ_d with forgetting γ, once it is the better one by a margin
        M̄, R = near_rotation(M_d, P_d);   the network learns from (Δq(k−d), RᵀΔy) as in `rbf`

    with x_d = Ĵ_net Δq(k−d). Symbols: M map (m, m); P its covariance (m, m); R rotation (m, m); d delay, periods; σ m.

    The network's ε is in proportion to σ²: with a noisier feature it learns from larger motions only.

    P returns to P₀ for all delays when the camera seems to have been moved: a feature step that no motion of the arm
    explains, from which nothing is learned, or a CUSUM of innovations, C ← max(0, C + min(‖ν‖²/(s m), 10) − 3) beyond a
    gate. M stays, as the best guess.
    """

    def __init__(self, config: RbfAlignedConfig, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:
        """Start from the offline Jacobian network."""
        self._config, network = config, networks.jacobian
        self._network = RbfEstimator(RbfConfig(config.window, config.k2, config.epsilon), knowledge, networks)
        self._period = knowledge.spec.period
        self._eye = np.eye(network.m)
        self._n, self._m = network.n, network.m
        self._candidates = 1 + (config.longest_delay if config.find_delay else 0)
        self._forget()

    def _forget(self) -> None:
        eye, config = self._eye, self._config
        self._P0 = (config.initial_deviation**2 if config.align else 0.0) * eye
        self._bank: FloatArray = np.repeat(np.concatenate([eye, self._P0])[None], self._candidates, axis=0)  # M above P
        self._scores = np.zeros(self._candidates)
        self._noise = NoiseLevel(config.feature_noise)
        self._delay = 0
        self._map, self._rotation = eye, eye
        self._history = MotionHistory(self._candidates, self._n, self._m)
        self._moves = 0
        self._key, self._latest = b"", np.zeros((self._m, self._n))
        self._nis = self._cusum = 0.0

    @property
    def map(self) -> FloatArray:
        """M̄ as it is now, (m, m); a copy."""
        return self._map.copy()

    @property
    def covariance(self) -> FloatArray:
        """P of the present delay, (m, m); a copy."""
        return self._bank[self._delay, self._m :].copy()

    def reset(self, jacobian: FloatArray) -> None:
        """Forget everything and restore the offline network; see `RbfEstimator.reset`."""
        self._network.reset(jacobian)
        self._forget()

    def estimate(self, joint_position: FloatArray) -> Estimate:
        """Return Ĵ at `joint_position` (n,), rad, with d and σ."""
        return Estimate(self.jacobian(joint_position), self._delay, math.sqrt(self._noise.variance))

    def update(self, motion: Motion) -> None:
        """Learn map, delay and network from one motion."""
        config, periods = self._config, max(1, round(motion.duration / self._period))
        if periods > MAX_GAP:
            self._history.forget()
            return
        q, dq = motion.joint_position, motion.joint_step
        self._history.append(q, dq, self._network_jacobian(q).dot(dq), periods)
        begins, steps, x = self._history.motions(periods)
        square = np.add.reduce(x * x, axis=1)
        if config.detect_moves and self._jumped(square, motion.feature_step):
            self._expect_any_map()
            if config.find_noise:
                self._noise.learn(float(motion.feature_step @ motion.feature_step) / self._m, 2.0, 0.0)
            return
        if config.align or config.find_delay:
            self._learn_map(x, square, motion.feature_step)
        if config.learn and self._deviation() < config.confidence:
            begin, step = begins[self._delay], steps[self._delay]
            seen = self._rotation.T @ motion.feature_step
            self._key = b""
            self._network.scale_epsilon(self._noise.variance / config.feature_noise**2)
            self._network.update(Motion(begin, step, seen, motion.error, motion.duration))

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return M̄ Ĵ_net at `joint_position` (n,), rad."""
        return np.asarray(self._map.dot(self._network_jacobian(joint_position)))

    def diagnostics(self) -> Diagnostics:
        """Return those of the network, and delay, rotation (rad), deviation and NIS of the map, moves, noise level."""
        cosine = min(1.0, max(-1.0, 1.0 - 0.25 * float(np.sum((self._rotation - self._eye) ** 2))))
        return {
            **self._network.diagnostics(),
            "delay": float(self._delay),
            "map_rotation": math.acos(cosine),
            "map_deviation": self._deviation(),
            "map_surprise": self._nis,
            "camera_moves": float(self._moves),
            "noise_level": math.sqrt(self._noise.variance),
        }

    def _network_jacobian(self, q: FloatArray) -> FloatArray:
        """Return Ĵ_net, (m, n), at q; cached because it is needed several times at one place between two updates."""
        key = q.tobytes()
        if key != self._key:
            self._key, self._latest = key, self._network.jacobian(q)
        return self._latest

    def _jumped(self, square: FloatArray, feature_step: FloatArray) -> bool:
        reach = math.sqrt(max(square.tolist()))
        seen = math.sqrt(float(feature_step @ feature_step))
        return seen > MIN_JUMP_RATIO * reach + MIN_JUMP_DEVIATIONS * math.sqrt(self._noise.variance)

    def _expect_any_map(self) -> None:
        self._bank[:, self._m :] = self._P0
        self._cusum, self._moves = 0.0, self._moves + 1

    def _deviation(self) -> float:
        return math.sqrt(float(self._bank[self._delay, self._m :].trace()) / self._m)

    def _learn_map(self, x: FloatArray, square: FloatArray, feature_step: FloatArray) -> None:
        """Update map, covariance and score of every delay, and choose among them."""
        config, m = self._config, self._m
        variance = 2.0 * self._noise.variance + config.model_error**2 * square
        if config.align:
            P = self._bank[:, m:]
            P += (config.walk**2 * np.sqrt(square))[:, None, None] * self._eye
            excess = P.trace(axis1=1, axis2=2) / (m * config.initial_deviation**2)
            if max(excess.tolist()) > 1.0:
                P /= np.maximum(excess, 1.0)[:, None, None]
        bank, nis, s = map_update(self._bank, x, feature_step, variance)
        self._nis, expected = float(nis[self._delay]) / m, float(s[self._delay])
        if config.find_noise:
            self._noise.learn(self._nis * expected, 2.0, expected - 2.0 * self._noise.variance)
        self._cusum = max(0.0, self._cusum + min(self._nis, CUSUM_CAP) - CUSUM_DRIFT)
        if config.detect_moves and self._cusum > config.gate:
            self._expect_any_map()
            bank, _, _ = map_update(self._bank, x, feature_step, variance)
        self._bank = bank
        self._scores = config.forgetting * self._scores + np.minimum(nis, NIS_CAP) + m * np.log(s)
        best = int(self._scores.argmin())
        if self._scores[best] < self._scores[self._delay] - config.margin:
            self._delay = best
        if config.align:
            now = bank[self._delay]
            self._map, self._rotation = near_rotation(now[:m], now[m:], config.rotation_deviation)
