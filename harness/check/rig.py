"""A made-up arm of any size on which controllers are checked: y = A (q + 0.02 q³), and what may be known about it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from servobench.controllers.controller import Delays, RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Observation, PlantSpec

PERIOD: Final = 0.05  # [s]
PREVIEW: Final = 10  # [rows]
BEND: Final = 0.02  # [1/rad²]
MODEL_ERROR: Final = 1.05  # nominal over true Jacobian
NOISE: Final = 1e-3  # [m] of the feature
SMALL_TRAINING: Final = {"samples": 40, "width_scales": (1.0,), "regularisations": (1e-6,)}


class Rig:
    """An arm of n joints whose camera sees m features; the same numbers for the same sizes."""

    def __init__(self, n: int, m: int, seed: int = 0) -> None:
        """Make the arm.

        Args:
            n: number of joints.
            m: number of features.
            seed: of the arm's numbers.
        """
        rng = np.random.default_rng([n, m, seed])
        left, _, right = np.linalg.svd(rng.normal(size=(m, n)), full_matrices=False)
        self.A = left * np.linspace(0.4, 0.8, min(n, m)) @ right  # [m/rad], well conditioned
        self.start, self.goal = rng.uniform(-0.5, 0.5, (2, n))
        joints, features = (tuple(f"{letter}{i}" for i in range(size)) for letter, size in (("q", n), ("y", m)))
        self.spec = PlantSpec.of_joints(joints, features, np.full(n, 1.0), np.full(n, -6.0), np.full(n, 6.0), PERIOD)

    def feature(self, q: FloatArray) -> FloatArray:
        """Return the true feature (..., m) [m] at joint positions (..., n) [rad]."""
        return np.asarray(np.matvec(self.A, q + BEND * q**3))

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Return the true Jacobian (..., m, n) [m/rad] at joint positions (..., n) [rad]."""
        return np.asarray(self.A * (1.0 + 3.0 * BEND * q**2)[..., None, :])

    def nominal_jacobian(self, q: FloatArray) -> FloatArray:
        """Return the Jacobian of the nominal model, as `jacobian`."""
        return MODEL_ERROR * self.jacobian(q)

    def knowledge(self, *, truth: bool = False, preview: int = PREVIEW) -> RobotKnowledge:
        """Return what a controller may know; with `truth` also what only an upper bound may."""
        n = self.spec.n
        known = RobotKnowledge(
            self.spec, preview, self.nominal_jacobian, region=(np.full(n, -1.0), np.full(n, 1.0)), train=self._train
        )
        if not truth:
            return known
        return replace(
            known, true_jacobian=self.jacobian, true_symbolic=self._symbolic, true_delays=Delays(0.0, 0.0, 0.0)
        )

    def seen(self, q: FloatArray, k: int, rng: np.random.Generator, *, valid: bool = True) -> Observation:
        """Return what is observed in period k at joint positions q (n,) [rad]."""
        noisy = self.feature(q) + rng.normal(scale=NOISE, size=self.spec.m)
        return Observation(k * PERIOD, q, noisy, valid)

    def move(self, q: FloatArray, joint_velocity: FloatArray) -> FloatArray:
        """Return the joint positions a period later, (n,) [rad]."""
        limit = self.spec.joint_velocity_limit
        moved = q + np.clip(joint_velocity, -limit, limit) * PERIOD
        return np.asarray(np.clip(moved, self.spec.joint_lower, self.spec.joint_upper))

    def reference(self, preview: int = PREVIEW) -> FloatArray:
        """Return the reference (1 + preview, m) [m] of a target at rest; it cannot be written."""
        rows = np.tile(self.feature(self.goal), (1 + preview, 1))
        rows.flags.writeable = False
        return rows

    def _train(self, config: TrainingConfig) -> TrainedNetworks:
        from servobench.controllers.networks.config import ControllerTraining, JacobianTraining  # noqa: PLC0415
        from servobench.controllers.networks.fit import train  # noqa: PLC0415 - scipy is slow to import

        parts: dict[str, Any] = {
            "jacobian": JacobianTraining(centres=6, **SMALL_TRAINING),  # type: ignore[arg-type]
            "controller": ControllerTraining(hidden=6, **SMALL_TRAINING),  # type: ignore[arg-type]
        }
        return train(replace(config, **parts), self.nominal_jacobian, self.spec)

    def _symbolic(self, q: Any) -> Any:  # noqa: ANN401 - expressions of CasADi
        return type(q)(self.A) @ (q + BEND * q * q * q)
