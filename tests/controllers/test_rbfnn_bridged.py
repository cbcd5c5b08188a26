"""Tests of the bridged law: a step by hand, its promises on an arm of constant Jacobian, and what it refuses."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.toy import KNOWLEDGE, LIMIT, PERIOD, PREVIEW, A, Commanding, M, N, ToyArm, networks, plant_spec, seen
from servobench.controllers.estimate import MAX_DELAY, Estimate
from servobench.controllers.estimators.rbf_aligned import RbfAlignedConfig, RbfAlignedEstimator
from servobench.controllers.initial import InitialConfig, initial_jacobian
from servobench.controllers.laws.learned_correction import LearnedCorrection
from servobench.controllers.laws.rbfnn_bridged import RbfnnBridgedConfig, RbfnnBridgedLaw
from servobench.controllers.laws.roll_out import RollOut, descent_direction, update_step
from servobench.controllers.networks.rbf import ControllerNetwork
from servobench.controllers.servo import Servo, ServoController
from servobench.controllers.stages.inverses import damped_inverse

TURN = Rotation.from_rotvec(np.radians(100.0) * np.array([0.0, 0.6, 0.8])).as_matrix()


def law(first=None, **config):
    made = RbfnnBridgedLaw(RbfnnBridgedConfig(**config), KNOWLEDGE, networks())
    return Commanding(made, seen(np.zeros(N), np.zeros(M)) if first is None else first)


def still(target):
    return np.repeat(np.asarray(target)[None], 1 + PREVIEW, axis=0)


def test_the_first_step_by_hand():
    """dq = γ J⁺ e + J⁺ r + κ (I − J⁺J)(q_c − q): nothing is in flight, nothing learned with k = 0; q_c = 0."""
    q, e, r = np.full(N, 0.1), np.array([0.01, -0.02, 0.005]), np.array([0.001, 0.0, 0.002])
    reference = still(e) + np.arange(1 + PREVIEW)[:, None] * r
    pinv = np.linalg.pinv(A)
    posture = (1.0 - np.exp(-0.2 * PERIOD)) * (np.eye(N) - pinv @ A) @ (np.zeros(N) - q)
    expected = (1.0 - np.exp(-14.0 * PERIOD)) * pinv @ e + pinv @ r + posture
    first = seen(q, np.zeros(M))
    u = law(first, k=0.0, damping=1e-9).command(Estimate(A), first, reference)
    np.testing.assert_allclose(u, expected / PERIOD, atol=1e-7)


def test_a_delay_beyond_what_is_kept_of_the_past_is_refused():
    made = law()
    look = seen(np.zeros(N), np.zeros(M)), still(np.zeros(M))
    made.command(Estimate(A, delay=MAX_DELAY), *look)
    with pytest.raises(ValueError, match="delay must be from 0 to 14 periods, got 15"):
        made.command(Estimate(A, delay=MAX_DELAY + 1), *look)


def test_without_redistribution_a_command_that_exceeds_the_limit_is_scaled_as_a_whole():
    e = np.array([0.5, 0.4, -0.5])
    plain, shared = (
        law(k=0.0, redistribute=on).command(Estimate(A), seen(np.zeros(N), np.zeros(M)), still(e))
        for on in (False, True)
    )
    wanted = damped_inverse(A, 0.02) @ e
    np.testing.assert_allclose(plain, LIMIT * wanted / np.abs(wanted).max())
    assert np.linalg.norm(A @ shared) > 1.01 * np.linalg.norm(A @ plain)


def gains(**changes):
    settings = {"k": 0.3, "epsilon": 0.0, "leak": 0.0, "error_share": 0.4, "posture_share": 0.0}
    return {**settings, "damping": 1e-9, **changes}


class Correcting:
    """A learned correction with its state."""

    def __init__(self, **changes):
        self.law = LearnedCorrection(networks().controller, np.zeros(N), np.full(N, 10.0), **gains(**changes))
        self.state = self.law.start(seen(np.zeros(N), np.zeros(M)))

    def step(self, *arguments, learn):
        self.state, dq = self.law.step(self.state, *arguments, learn)
        return dq

    def diagnostics(self):
        return self.law.diagnostics(self.state)

    @property
    def weights(self):
        return self.law.weights(self.state)

    def learned_before(self, rng, scale):
        """Take weights as if they had been learned at another Jacobian, and return them."""
        J, C, update = rng.normal(size=(M, N)), rng.normal(size=self.state.C.shape), rng.normal(size=M)
        self.state = self.state._replace(jacobian=J, C=scale * C, update=scale * update)
        return self.weights


def test_one_update_lowers_the_predicted_error_by_1_minus_k_along_itself():
    """The paper's oracle (T = 1, ε = 0, no limit) holds with Ĵ⁺ in the place of the offline network."""
    made, e, q = Correcting(), np.array([0.2, -0.1, 0.3]), np.full(N, 0.2)
    dq = made.step(A, e, q, np.zeros(M), learn=True)
    predicted = 0.6 * e  # by the law without what is learned
    assert made.diagnostics()["predicted_error"] == pytest.approx(np.linalg.norm(predicted), rel=1e-9)
    assert (e - A @ dq) @ predicted == pytest.approx((1.0 - 0.3) * predicted @ predicted, rel=1e-9)


