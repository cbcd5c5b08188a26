"""Offline fits of both networks on the nominal model, which is given as a callable only.

Jacobian network: ridge least squares of W_i on J_i(q) = W_i θ_i(q), one fit for each joint column.

Controller network, one of two fits by ridge least squares on samples of ξ:

- "output" (default): ψ ξ ≈ q_cmd, linear in W with the features ξ ⊗ h(ξ);
- "entries" (the paper's reading): ψ ≈ [K_p s J⁺, 0, I, 0], linear in W with the features h(ξ). Its error in the
  identity block is multiplied by joint positions of some radians.

The paper's ideal law leaves the null space of J alone, so an arm with n > m wanders out of the region on which it was
trained. The output fit therefore imitates ψ ξ ≈ q + K_p s J⁺ e + K_n s (I − J⁺J)(q_c − q), which draws the posture
towards the region's middle q_c without moving the feature; K_n = 0 is the paper's law. J⁺ leaves out directions in
which the feature is weak, such as the depth of a narrow stereo pair; with `damping` δ it is Jᵀ(JJᵀ + δ²I)⁻¹ and holds
them, which is not the paper's.

Widths and regularisation are the best of a small grid on held-out samples. Nothing here is random beyond the
configuration's own seed.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np

from servobench.controllers.algebra import damped_inverse
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.networks import rbf
from servobench.controllers.networks.config import (
    ControllerTraining,
    TrainingConfig,
)
from servobench.controllers.networks.file import TrainedNetworks
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import JacobianFunction, PlantSpec

Progress = Callable[[float, str], None]
JACOBIAN_SHARE = 0.4  # [1] share of the Jacobian network in the work, for the progress bar
DIGEST_POINTS = 16  # number of joint positions at which nominal models are compared
# Models are rounded, so that the last bits of another machine do not require a new training.
DIGEST_DECIMALS = 9
# Directions whose singular value is below this share of the largest one of J are left out.
MIN_SINGULAR_SHARE = 0.1  # [1]


def unit_points(count: int, dimension: int, rng: np.random.Generator) -> FloatArray:
    """Return points of a Halton sequence in the unit cube, (count, dimension), that `rng` scrambles."""
    from scipy.stats import qmc  # noqa: PLC0415 - a third of a second, when networks are trained alone

    return qmc.Halton(dimension, seed=rng).random(count)


@dataclass(frozen=True, eq=False)
class ControllerSamples:
    """Samples to which the controller network is fitted."""

    xi: FloatArray  # ξ, (S, p), m and rad
    error: FloatArray  # e(k), (S, m), m
    position: FloatArray  # q(k−1), (S, n), rad
    gain: FloatArray  # K_p s J⁺ at q(k−1), (S, n, m), rad/m; little where joints hardly move the feature
    posture_step: FloatArray  # K_n s (I − J⁺J)(q_c − q), (S, n), rad, towards the region's middle without moving y
    command: FloatArray  # joint position that the ideal controller commands, (S, n), rad


def controller_dimension(config: TrainingConfig, spec: PlantSpec) -> int:
    """Return how many coordinates of the unit cube one sample of the controller takes."""
    plan = config.controller
    return spec.n * max(plan.error_history, plan.position_history) + spec.m + 1


def controller_samples(
    unit: FloatArray, config: TrainingConfig, spec: PlantSpec, jacobian: JacobianFunction
) -> ControllerSamples:
    """Return samples of ξ that a servo meets with its target at rest, and the ideal controller's parts at them.

    The joint position is uniform in the box. The error has a uniform magnitude, so that small errors, where the arm
    comes to rest, are as well covered as large ones. Older entries of the histories follow from random joint steps Δq:
    q(k−2) = q(k−1) − Δq, e(k−1) = e(k) + J Δq.

    Args:
        unit: (S, controller_dimension), points of the unit cube.
        config: the region, the gains and from where the errors and histories come.
        spec: sizes and speed limit.
        jacobian: of the nominal model, vectorised.
    """
    plan = config.controller
    lower, upper = config.region(spec.n)
    n = spec.n
    m = spec.m
    count = len(unit)
    q = lower + (upper - lower) * unit[:, :n]
    # Not of length 1: uniform in the cube
    direction = 2.0 * unit[:, n : n + m] - 1.0
    magnitude = unit[:, n + m : n + m + 1]
    error = plan.error_range * magnitude * direction

    # `back` is the way from each older joint position of the histories to q(k−1).
    signed_shares = 2.0 * unit[:, n + m + 1 :].reshape(count, -1, n) - 1.0
    steps = signed_shares * (spec.joint_velocity_limit * plan.step)
    back = np.concatenate([np.zeros((count, 1, n)), np.cumsum(steps, axis=1)], axis=1)
    J = jacobian(q)
    errors = error[:, None, :] + back[:, : plan.error_history] @ J.mT
    positions = q[:, None, :] - back[:, : plan.position_history]

    pinv = damped_inverse(J, plan.damping)
    if plan.damping == 0.0:
        pinv = np.asarray(np.linalg.pinv(J, rcond=MIN_SINGULAR_SHARE), dtype=np.float64)
    to_middle = (lower + upper)[None, :] / 2.0 - q
    free = to_middle - (pinv @ (J @ to_middle[..., None]))[..., 0]
    # The matrix ψ of the fit of its entries has none for a constant, which the posture would need.
    posture_gain = plan.posture_gain if plan.fit == "output" else 0.0
    gain = plan.gain * plan.step * pinv
    posture_step = posture_gain * plan.step * free
    return ControllerSamples(
        xi=rbf.information_vector(errors, positions),
        error=error,
        position=q,
        gain=gain,
        posture_step=posture_step,
        command=q + (gain @ error[..., None])[..., 0] + posture_step,
    )


def train(
    config: TrainingConfig,
    nominal_jacobian: JacobianFunction,
    spec: PlantSpec,
    progress: Progress | None = None,
) -> TrainedNetworks:
    """Fit both networks on the nominal model.

    Args:
        config: region, sizes, grids and seed.
        nominal_jacobian: (S, n) rad -> (S, m, n).
        spec: sizes and speed limit.
        progress: called with the share that is done and the name of the present task.

    Returns:
        The networks with their held-out errors.

    Raises:
        ValueError: the region does not fit the plant, or the nominal Jacobian has another shape or is not finite.
    """
    digest = training_digest(config, nominal_jacobian, spec)
    report = progress or (lambda share, task: None)
    jacobian, jacobian_error = _train_jacobian(config, nominal_jacobian, spec, report)
    controller, controller_error = _train_controller(config, nominal_jacobian, spec, report)
    report(1.0, "done")
    return TrainedNetworks(jacobian, controller, jacobian_error, controller_error, digest)


def obtain_networks(config: TrainingConfig, knowledge: RobotKnowledge) -> TrainedNetworks:
    """Return networks for a robot: those of `knowledge.train`, or without it newly trained ones.

    Args:
        config: a region that is left empty is the robot's working region.
        knowledge: of the robot.

    Raises:
        ValueError: no region is known, no nominal model exists, networks of another robot came, or as `train`.
    """
    if not config.lower:
        if knowledge.region is None:
            raise ValueError(
                "training needs a region and a model of the robot: give lower and upper, one number a joint, rad, and "
                "a nominal model, such as nominal in an FMU's mapping"
            )
        lower, upper = knowledge.region
        config = replace(config, lower=tuple(lower.tolist()), upper=tuple(upper.tolist()))
    spec = knowledge.spec
    if knowledge.train is not None:
        networks: TrainedNetworks = knowledge.train(config)
    elif knowledge.nominal_jacobian is not None:
        networks = train(config, knowledge.nominal_jacobian, spec)
    else:
        raise ValueError(
            "training needs a nominal model, and this plant has none; an FMU gets one by nominal in its mapping"
        )
    jacobian = networks.jacobian
    if (jacobian.n, jacobian.m) != (spec.n, spec.m):
        raise ValueError(
            f"network must be of {spec.n} joints and {spec.m} features, got {jacobian.n} and {jacobian.m}"
        )
    return networks


def training_digest(
    config: TrainingConfig, nominal_jacobian: JacobianFunction, spec: PlantSpec
) -> str:
    """Return a hash of all that the networks depend on: configuration, sizes, speed limit and model.

    Raises:
        ValueError: as `train`.
    """
    lower, upper = config.region(spec.n)
    unit = np.random.default_rng(0).random((DIGEST_POINTS, spec.n))
    J = _checked(nominal_jacobian, lower + (upper - lower) * unit, spec)
    # Adding 0 makes −0 into 0.
    rounded = np.round(J, DIGEST_DECIMALS) + 0.0
    content = {
        "config": asdict(config),
        "sizes": [spec.n, spec.m],
        "joint_velocity_limit": spec.joint_velocity_limit.tolist(),
        "model": rounded.ravel().tolist(),
    }
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _train_jacobian(
    config: TrainingConfig, nominal_jacobian: JacobianFunction, spec: PlantSpec, report: Progress
) -> tuple[rbf.JacobianNetwork, float]:
    """Return the Jacobian network and its held-out error, the RMS of ‖Ĵ − J‖ over that of ‖J‖."""
    plan = config.jacobian
    lower, upper = config.region(spec.n)
    rng = np.random.default_rng([config.seed, 1])
    unit = unit_points(plan.samples, spec.n, rng)
    centres = lower + (upper - lower) * unit_points(plan.centres, spec.n, rng)
    q = lower + (upper - lower) * unit
    J = _checked(nominal_jacobian, q, spec)
    held = max(1, round(plan.samples * config.held_out))
    spread = float(np.linalg.norm(upper - lower)) / 2.0
    fitted = J[held:].reshape(len(q) - held, -1)
    # Each joint column takes the width and the regularisation of its own least held-out error.
    squares: FloatArray = np.full(spec.n, np.inf)
    widths = np.ones((spec.n, plan.centres))
    weights = np.zeros((spec.n, spec.m, plan.centres))
    for index, scale in enumerate(plan.width_scales):
        report(JACOBIAN_SHARE * index / len(plan.width_scales), "Jacobian network")
        width = scale * spread
        theta = rbf.hidden_features(q, centres, np.full(plan.centres, width), "gaussian")
        for W in ridge_path(theta[held:], fitted, plan.regularisations):
            residual = (theta[:held] @ W).reshape(held, spec.m, spec.n) - J[:held]
            square = np.einsum("smn,smn->n", residual, residual)
            columns = W.reshape(plan.centres, spec.m, spec.n)
            for i in np.flatnonzero(square < squares):
                squares[i] = square[i]
                widths[i] = width
                weights[i] = columns[:, :, i].T
    shared = np.broadcast_to(centres, (spec.n, *centres.shape))
    network = rbf.JacobianNetwork(shared, widths, weights)
    total = np.einsum("smn,smn->", J[:held], J[:held])
    return network, float(np.sqrt(squares.sum() / total))


def _train_controller(
    config: TrainingConfig, nominal_jacobian: JacobianFunction, spec: PlantSpec, report: Progress
) -> tuple[rbf.ControllerNetwork, float]:
    """Return the controller network and its held-out error, the RMS over joints of ψ ξ − q_cmd, rad."""
    plan = config.controller
    dimension = controller_dimension(config, spec)
    rng = np.random.default_rng([config.seed, 2])
    unit = unit_points(plan.samples, dimension, rng)
    samples = controller_samples(unit, config, spec, nominal_jacobian)
    at_centres = unit_points(plan.hidden, dimension, rng)
    centres = controller_samples(at_centres, config, spec, nominal_jacobian).xi
    wanted = samples.command
    held = max(1, round(plan.samples * config.held_out))
    offsets = centres - centres.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(offsets**2, axis=-1))))
    best = np.inf
    network = None
    for index, scale in enumerate(plan.width_scales):
        done = (1.0 - JACOBIAN_SHARE) * index / len(plan.width_scales)
        report(JACOBIAN_SHARE + done, "controller network")
        reach = scale * spread  # the distance at which a unit has fallen to 1/e
        width = reach if plan.kernel == "gaussian" else np.sqrt(reach)
        widths = np.full(plan.hidden, width)
        h = rbf.hidden_features(samples.xi, centres, widths, plan.kernel)
        for weights in _controller_weights(plan, samples, wanted, h, held):
            candidate = rbf.ControllerNetwork(
                centres,
                widths,
                weights,
                plan.error_history,
                plan.position_history,
                plan.kernel,
                plan.step,
            )
            misses = candidate.command(samples.xi[:held]) - wanted[:held]
            error = float(np.sqrt(np.mean(misses**2)))
            if error < best:
                best = error
                network = candidate
    if network is None:
        raise ValueError(
            "the controller network could not be fitted: every held-out error is not finite"
        )
    return network, best


def _controller_weights(
    plan: ControllerTraining,
    samples: ControllerSamples,
    wanted: FloatArray,
    h: FloatArray,
    held: int,
) -> Iterator[FloatArray]:
    """Yield the weights W, (n, p, N_h), of each regularisation."""
    count, p = samples.xi.shape
    n = wanted.shape[1]
    if plan.fit == "output":
        features = (samples.xi[:, :, None] * h[:, None, :]).reshape(count, -1)
        for W in ridge_path(features[held:], wanted[held:], plan.regularisations):
            yield W.T.reshape(n, p, plan.hidden)
        return
    entries = ideal_controller_matrix(samples.gain, plan.error_history, plan.position_history)
    for W in ridge_path(h[held:], entries[held:].reshape(count - held, -1), plan.regularisations):
        yield np.moveaxis(W.reshape(plan.hidden, n, p), 0, -1)


def ideal_controller_matrix(
    gain: FloatArray, error_history: int, position_history: int
) -> FloatArray:
    """Return ψ* = [K_p s J⁺, 0, I, 0] (eq. 10), (S, n, m L_e + n L_c), from K_p s J⁺ (S, n, m)."""
    count, n, m = gain.shape
    psi = np.zeros((count, n, m * error_history + n * position_history))
    psi[:, :, :m] = gain
    psi[:, :, m * error_history : m * error_history + n] = np.eye(n)
    return psi


def ridge_path(
    features: FloatArray, targets: FloatArray, regularisations: tuple[float, ...]
) -> Iterator[FloatArray]:
    """Yield the ridge solutions W = (FᵀF + λ μ I)⁻¹ Fᵀ Y for each λ, with μ the largest eigenvalue of FᵀF.

    Args:
        features: F, (S, d).
        targets: Y, (S, t).
        regularisations: λ, relative to μ.
    """
    eigenvalues, V = np.linalg.eigh(features.T @ features)
    projected = V.T @ (features.T @ targets)
    largest = eigenvalues[-1]
    for relative in regularisations:
        denominators = np.maximum(eigenvalues, 0.0) + relative * largest
        yield V @ (projected / denominators[:, None])


def _checked(nominal_jacobian: JacobianFunction, q: FloatArray, spec: PlantSpec) -> FloatArray:
    """Return the nominal Jacobians, (S, m, n), at q, (S, n), rad, after a check of shape and values."""
    J = np.asarray(nominal_jacobian(q), dtype=np.float64)
    wanted = (len(q), spec.m, spec.n)
    if J.shape != wanted:
        raise ValueError(f"nominal_jacobian must return {wanted} for {q.shape}, got {J.shape}")
    if not np.isfinite(J).all():
        raise ValueError("nominal_jacobian must be finite in the whole training region")
    return J
