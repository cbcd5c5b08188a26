"""Where the first Jacobian comes from: the nominal model, small probing moves, or a matrix that is given.

Probing needs no model. One joint after the other makes a small move and rests until command delay, joint lag and camera
latency have died out; the features of a rest are averaged. With the rest-to-rest motions as columns of ΔY (m, n) and
ΔQ (n, n), the least-squares Jacobian is

    Ĵ₀ = ΔY ΔQ⁺
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, final

import numpy as np

from servobench.controllers.controller import JacobianFunction, RobotKnowledge
from servobench.plant.checks import FloatArray
from servobench.plant.faults import ControllerDiverged
from servobench.plant.settings import Count, Number, Periods, Positive, settings
from servobench.plant.signals import Observation, PlantSpec


@settings
class InitialConfig:
    """Settings of the initial Jacobian; by default a probe rests for longer than lag, delay and latency last."""

    source: Literal["nominal", "probe", "given"] = "nominal"
    """Where Ĵ₀ comes from: the nominal model, probing moves, or `given`."""
    probe_step: Positive = 0.03
    """[rad] size of a probing move: some 20 mm at the ball, far above 1 mm of noise."""
    probe_periods: Count = 2
    """[periods] over which a probing move is spread."""
    settle_periods: Periods = 7
    """[periods] of rest before a feature counts."""
    average_periods: Count = 3
    """[periods] valid features that are averaged at each rest."""
    given: tuple[tuple[Number, ...], ...] = ()
    """[m/rad] m rows of n entries; only for source "given"."""


class InitialJacobian(ABC):
    """Provides Ĵ₀, at once or after some moves of its own."""

    @abstractmethod
    def reset(self, observation: Observation) -> None:
        """Forget everything and prepare for a run that starts with `observation`."""

    @abstractmethod
    def step(self, observation: Observation) -> FloatArray | None:
        """Return the joint velocity (n,), rad/s, of a probing move, or None once the Jacobian is known."""

    @abstractmethod
    def jacobian(self) -> FloatArray:
        """Return Ĵ₀, (m, n), m/rad; only after `step` has returned None."""


@final
class KnownJacobian(InitialJacobian):
    """Ĵ₀ = J(q(0)) of a model, which may be constant."""

    def __init__(self, model: JacobianFunction, spec: PlantSpec) -> None:
        """Take the model, (n,) rad -> (m, n) m/rad, and the sizes that it must have."""
        self._model = model
        self._shape = (spec.m, spec.n)

    def reset(self, observation: Observation) -> None:
        """Evaluate the model at the start.

        Raises:
            ValueError: the model is that of another robot.
        """
        self._jacobian = np.array(self._model(observation.joint_position), dtype=np.float64)
        if self._jacobian.shape != self._shape:
            raise ValueError(f"nominal_jacobian must return shape {self._shape}, got {self._jacobian.shape}")

    def step(self, observation: Observation) -> None:
        """Return None: nothing has to move."""

    def jacobian(self) -> FloatArray:
        """Return Ĵ₀, (m, n), m/rad."""
        return self._jacobian.copy()


@final
class ProbedJacobian(InitialJacobian):
    """Ĵ₀ = ΔY ΔQ⁺ from one small move of each joint, rest to rest.

    Encoder readings are used for ΔQ, so a joint that falls short of its command does no harm. Lost frames prolong a
    rest: it ends with the wanted number of valid features.
    """

    def __init__(self, config: InitialConfig, spec: PlantSpec) -> None:
        """Plan the moves.

        Raises:
            ValueError: a probing move that is faster than a joint may be, or too large for its range.
        """
        self._config = config
        self._spec = spec
        self._speed = config.probe_step / (config.probe_periods * spec.period)
        slowest = float(spec.joint_velocity_limit.min())
        if self._speed > slowest:
            largest = slowest * config.probe_periods * spec.period
            raise ValueError(
                f"probe_step must be at most {largest:.6g} rad for probe_periods = {config.probe_periods}, or a joint "
                f"exceeds its limit of {slowest:g} rad/s; got {config.probe_step:g} rad"
            )
        narrowest = float((spec.joint_upper - spec.joint_lower).min())
        if 2.0 * config.probe_step > narrowest:
            raise ValueError(
                f"probe_step must be at most half the joint range of {narrowest:g} rad, got {config.probe_step:g}"
            )
        self._forget()

    def _forget(self) -> None:
        self._rests: list[tuple[FloatArray, FloatArray]] = []
        self._gathered: list[tuple[FloatArray, FloatArray]] = []
        self._phase = self._config.settle_periods  # the arm starts at rest
        self._rest_begins = 0

    def reset(self, observation: Observation) -> None:
        """Forget all moves; the start is the first rest."""
        self._forget()

    def step(self, observation: Observation) -> FloatArray | None:
        """Return the velocity of the probing move, zero while resting, None when all joints have moved."""
        if self._phase >= self._rest_begins + self._config.settle_periods and observation.feature_valid:
            self._gathered.append((observation.joint_position, observation.feature))
        if len(self._gathered) == self._config.average_periods:
            positions, features = (np.mean(values, axis=0) for values in zip(*self._gathered, strict=True))
            self._rests.append((positions, features))
            self._gathered, self._phase, self._rest_begins = [], 0, self._config.probe_periods
        joint = len(self._rests) - 1
        if joint == self._spec.n:
            return None
        u = np.zeros(self._spec.n)
        if self._phase < self._rest_begins:
            room_above = self._rests[-1][0][joint] + self._config.probe_step <= self._spec.joint_upper[joint]
            u[joint] = self._speed if room_above else -self._speed
        self._phase += 1
        return u

    def jacobian(self) -> FloatArray:
        """Return Ĵ₀, (m, n), m/rad.

        Raises:
            ControllerDiverged: a joint did not move, so its column is unknown.
        """
        Q, Y = (np.diff(np.array(values), axis=0) for values in zip(*self._rests, strict=True))
        if np.linalg.svd(Q, compute_uv=False)[-1] < 0.1 * self._config.probe_step:
            raise ControllerDiverged(
                f"probing moved the joints too little to measure a Jacobian: joint steps {Q.tolist()} rad"
            )
        return np.asarray(np.linalg.lstsq(Q, Y, rcond=None)[0].T)


def initial_jacobian(config: InitialConfig, knowledge: RobotKnowledge) -> InitialJacobian:
    """Return the provider that `config` asks for.

    Raises:
        ValueError: the nominal Jacobian is wanted where no model exists, or settings that do not fit the plant.
    """
    spec, model = knowledge.spec, knowledge.nominal_jacobian
    if config.source == "probe":
        return ProbedJacobian(config, spec)
    if config.source == "given":
        lengths = [len(row) for row in config.given]
        if lengths != [spec.n] * spec.m:
            raise ValueError(f"given must hold {spec.m} rows of {spec.n} entries, got rows of length {lengths}")
        return KnownJacobian(lambda _: np.array(config.given), spec)
    if model is None:
        raise ValueError(
            "source 'nominal' needs a nominal model, and this plant has none; take 'probe' or 'given' instead"
        )
    return KnownJacobian(model, spec)
