"""Tests of what bridges delays: the joints' response, the feature's filter, the shifted reference, redistribution."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kit.toy import PERIOD, A, M, N, ToyArm
from servobench.controllers.estimate import Estimate
from servobench.controllers.stages.feature_filter import FeatureFilter
from servobench.controllers.stages.joint_response import JointResponse, with_response
from servobench.controllers.stages.limit import redistribute, scale_to_limit
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.controllers.stages.prediction import Predictor, shifted

RESPONSE = np.array([0.0, 0.6, 0.3, 0.1])


def answered(response, steps=40, length=4, joints=3):
    """A JointResponse that has seen random commands and their answers; and the commands, the newest last."""
    rng = np.random.default_rng(3)
    made, commands = JointResponse.immediate(length, np.zeros(joints)), [np.zeros(joints)] * len(response)
    for _ in range(steps):
        made = made.learn(sum(g * commands[-1 - i] for i, g in enumerate(response)))
        commands.append(0.05 * rng.uniform(-1.0, 1.0, joints))
        made = made.command(commands[-1])
    return made, commands


def test_the_response_of_the_joints_is_found():
    made, _ = answered(RESPONSE)
    np.testing.assert_allclose(made.response, RESPONSE, atol=0.01)


def test_flight_and_lead_are_what_is_still_to_come():
    """Of the newest command nothing is done, of the one before 0.4 is left, of that before 0.1: lead = 1.5 periods."""
    made, commands = answered(RESPONSE)
    made = with_response(made, RESPONSE)
    assert made.lead == pytest.approx(1.0 + 0.4 + 0.1)
    expected = 1.0 * commands[-1] + 0.4 * commands[-2] + 0.1 * commands[-3]
    np.testing.assert_allclose(made.flight(), expected, atol=1e-12)


def test_at_first_an_arm_is_expected_to_follow_at_once():
    made = JointResponse.immediate(4, np.zeros(2)).command(np.array([0.05, -0.05]))
    np.testing.assert_array_equal(made.flight(), 0.0)
    assert made.lead == 0.0


def test_the_response_is_the_regularised_least_squares_of_all_that_was_not_foreseen():
    rng, made, rows, answers = np.random.default_rng(0), JointResponse.immediate(3, np.zeros(1)), [], []
    past = np.zeros(3)
    for _ in range(12):
        step = float(np.array([0.2, 0.5, 0.3]) @ past) + 0.003 * rng.choice([-1.0, 1.0])
        if abs(step - made.response @ past) >= 5e-4:
            rows.append(past)
            answers.append(step)
        made = made.learn(np.array([step]))
        command = 0.05 * rng.normal()
        past = np.array([command, *past[:-1]])
        made = made.command(np.array([command]))
    U, prior = np.array(rows), np.array([1.0, 0.0, 0.0])
    rho = 1e-5 * np.diag([1.0, 1.5, 2.25])
    expected = np.linalg.solve(U.T @ U + rho, U.T @ np.array(answers) + rho @ prior)
    assert (expected > 0.0).all()
    np.testing.assert_allclose(made.response, expected, rtol=1e-9)


def filter_at(feature, noise=0.001):
    """Return a filter that starts at a feature."""
    level = NoiseLevel.guess(noise)
    return FeatureFilter(np.asarray(feature, dtype=float), level.variance, level)


def test_the_filter_is_a_kalman_filter_by_hand():
    """σ = 0.1, c = 0.5, ‖Ĵ‖² = 5, ‖Δq‖² = 0.01, r² = 1e-8: p = 0.01 + 0.25·5·0.01/2 = 0.01625, z = 1.2 + L·0.1."""
    made = filter_at([1.0], 0.1).advance(np.array([[2.0, 1.0]]), np.array([0.1, 0.0]), 0.5)
    made = made.correct(np.array([1.3]), False)
    p = 0.01625 + 1e-8
    np.testing.assert_allclose(made.feature, [1.2 + p / (p + 0.01) * 0.1])
    assert made.variance == pytest.approx(p * 0.01 / (p + 0.01))
    assert made.noise.variance == pytest.approx(0.01)


def test_a_motion_of_which_the_jacobian_sees_nothing_makes_the_filter_unsure_too():
    before = filter_at([0.0])
    made = before.advance(np.array([[1.0, 0.0]]), np.array([0.0, 0.1]), 0.2)
    np.testing.assert_array_equal(made.feature, [0.0])
    assert made.variance > 100.0 * before.variance


@pytest.mark.parametrize("noise", [0.001, 0.008])
def test_at_rest_the_filter_averages_and_without_a_frame_it_follows_the_joints(noise):
    rng, made, errors = np.random.default_rng(5), filter_at(np.zeros(3)), []
    for _ in range(900):
        made = made.advance(np.eye(3), np.zeros(3), 0.2).correct(rng.normal(scale=noise, size=3), True)
        errors.append(made.feature)
    assert np.sqrt(np.mean(np.square(errors[300:]))) < 1.3 * np.sqrt(0.5 * 1e-4 * noise)  # L = r/σ: σ √(L/2)
    after = made.advance(np.eye(3), np.array([0.01, 0.0, 0.0]), 0.2)
    np.testing.assert_allclose(after.feature, made.feature + [0.01, 0.0, 0.0])


def test_a_feature_far_off_restarts_the_filter():
    made = filter_at(np.zeros(2)).advance(np.eye(2), np.zeros(2), 0.2).correct(np.array([0.3, 0.1]), True)
    np.testing.assert_array_equal(made.feature, [0.3, 0.1])
    assert made.variance == made.noise.variance


def test_the_prediction_is_where_the_arm_ends_up_once_its_response_is_known():
    arm, predictor, rng = (
        ToyArm(np.eye(M), (0.0, 0.6, 0.4), latency=2),
        Predictor(observe=False),
        np.random.default_rng(0),
    )
    observation = arm.observe()
    state = predictor.start(observation)
    for k in range(40):
        state, bound = predictor.predict(state, Estimate(A, delay=2), observation)
        if k > 20:
            np.testing.assert_allclose(bound.feature, arm.end(), atol=1e-3)
            assert np.linalg.norm(arm.end() - observation.feature) > 3e-3
            assert bound.lead == pytest.approx(1.4, abs=0.05)
        step = 0.05 * rng.uniform(-1.0, 1.0, N)
        state = predictor.note(state, step)
        observation = arm.step(step / PERIOD)


def test_with_both_halves_off_the_prediction_is_the_measurement():
    off, look = Predictor(bridge=False, observe=False), ToyArm(np.eye(M)).observe()
    _, bound = off.predict(off.start(look), Estimate(A, delay=3), look)
    np.testing.assert_array_equal(bound.feature, look.feature)
    np.testing.assert_array_equal(bound.joint_position, look.joint_position)
    assert bound.lead == 0.0


def test_the_shifted_reference_is_interpolated_and_goes_on():
    reference = np.array([[0.0], [1.0], [4.0], [5.0]])
    for lead, expected in ((0.0, [0.0, 1.0]), (1.5, [2.5, 4.5]), (2.25, [4.25, 5.25]), (7.5, [9.5, 10.5])):
        np.testing.assert_allclose(shifted(reference, np.array(lead), 2)[:, 0], expected)
    np.testing.assert_allclose(shifted(reference[:1], np.array(1.5), 1), [[0.0]])


def test_every_lane_has_its_own_shift():
    reference, leads = np.random.default_rng(0).normal(size=(3, 6, 2)), np.array([0.0, 1.5, 8.25])
    single = [shifted(one, lead, 4) for one, lead in zip(reference, leads, strict=True)]
    np.testing.assert_array_equal(shifted(reference, leads, 4), single)


def test_the_second_joint_takes_over_where_the_first_is_at_its_limit():
    """Both move the feature by 1 m/rad; (0.3, 0.1) wants 0.4 m, scaled to (0.1, 0.033); the second goes on to 0.1."""
    dq = redistribute(np.array([0.3, 0.1]), np.array([[1.0, 1.0]]), np.array([0.1, 0.1]), 1e-9)
    np.testing.assert_allclose(dq, [0.1, 0.1])
    small = np.array([0.05, 0.1])
    np.testing.assert_array_equal(redistribute(small, np.array([[1.0, 1.0]]), np.array([0.1, 0.1]), 1e-9), small)


@settings(max_examples=60)
@given(n=st.integers(1, 7), m=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_redistribution_keeps_limits_and_direction_and_goes_no_less_far(n, m, seed):
    rng = np.random.default_rng(seed)
    J, limit = rng.normal(size=(m, n)), rng.uniform(0.05, 0.2, n)
    wanted = rng.normal(size=n)
    dq, scaled = redistribute(wanted, J, limit, 1e-6), scale_to_limit(wanted, limit)
    assert (np.abs(dq) <= limit * (1 + 1e-12)).all()
    way = J @ wanted
    if np.linalg.cond(J) < 100.0:
        share = float((J @ dq) @ way / (way @ way))
        np.testing.assert_allclose(J @ dq, share * way, atol=1e-5)
        assert float((J @ scaled) @ way / (way @ way)) - 1e-6 <= share <= 1.0 + 1e-9


def test_redistribution_goes_further_than_scaling_on_most_arms():
    rng, further = np.random.default_rng(1), 0
    for _ in range(50):
        J, limit, wanted = rng.normal(size=(3, 6)), np.full(6, 0.05), rng.normal(size=6)
        way = J @ wanted
        gained = (J @ (redistribute(wanted, J, limit, 0.02) - scale_to_limit(wanted, limit))) @ way / (way @ way)
        further += gained > 0.005
    assert further > 40