def test_the_update_is_that_of_the_paper_with_a_horizon_of_one():
    """Eqs. 18, 19 and 23 by the functions of `rbfnn`, for the loop with all three terms."""
    made, rng = Correcting(epsilon=1e-3), np.random.default_rng(1)
    before = made.learned_before(rng, 0.1)
    e, q = np.array([0.2, -0.1, 0.3]), rng.normal(scale=0.3, size=N)
    dq = made.step(A, e, q, np.zeros(M), learn=True)
    projected = np.einsum("ij,jpl->ipl", np.linalg.pinv(A) @ A, before)
    xi = np.concatenate([e, q])
    h = networks().controller.features(xi)
    first = 0.4 * np.linalg.pinv(A) @ e + np.einsum("npl,l,p->n", projected, h, xi)
    ahead = RollOut((e - A @ first)[None], xi[None], h[None], first)
    direction = descent_direction(A, ahead)
    wanted = projected + update_step(direction, ahead, 0.3, 1e-3) * direction
    np.testing.assert_allclose(made.weights, wanted, atol=1e-9)
    learned = np.einsum("npl,l,p->n", wanted, h, xi)
    np.testing.assert_allclose(dq, 0.4 * np.linalg.pinv(A) @ e + learned, atol=1e-9)


def test_what_was_learned_leaks_and_stays_out_of_the_null_space():
    made = Correcting(leak=0.5, k=1e-12)
    rng = np.random.default_rng(0)
    before = made.learned_before(rng, 1.0)
    made.step(A, np.zeros(M), np.zeros(N), np.zeros(M), learn=False)
    np.testing.assert_allclose(
        np.einsum("mn,npl->mpl", A, made.weights), 0.5 * np.einsum("mn,npl->mpl", A, before), atol=1e-7
    )
    null = np.eye(N) - np.linalg.pinv(A) @ A
    np.testing.assert_allclose(np.einsum("ij,jpl->ipl", null, made.weights), 0.0, atol=1e-7)


def test_nothing_is_learned_from_an_invalid_feature_or_at_the_limit():
    made = Correcting()
    made.step(A, np.full(M, 0.1), np.zeros(N), np.zeros(M), learn=False)
    assert not made.weights.any()
    made.step(A, np.full(M, 100.0), np.zeros(N), np.zeros(M), learn=True)
    assert not made.weights.any()
    made.step(A, np.full(M, 0.1), np.zeros(N), np.zeros(M), learn=True)
    assert made.weights.any()


def test_what_is_learned_stays_within_the_bound_of_the_leak():
    """‖W‖ ≤ k E_max / (2 l √ε), whatever the errors and Jacobians are."""
    made, rng, largest = Correcting(epsilon=1e-3, leak=0.02, k=0.5), np.random.default_rng(8), 0.0
    for _ in range(300):
        J = rng.normal(size=(M, N))
        made.step(J, rng.normal(scale=0.3, size=M), rng.normal(size=N), np.zeros(M), learn=True)
        largest = max(largest, 2.0 * made.diagnostics()["criterion"])
        assert np.linalg.norm(made.weights) <= 0.5 * largest / (2.0 * 0.02 * np.sqrt(1e-3))
    assert made.weights.any()


def controller(estimator=None, **config):
    parts = networks()
    made = RbfnnBridgedLaw(RbfnnBridgedConfig(**config), KNOWLEDGE, parts)
    aligned = RbfAlignedEstimator(RbfAlignedConfig() if estimator is None else estimator, KNOWLEDGE, parts)
    return ServoController(Servo(aligned, made, initial_jacobian(InitialConfig(), KNOWLEDGE), KNOWLEDGE))


def closed_loop(servo, arm, target, steps):
    """Run and yield, after each command, the estimated Jacobian and the error of what the arm is bound for."""
    observation = arm.observe()
    servo.reset(observation, 0)
    for _ in range(steps):
        before = target - arm.end()
        u = servo.step(observation, still(target)).joint_velocity
        observation = arm.step(u)
        yield servo.estimated_jacobian(), before, u * PERIOD, target - arm.end()


