"""Samples on which the networks are trained: low-discrepancy points of joint positions and errors in a region."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2

from servobench.controllers.controller import JacobianFunction
from servobench.controllers.networks.config import Placement, TrainingConfig
from servobench.controllers.networks.rbf import information_vector
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import PlantSpec

WEAKEST = 0.1  # singular value of J over its largest below which a direction is left out of the inverse
CLUSTERING_POOL = 20  # samples a centre when centres come from k-means


def unit_points(count: int, dimension: int, rng: np.random.Generator, sequence: Placement = "halton") -> FloatArray:
    """Return scrambled low-discrepancy points of the unit cube, (count, dimension).

    Args:
        count: how many points.
        dimension: of the cube.
        rng: draws the scrambling.
        sequence: "sobol" or "halton"; "kmeans" clusters Halton points.
    """
    from scipy.stats import qmc  # noqa: PLC0415 - a third of a second, when networks are trained alone

    if sequence == "sobol":
        exponent = int(np.ceil(np.log2(max(count, 2))))
        return np.asarray(qmc.Sobol(dimension, seed=rng).random_base2(exponent)[:count])
    return np.asarray(qmc.Halton(dimension, seed=rng).random(count))


def choose_centres(pool: FloatArray, count: int, rng: np.random.Generator, placement: Placement) -> FloatArray:
    """Return `count` centres from a pool of low-discrepancy points (S, d): its first points, or its k-means.

    A prefix of a low-discrepancy sequence is one itself, so no distance has to be computed.
    """
    if placement != "kmeans":
        return pool[:count].copy()
    centres, _ = kmeans2(pool, count, minit="++", seed=rng, missing="warn")
    return np.asarray(centres, dtype=np.float64)


def pool_size(count: int, placement: Placement) -> int:
    """Return how many points `choose_centres` needs to place `count` centres."""
    return count * CLUSTERING_POOL if placement == "kmeans" else count


def joint_samples(unit: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return joint positions (..., n), rad, in the box from unit points (..., n)."""
    return np.asarray(lower + (upper - lower) * unit)


@dataclass(frozen=True, eq=False)
class ControllerSamples:
    """What the controller network is fitted to.

    Attributes:
        xi: ξ, (S, p), m and rad.
        error: e(k), (S, m), m.
        position: q(k−1), (S, n), rad.
        gain: K_p s J⁺ at q(k−1), (S, n, m), rad/m; without the directions in which the joints hardly move the feature.
        posture_step: K_n s (I − J⁺J)(q_c − q), (S, n), rad, towards the region's middle without moving y.
    """

    xi: FloatArray
    error: FloatArray
    position: FloatArray
    gain: FloatArray
    posture_step: FloatArray

    @property
    def command(self) -> FloatArray:
        """Joint position that the ideal controller commands, (S, n), rad."""
        return np.asarray(self.position + (self.gain @ self.error[..., None])[..., 0] + self.posture_step)


def controller_dimension(config: TrainingConfig, spec: PlantSpec) -> int:
    """Return how many coordinates of the unit cube one sample of the controller takes."""
    plan = config.controller
    return spec.n * max(plan.error_history, plan.position_history) + spec.m + 1


def controller_samples(
    unit: FloatArray, config: TrainingConfig, spec: PlantSpec, jacobian: JacobianFunction
) -> ControllerSamples:
    """Return samples of ξ that a servo with its target at rest could see, and the ideal controller's parts at them.

    The joint position is uniform in the box. The error has a uniform magnitude, so that small errors, where the arm
    comes to rest, are as well covered as large ones. Older entries of the histories follow from random joint steps Δq:
    q(k−2) = q(k−1) − Δq, e(k−1) = e(k) + J Δq.

    Args:
        unit: (S, controller_dimension), points of the unit cube.
        config: the region, the gains and from where the errors and histories come.
        spec: sizes and speed limit.
        jacobian: of the nominal model, vectorised.
    """
    plan, (lower, upper), (n, m) = config.controller, config.region(spec.n), (spec.n, spec.m)
    q = joint_samples(unit[:, :n], lower, upper)
    direction, magnitude = 2.0 * unit[:, n : n + m] - 1.0, unit[:, n + m : n + m + 1]
    error = plan.error_range * magnitude * direction
    steps = (2.0 * unit[:, n + m + 1 :].reshape(len(unit), -1, n) - 1.0) * (spec.joint_velocity_limit * plan.step)
    back = np.concatenate([np.zeros((len(unit), 1, n)), np.cumsum(steps, axis=1)], axis=1)
    J = jacobian(q)
    errors = error[:, None, :] + back[:, : plan.error_history] @ np.swapaxes(J, -1, -2)
    positions = q[:, None, :] - back[:, : plan.position_history]
    pinv = np.asarray(np.linalg.pinv(J, rcond=WEAKEST), dtype=np.float64)
    away = (lower + upper)[None, :] / 2.0 - q
    free = away - (pinv @ (J @ away[..., None]))[..., 0]
    posture_gain = plan.posture_gain if plan.fit == "output" else 0.0  # ψ has no entry for a constant
    proportional, posture = plan.gain * plan.step, posture_gain * plan.step
    return ControllerSamples(information_vector(errors, positions), error, q, proportional * pinv, posture * free)
