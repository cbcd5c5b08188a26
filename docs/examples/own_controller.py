"""Compare a controller of one's own with two that are there, on three robots that differ from their nominal model."""

import numpy as np

import servobench


class ResolvedRate(servobench.Controller):
    """u = 1.5 Jᵀ (J Jᵀ + δ²I)⁻¹ e with the Jacobian J of the nominal model; e is the error, δ = 0.02 m/rad."""

    def __init__(self, knowledge):
        self.jacobian = knowledge.nominal_jacobian
        self.limit = knowledge.spec.joint_velocity_limit

    def reset(self, observation, seed):
        """Nothing is remembered between periods."""

    def step(self, observation, reference):
        e = reference[0] - observation.feature
        J = self.jacobian(observation.joint_position)
        u = 1.5 * J.T @ np.linalg.solve(J @ J.T + 0.02**2 * np.eye(len(e)), e)
        return servobench.Command(u / max(1.0, np.max(np.abs(u) / self.limit)))

    def diagnostics(self):
        return {}


if __name__ == "__main__":
    runs = servobench.compare([ResolvedRate, "ukf_mfac", "constant"], tasks=["exp2"], seeds=3)
    # Else medians leave out runs that never settled.
    runs["settling_time_s"] = runs["settling_time_s"].fillna(float("inf"))
    print(runs.groupby("controller")[["settling_time_s", "rms_error"]].median())