def test_the_error_of_what_the_arm_is_bound_for_contracts_as_promised():
    """‖e⁺‖ ≤ (1 − f γ (1 − δ)) ‖e‖, δ = ‖I − J Ĵ⁺‖: once response and delay are known, along a run of a turned camera.

    f is the share of the wanted feature step that the limits let through.
    """
    gamma, arm, target = (
        1.0 - np.exp(-14.0 * PERIOD),
        ToyArm(TURN, (0.0, 0.6, 0.4), latency=2),
        np.array([0.9, 0.5, 0.2]),
    )
    servo = controller(k=0.0, posture_gain=0.0, damping=1e-6, observe=False)
    checked, limited = 0, 0
    for k, (J, e, dq, after) in enumerate(closed_loop(servo, arm, target, 60)):
        if k < 12 or np.linalg.norm(e) < 1e-6:
            continue
        assert servo.servo.estimator.estimate(servo.state.estimator, arm.q).delay == 2
        delta = np.linalg.norm(np.eye(M) - TURN @ A @ damped_inverse(J, 1e-6), 2)
        f = min(1.0, float(np.linalg.norm(J @ dq) / (gamma * np.linalg.norm(e))))
        limited += f < 0.99
        bound = (1.0 - f * gamma * (1.0 - delta)) * np.linalg.norm(e)
        assert delta < 1.0
        assert np.linalg.norm(after) <= bound + 2e-4
        checked += 1
    assert checked > 15
    assert limited > 3
    assert np.linalg.norm(after) < 1e-3


@pytest.mark.parametrize("latency", [2, 5])
def test_a_turned_camera_that_is_late_is_no_obstacle_and_without_the_bridge_it_is(latency):
    target = np.array([0.3, -0.2, 0.25])

    def last(**config):
        arm = ToyArm(TURN, (0.0, 0.6, 0.4), latency)
        errors = [np.linalg.norm(after) for *_, after in closed_loop(controller(**config), arm, target, 100)]
        return max(errors[60:])

    assert last() < 0.003
    assert last(bridge=False) > 0.005


def following_error(**config):
    """The largest error on a circle that moves by 7.5 mm a period, once it is followed, m."""
    arm, servo = ToyArm(np.eye(M), (0.0, 0.6, 0.4), latency=1), controller(**config)
    observation, errors = arm.observe(), []
    servo.reset(observation, 0)

    def desired(k):
        return 0.15 * np.array([np.sin(0.05 * k), 1.0 - np.cos(0.05 * k), 0.0])

    for k in range(200):
        reference = np.array([desired(k + ahead) for ahead in range(1 + PREVIEW)])
        observation = arm.step(servo.step(observation, reference).joint_velocity)
        errors.append(np.linalg.norm(desired(k + 1) - A @ arm.q))
    return max(errors[100:])


def test_a_moving_reference_is_followed_with_a_tenth_of_a_period_of_lag():
    assert following_error() < 0.1 * 0.0075
    assert following_error(bridge=False) > 0.0075
    assert following_error(feedforward=False, k=0.0) > 0.0075


def test_the_law_of_the_paper_runs_in_the_frame_of_its_model():
    """base 'network': turning the camera changes nothing in the joint steps once the Jacobian is known."""
    e, q = np.array([0.02, -0.01, 0.03]), np.full(N, 0.1)
    first = seen(q, np.zeros(M))
    steps = [
        law(first, base="network", horizon=8, frame=frame).command(Estimate(turn @ A), first, still(turn @ e))
        for turn, frame in ((np.eye(M), True), (TURN, True), (TURN, False))
    ]
    np.testing.assert_allclose(steps[1], steps[0], atol=1e-9)
    assert np.linalg.norm(steps[2] - steps[0]) > 0.01


def test_what_does_not_fit_together_is_refused():
    with pytest.raises(ValueError, match="preview must be at least 1 for feedforward, got 0"):
        RbfnnBridgedLaw(RbfnnBridgedConfig(), dataclasses.replace(KNOWLEDGE, preview=0), networks())
    with pytest.raises(ValueError, match="network must be of 2 joints and 3 features, got 5 and 3"):
        RbfnnBridgedLaw(RbfnnBridgedConfig(), dataclasses.replace(KNOWLEDGE, spec=plant_spec(2, 3)), networks())
    rng = np.random.default_rng(0)
    longer = ControllerNetwork(rng.normal(size=(4, 2 * M + N)), np.ones(4), rng.normal(size=(N, 2 * M + N, 4)), 2, 1)
    with pytest.raises(
        ValueError, match="error_history and position_history must be 1 for base 'jacobian', got 2 and 1"
    ):
        LearnedCorrection(longer, np.zeros(N), np.ones(N), **gains())
