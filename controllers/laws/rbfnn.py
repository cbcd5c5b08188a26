"""The control law of the proposed method: a controller matrix that learns from its own predicted errors (eqs. 7–27)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from controllers.controller import Diagnostics
from controllers.laws.law import Law, scale_to_limit
from controllers.laws.roll_out import RollOut, descent_direction, roll_out, update_step
from controllers.networks import ControllerNetwork, controller_output, information_vector
from plant.signals import FloatArray, Observation, PlantSpec, check_number

Position = Literal["measured", "commanded"]


@dataclass(frozen=True)
class RbfnnConfig:
    """Settings of the online update; the network's structure is in `training.controller`."""

    horizon: int = 8  # T, predicted steps
    k: float = 0.03  # share of the predicted error that one update removes, 0 < k < 2
    epsilon: float = 1e-3  # ε of the step size, (m² rad/…)²
    preview: bool = True  # predict with the known future of the reference, else with its present
    position: Position = "measured"  # q in ξ: the encoders', or the commands summed up as in the paper

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("horizon", self.horizon, at_least=1)
        check_number("k", self.k, above=0.0, below=2.0)
        check_number("epsilon", self.epsilon, at_least=0.0)
        if self.position not in get_args(Position):
            raise ValueError(f"position must be one of {', '.join(get_args(Position))}, got {self.position!r}")


class RbfnnLaw(Law):
    def __init__(self, config: RbfnnConfig, network: ControllerNetwork, spec: PlantSpec, preview: int) -> None:
        if (network.n, network.m) != (spec.n, spec.m):
            raise ValueError(f"network must be of {spec.n} joints and {spec.m} features, got {network.n} and {network.m}")
        if config.preview and preview < config.horizon:
            raise ValueError(f"preview must be at least the horizon of {config.horizon} rows, got {preview}")
        self._config = config
        self._network = network
        self._limit = spec.joint_velocity_limit
        self._period = spec.period
        self._forget()

    def _forget(self):
        self._weights = self._network.weights.copy()
        self._errors = None
        self._diagnostics = {}

    def reset(self, observation):
        self._forget()
        self._positions = np.tile(observation.joint_position, (self._network.position_history, 1))

    def command(self, jacobian, observation, reference):
        c = self._config; net = self._network
        e = reference[0] - observation.feature
        if self._errors is None:
            self._errors = np.tile(e, (net.error_history, 1))
        else:
            self._errors = np.concatenate([e[None], self._errors[:-1]])
        if c.position == "measured" and getattr(self, "_started", None):
            self._positions = np.concatenate([observation.joint_position[None], self._positions[:-1]])
        elif c.position == "measured":
            self._positions = np.tile(observation.joint_position, (net.position_history, 1))
        self._started = True
        steps = np.diff(reference[: c.horizon + 1], axis=0) if c.preview else np.zeros((c.horizon, net.m))
        limit = self._limit * self._period
        ahead = roll_out(net, self._weights, jacobian, (self._errors, self._positions), steps, limit)
        xi, h = ahead.xi[0], ahead.h[0]
        q = self._positions[0]
        raw = controller_output(self._weights, xi, h) - q
        sat = float(np.max(np.abs(raw) / limit))
        alpha = 0.0
        aw = getattr(self, "antiwindup", False)
        if observation.feature_valid and not (aw and sat > 1.0):
            G = descent_direction(jacobian, ahead)
            alpha = update_step(G, ahead, c.k, c.epsilon)
            self._G2 = np.vdot(G, G)
            self._weights = self._weights + alpha * G
        dq = controller_output(self._weights, xi, h) - q
        dq = scale_to_limit(dq, limit)
        if c.position == "commanded":
            self._positions = np.concatenate([(q + dq)[None], self._positions[:-1]])
        self._alpha = alpha
        return dq / self._period

    def diagnostics(self):
        return self._diagnostics
