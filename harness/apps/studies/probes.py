"""Shortcuts: controllers without what a challenge is about; one that solves it shows that the challenge tells nothing.

With `constant`, the pseudo-inverse of the unchanged first Jacobian, these are the probes of an audit.
"""

import numpy as np

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation

GAIN = 3.0  # [1/s]
DAMPING = 0.02  # [m/rad] of the pseudo-inverse
HELD_AFTER = 1.0  # [s]


class Shortcut(Controller):
    """u = gain J⁺ e with the nominal Jacobian J and a damped pseudo-inverse."""

    def __init__(self, knowledge: RobotKnowledge) -> None:
        """Take the nominal model.

        Raises:
            ValueError: there is none.
        """
        if knowledge.nominal_model is None or knowledge.nominal_jacobian is None:
            raise ValueError("a shortcut needs the geometry of the robot")
        self.model = knowledge.nominal_model
        self.theta, self.cameras = self.model.start(())
        self.jacobian = knowledge.nominal_jacobian
        self.limit = knowledge.spec.joint_velocity_limit

    def command(self, q: FloatArray, e: FloatArray) -> Command:
        """Return the command for an error e, (m,), at joint positions q, (n,) [rad]."""
        J = self.jacobian(q)
        damped = J @ J.T + DAMPING**2 * np.eye(len(e))
        u = GAIN * (J.T @ np.linalg.solve(damped, e))
        return Command(np.clip(u, -self.limit, self.limit))

    def reset(self, observation: Observation, seed: int) -> None:
        """Begin at rest."""
        self.last = Command(np.zeros_like(observation.joint_position))


class OpenLoop(Shortcut):
    """e = y_ref − h(q) with the features h of the nominal robot: it sees encoders, no camera."""

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command towards where the nominal robot would have the reference."""
        q = observation.joint_position
        seen = self.model.feature(self.theta, self.cameras, q[None], np.zeros(1))[0]
        return self.command(q, reference[0] - seen)


class HeldCommand(Shortcut):
    """e = y_ref − y for the first second; then the last command is held."""

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command of the law, or the last one."""
        if observation.time < HELD_AFTER:
            e = reference[0] - observation.feature
            self.last = self.command(observation.joint_position, e)
        return self.last
