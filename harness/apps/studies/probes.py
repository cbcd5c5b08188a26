"""Shortcuts: controllers without what a challenge is about; one that solves it shows that the challenge tells nothing.

With `constant`, the pseudo-inverse of the unchanged first Jacobian, these are the probes of an audit.
"""

from __future__ import annotations

import numpy as np

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation

GAIN = 3.0  # [1/s]
DAMPING = 0.02  # [m/rad] of the pseudo-inverse
ITERATIONS = 20  # inverse kinematics in a period
STEP = 0.3  # [rad] a joint moves at most in an iteration
HELD_AFTER = 1.0  # [s]


def damped_steps(J: FloatArray, e: FloatArray) -> FloatArray:
    """Return Jᵀ (J Jᵀ + δ²I)⁻¹ e."""
    return np.asarray(J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(len(e)), e))


class OpenLoop(Controller):
    """q* with h(q*) = y_ref for the features h of the nominal robot; u = gain (q* − q). It sees encoders, no camera."""

    def __init__(self, knowledge: RobotKnowledge) -> None:
        """Take the nominal model.

        Raises:
            ValueError: there is none.
        """
        if knowledge.nominal_model is None:
            raise ValueError("an open loop needs the geometry of the robot")
        self.model = knowledge.nominal_model
        self.limit = knowledge.spec.joint_velocity_limit
        self.theta, self.cameras = self.model.start(())

    def reset(self, observation: Observation, seed: int) -> None:
        """Begin at the joints of the start."""
        self.goal = observation.joint_position

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command to where the nominal robot would have the reference."""
        for _ in range(ITERATIONS):
            found = self.model.derivatives(self.theta, self.cameras, self.goal[None], np.zeros(1))
            step = damped_steps(found.by_joint[0], reference[0] - found.feature[0])
            self.goal = self.goal + np.clip(step, -STEP, STEP)
        u = GAIN * (self.goal - observation.joint_position)
        return Command(np.clip(u, -self.limit, self.limit))


class HeldCommand(Controller):
    """u = gain J⁺ e with the nominal Jacobian for the first second; then the last command is held."""

    def __init__(self, knowledge: RobotKnowledge) -> None:
        """Take the nominal Jacobian.

        Raises:
            ValueError: there is none.
        """
        if knowledge.nominal_jacobian is None:
            raise ValueError("a first command needs the nominal Jacobian")
        self.jacobian = knowledge.nominal_jacobian
        self.limit = knowledge.spec.joint_velocity_limit

    def reset(self, observation: Observation, seed: int) -> None:
        """Begin at rest."""
        self.command = Command(np.zeros_like(observation.joint_position))

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command of the law, or the last one."""
        if observation.time < HELD_AFTER:
            e = reference[0] - observation.feature
            u = GAIN * damped_steps(self.jacobian(observation.joint_position), e)
            self.command = Command(np.clip(u, -self.limit, self.limit))
        return self.command
