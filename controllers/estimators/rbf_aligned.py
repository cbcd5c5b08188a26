"""Estimator of `rbfnn_mfac_plus`: the Jacobian network seen through an estimated map and with an estimated delay.

    Ĵ(q) = M̄ Ĵ_net(q),   Δy(k) ≈ M̄ Ĵ_net Δq(k − d)

The network models the arm and the map M the camera: a turned camera is a rotation in front of the whole Jacobian, which
a map learns from two motions and a network cannot learn. Not in the paper.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, final

import numpy as np
import numpy.typing as npt
from annotated_types import Le, Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import MAX_DELAY, Estimate
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.map_bank import map_update, near_rotation
from servobench.controllers.estimators.pairing import MAX_GAP, MotionHistory
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator, RbfState
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch, norm, pick
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


class RbfAlignedState(NamedTuple):
    """The state of network, map and delay.

    Attributes:
        network: of the network.
        bank: each candidate's map M above its covariance P, (..., D, 2m, m).
        scores: ℓ_d, (..., D).
        noise: σ².
        delay: d, (...) [periods].
        map: M̄, (..., m, m).
        rotation: R, (..., m, m).
        history: of motions.
        moves: how often the camera seems to have been moved, (...).
        nis: of the last motion per feature, (...).
        cusum: C, (...).
    """

    network: RbfState
    bank: FloatArray
    scores: FloatArray
    noise: NoiseLevel
    delay: npt.NDArray[np.int_]
    map: FloatArray
    rotation: FloatArray
    history: MotionHistory
    moves: npt.NDArray[np.int_]
    nis: FloatArray
    cusum: FloatArray


@final
class RbfAlignedEstimator(Estimator[RbfAlignedState]):
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
        """Take the settings and the offline Jacobian network, from which a run starts."""
        self._config, network = config, networks.jacobian
        self._network = RbfEstimator(RbfConfig(config.window, config.k2, config.epsilon), knowledge, networks)
        self._period = knowledge.spec.period
        self._n, self._m = network.n, network.m
        self._eye = np.eye(network.m)
        self._walk = np.concatenate([np.zeros_like(self._eye), self._eye])  # of a bank: M stays, P grows
        self._P0 = (config.initial_deviation**2 if config.align else 0.0) * self._eye
        self._candidates = 1 + (config.longest_delay if config.find_delay else 0)

    def start(self, jacobian: FloatArray) -> RbfAlignedState:
        """Start from the offline network, as drawn by its camera; see `RbfEstimator.start`."""
        lead, none = jacobian.shape[:-2], np.zeros(jacobian.shape[:-2], dtype=np.int_)
        bank, eye = np.concatenate([self._eye, self._P0]), np.broadcast_to(self._eye, (*lead, self._m, self._m))
        return RbfAlignedState(
            network=self._network.start(jacobian),
            bank=np.broadcast_to(bank, (*lead, self._candidates, *bank.shape)),
            scores=np.zeros((*lead, self._candidates)),
            noise=NoiseLevel.guess(self._config.feature_noise, lead),
            delay=none,
            map=eye,
            rotation=eye,
            history=MotionHistory.start(lead, self._candidates, self._n, self._m),
            moves=none,
            nis=np.zeros(lead),
            cusum=np.zeros(lead),
        )

    def covariance(self, state: RbfAlignedState) -> FloatArray:
        """Return P of the present delay, (..., m, m)."""
        return pick(state.bank, state.delay)[..., self._m :, :]

    def estimate(self, state: RbfAlignedState, joint_position: FloatArray) -> Estimate:
        """Return Ĵ at `joint_position` (..., n), rad, with d and σ."""
        return Estimate(self.jacobian(state, joint_position), state.delay, state.noise.deviation)

    def jacobian(self, state: RbfAlignedState, joint_position: FloatArray) -> FloatArray:
        """Return M̄ Ĵ_net at `joint_position` (..., n), rad, as (..., m, n) in m/rad."""
        return np.asarray(state.map @ self._network.jacobian(state.network, joint_position))

    def update(self, state: RbfAlignedState, motion: Motion) -> RbfAlignedState:
        """Learn map, delay and network from one motion."""
        periods = np.maximum(1, np.rint(motion.duration / self._period).astype(np.int_))
        short = periods <= MAX_GAP
        state = branch(np.logical_not(short), _without_past, state)
        return branch(short, self._learn, state, motion, periods)

    def diagnostics(self, state: RbfAlignedState) -> Diagnostics:
        """Return those of the network, and delay, rotation (rad), deviation and NIS of the map, moves, noise level."""
        turned = (state.rotation - self._eye).reshape(*np.shape(state.delay), -1)
        return {
            **self._network.diagnostics(state.network),
            "delay": state.delay,
            "map_rotation": np.arccos(np.maximum(1.0 - 0.25 * np.vecdot(turned, turned), -1.0)),
            "map_deviation": self._deviation(state),
            "map_surprise": state.nis,
            "camera_moves": state.moves,
            "noise_level": state.noise.deviation,
        }

    def _deviation(self, state: RbfAlignedState) -> FloatArray:
        deviation: FloatArray = np.sqrt(self.covariance(state).trace(axis1=-2, axis2=-1) / self._m)
        return deviation

    def _learn(self, state: RbfAlignedState, motion: Motion, periods: npt.NDArray[np.int_]) -> RbfAlignedState:
        q, dq, dy = motion.joint_position, motion.joint_step, motion.feature_step
        predicted = np.matvec(self._network.jacobian(state.network, q), dq)
        history = state.history.append(q, dq, predicted, periods)
        begins, steps, x = history.motions(periods, self._n)
        state, lengths = state._replace(history=history), norm(x)
        if not self._config.detect_moves:
            return self._follow(state, motion, begins, steps, x, lengths)
        reach = MIN_JUMP_RATIO * np.maximum.reduce(lengths, axis=-1) + MIN_JUMP_DEVIATIONS * state.noise.deviation
        jumped = norm(dy) > reach
        state = branch(jumped, self._jump, state, dy)
        return branch(np.logical_not(jumped), self._follow, state, motion, begins, steps, x, lengths)

    def _jump(self, state: RbfAlignedState, feature_step: FloatArray) -> RbfAlignedState:
        noise = state.noise
        if self._config.find_noise:
            noise = noise.learn(np.vecdot(feature_step, feature_step) / self._m, 2.0, np.zeros_like(state.cusum))
        bank = self._any_map(state.bank)
        return state._replace(bank=bank, cusum=np.zeros_like(state.cusum), moves=state.moves + 1, noise=noise)

    def _any_map(self, bank: FloatArray) -> FloatArray:
        """Return the bank with P₀ for all P."""
        unknown = np.broadcast_to(self._P0, (*bank.shape[:-2], self._m, self._m))
        return np.concatenate([bank[..., : self._m, :], unknown], axis=-2)

    def _follow(
        self,
        state: RbfAlignedState,
        motion: Motion,
        begins: FloatArray,
        steps: FloatArray,
        x: FloatArray,
        lengths: FloatArray,
    ) -> RbfAlignedState:
        config = self._config
        if config.align or config.find_delay:
            state = self._learn_map(state, x, lengths, motion.feature_step)
        if not config.learn:
            return state
        known = self._deviation(state) < config.confidence
        begin, step = pick(begins, state.delay), pick(steps, state.delay)
        seen = np.vecmat(motion.feature_step, state.rotation)
        own = Motion(begin, step, seen, motion.error, motion.duration)
        epsilon = state.noise.variance / config.feature_noise**2 * config.epsilon
        return state._replace(network=branch(known, self._network.learn, state.network, own, epsilon))

    def _learn_map(
        self, state: RbfAlignedState, x: FloatArray, lengths: FloatArray, feature_step: FloatArray
    ) -> RbfAlignedState:
        """Update map, covariance and score of every delay, and choose among them."""
        config, m, noise = self._config, self._m, state.noise
        variance = 2.0 * noise.variance[..., None] + config.model_error**2 * (lengths * lengths)
        before = self._walked(state.bank, lengths) if config.align else state.bank
        bank, nis, s = map_update(before, x, feature_step, variance)
        surprise, expected = pick(nis, state.delay) / m, pick(s, state.delay)
        if config.find_noise:
            noise = noise.learn(surprise * expected, 2.0, expected - 2.0 * noise.variance)
        cusum, moves = np.maximum(0.0, state.cusum + np.minimum(surprise, CUSUM_CAP) - CUSUM_DRIFT), state.moves
        if config.detect_moves:
            moved = cusum > config.gate
            bank = branch(moved, self._learn_any_map, bank, before, x, feature_step, variance)
            cusum, moves = cusum * ~moved, moves + moved
        scores = config.forgetting * state.scores + np.minimum(nis, NIS_CAP) + m * np.log(s)
        best = scores.argmin(axis=-1)
        better = pick(scores, best) < pick(scores, state.delay) - config.margin
        delay = np.where(better, best, state.delay)[()]
        state = state._replace(
            bank=bank, scores=scores, noise=noise, delay=delay, moves=moves, nis=surprise, cusum=cusum
        )
        if not config.align:
            return state
        now = pick(bank, delay)
        nearest, rotation = near_rotation(now[..., :m, :], now[..., m:, :], config.rotation_deviation)
        return state._replace(map=nearest, rotation=rotation)

    def _walked(self, bank: FloatArray, lengths: FloatArray) -> FloatArray:
        """Return the bank with P ← P + w² ‖x_d‖ I, no larger than P₀."""
        config, m = self._config, self._m
        walked = bank + (config.walk**2 * lengths)[..., None, None] * self._walk
        P = walked[..., m:, :]
        P /= np.maximum(P.trace(axis1=-2, axis2=-1) / (m * config.initial_deviation**2), 1.0)[..., None, None]
        return np.asarray(walked)

    def _learn_any_map(
        self, bank: FloatArray, before: FloatArray, x: FloatArray, feature_step: FloatArray, variance: FloatArray
    ) -> FloatArray:
        return map_update(self._any_map(before), x, feature_step, variance)[0]


def _without_past(state: RbfAlignedState) -> RbfAlignedState:
    return state._replace(history=state.history.forget())
