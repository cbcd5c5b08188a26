"""Promises of the best equipped chain on an arm of constant Jacobian, behind a turned and late camera."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.toy import KNOWLEDGE, PERIOD, PREVIEW, A, M, ToyArm
from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.algebra import damped_inverse
from servobench.controllers.methods import METHODS

TURN = Rotation.from_rotvec(np.radians(100.0) * np.array([0.0, 0.6, 0.8])).as_matrix()
RESPONSE, GAIN, WEIGHT = (0.0, 0.6, 0.4), 14.0, 1e-9


def chain(**aids):
    """Return `regression_mfac` with a gain of 14/s and undamped inverses."""
    config = METHODS["regression_mfac"].config()
    law = dataclasses.replace(config.law, gain=GAIN, step_weight=WEIGHT)
    aids = AidsConfig(**{**EQUIPPED, "damping": 1e-4, **aids})
    return METHODS["regression_mfac"].build(dataclasses.replace(config, law=law, aids=aids), KNOWLEDGE)


def still(target):
    return np.repeat(np.asarray(target)[None], 1 + PREVIEW, axis=0)


def closed_loop(servo, arm, target, steps):
    """Run and yield, around each command, the estimated Jacobian, the step and the error of what is to come."""
    observation = arm.observe()
    servo.reset(observation, 0)
    for _ in range(steps):
        before = target - arm.end()
        u = servo.step(observation, still(target)).joint_velocity
        observation = arm.step(u)
        yield servo.estimated_jacobian(), before, u * PERIOD, target - arm.end()


def test_the_error_of_what_the_arm_is_bound_for_contracts_as_promised():
    """‖e⁺‖ ≤ (1 − f γ (1 − δ)) ‖e‖, δ = ‖I − J Ĵ⁺‖, once response and delay are known.

    f is the share of the wanted feature step that the limits let through, γ = 1 − exp(−K dt).
    """
    gamma, arm, target = 1.0 - np.exp(-GAIN * PERIOD), ToyArm(TURN, RESPONSE, latency=2), np.array([0.9, 0.5, 0.2])
    servo, checked, limited = chain(posture=False, filter=False), 0, 0
    for k, (J, e, dq, after) in enumerate(closed_loop(servo, arm, target, 60)):
        if k < 12 or np.linalg.norm(e) < 1e-6:
            continue
        assert servo.diagnostics()["delay"] == pytest.approx(2 * PERIOD)
        delta = np.linalg.norm(np.eye(M) - TURN @ A @ damped_inverse(J, 1e-6), 2)
        f = min(1.0, float(np.linalg.norm(J @ dq) / (gamma * np.linalg.norm(e))))
        limited += f < 0.99
        assert delta < 1.0
        assert np.linalg.norm(after) <= (1.0 - f * gamma * (1.0 - delta)) * np.linalg.norm(e) + 2e-4
        checked += 1
    assert checked > 15
    assert limited > 3
    assert np.linalg.norm(after) < 1e-3


def following_error(**aids):
    """The largest error on a circle that moves by 7.5 mm a period, once it is followed, m."""
    arm, servo = ToyArm(np.eye(M), RESPONSE, latency=1), chain(**aids)
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
    assert following_error(response="ignored") > 0.1 * 0.0075
    assert following_error(delay="ignored", response="ignored", filter=False) > 0.0075
    assert following_error(feedforward=False) > 0.0075
