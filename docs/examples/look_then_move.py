r"""Look, then move, as a calibrated robot does without servoing: it moves where its calibration has the target.

    servobench sweep --controllers ./look_then_move.py:LookThenMove,regression_mfac --mismatch camera_rotation=1deg \
        --seeds 20 --out looked

What is wrong with the calibration is wrong with the place that it reaches.
"""

from dataclasses import dataclass

import numpy as np

import servobench


@dataclass(frozen=True)
class LookThenMoveConfig:
    """Settings: --set LookThenMove.gain=4."""

    gain: float = 3.0  # [1/s] from the distance of joints to their velocity
    damping: float = 1e-3  # [m/rad] of the inverse kinematics
    iterations: int = 60


class LookThenMove(servobench.Controller):
    """q* with h(q*) = y_ref for the features h of the nominal robot; then u = gain (q* − q), within the limits."""

    def __init__(self, config: LookThenMoveConfig, knowledge):
        if knowledge.nominal_model is None:
            raise ValueError("looking, then moving needs the geometry of the robot")
        self.config = config
        self.model = knowledge.nominal_model
        self.limit = knowledge.spec.joint_velocity_limit
        self.theta, self.cameras = self.model.start(())
        self.goal = None
        self.reached = None

    def reset(self, observation, seed):
        self.goal = None

    def joints_for(self, q, feature):
        """Return joint positions (n,) [rad] at which the nominal robot has a feature (m,), from q on."""
        for _ in range(self.config.iterations):
            found = self.model.derivatives(self.theta, self.cameras, q[None], np.zeros(1))
            J = found.by_joint[0]
            error = feature - found.feature[0]
            damped = J @ J.T + self.config.damping**2 * np.eye(len(error))
            step = J.T @ np.linalg.solve(damped, error)
            q = q + step * min(1.0, 0.3 / max(np.max(np.abs(step)), 1e-9))
        return q

    def step(self, observation, reference):
        q = observation.joint_position
        if self.goal is None or not np.array_equal(reference[0], self.goal):
            self.goal = reference[0].copy()
            self.reached = self.joints_for(q, self.goal)
        u = self.config.gain * (self.reached - q)
        return servobench.Command(u / max(1.0, np.max(np.abs(u) / self.limit)))

    def diagnostics(self):
        return {}
