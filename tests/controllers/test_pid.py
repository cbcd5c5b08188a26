"""Tests of the PID law against hand-computed steps and closed-loop facts."""

import numpy as np

from kit.toy import Commanding, plant_spec, seen
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.pid import PidConfig, PidLaw

J = np.array([[0.5, 0.1, 0.0], [0.0, 0.4, 0.2]])


def knowledge(limit=100.0, preview=1, n=3, m=2):
    return RobotKnowledge(plant_spec(n, m, limit), preview)


def look(feature, valid=True):
    return seen(np.zeros(3), feature, valid)


def fresh(limit=100.0, **settings):
    law = PidLaw(PidConfig(**{"damping": 0.0, **settings}), knowledge(limit))
    return Commanding(law, look([0.0, 0.0]), knowledge(limit))


def test_the_first_step_equals_the_one_computed_by_hand():
    law = PidLaw(
        PidConfig(proportional_gain=-20.0 * np.log(0.9), integral_gain=4.0, damping=0.0),
        knowledge(n=1, m=1),
    )
    first = seen([0.0], [0.0])
    # γ = 0.1, e = 0.1, I = 0.05 · 0.1 = 0.005, v = 0.1 / 0.05 · 0.1 + 4 · 0.005 = 0.22, u = 0.22 / 0.5
    assert law.start(first).since_feature.shape == ()
    _, u = law.command(
        law.start(first), Estimate(np.array([[0.5]])), first, np.array([[0.1], [0.7]])
    )
    np.testing.assert_allclose(u, [0.44], rtol=1e-14)


def test_the_derivative_is_the_filtered_difference_of_errors_and_the_first_has_none():
    law = fresh(proportional_gain=1.0, derivative_gain=1.0, derivative_filter=0.15)
    # d = 0, then (0.15 · 0 + 0.3 − 0.1) / (0.15 + 0.05) = 1, then (0.15 · 1 + 0.4 − 0.3) / (0.15 + 0.05) = 1.25
    for error, d in ((0.1, 0.0), (0.3, 1.0), (0.4, 1.25)):
        u = law.command(Estimate(J), look([-error, 0.0]), np.zeros((2, 2)))
        proportional = error * (1.0 - np.exp(-0.05)) / 0.05
        np.testing.assert_allclose(J @ u, [proportional + d, 0.0], atol=1e-14)


def test_with_the_exact_jacobian_the_error_of_an_affine_plant_decays_as_exp_kp_t():
    law = fresh(proportional_gain=3.0)
    y = np.array([0.2, -0.1])
    ref = np.array([[0.5, 0.3]] * 2)
    for _ in range(50):
        e = ref[0] - y
        y = y + J @ law.command(Estimate(J), look(y), ref) * 0.05
        np.testing.assert_allclose(ref[0] - y, np.exp(-3.0 * 0.05) * e, atol=1e-15)


def test_the_integral_waits_while_the_command_is_limited():
    law = fresh(limit=0.01, integral_gain=1.0)
    for _ in range(100):
        law.command(Estimate(J), look([0.0, 0.0]), np.ones((2, 2)))
    assert law.diagnostics() == {"integral_norm": 0.0}
    assert law.limited


def test_a_wound_up_integral_may_shrink_while_the_command_is_limited():
    law = fresh(limit=10.0, integral_gain=1.0)
    for _ in range(20):
        law.command(Estimate(J), look([0.0, 0.0]), np.full((2, 2), 0.5))
    wound = law.diagnostics()["integral_norm"]
    law.command(Estimate(J), look([0.0, 0.0]), np.full((2, 2), -5.0))
    assert law.limited
    assert law.diagnostics()["integral_norm"] < wound


def test_an_invalid_feature_leaves_integral_and_derivative_alone():
    law = fresh(integral_gain=1.0, derivative_gain=1.0)
    law.command(Estimate(J), look([0.0, 0.0]), np.full((2, 2), 0.1))
    before = law.diagnostics()["integral_norm"]
    law.command(Estimate(J), look([0.0, 0.0], valid=False), np.full((2, 2), 0.1))
    assert law.diagnostics()["integral_norm"] == before


def test_a_feature_that_was_lost_for_a_while_gives_the_derivative_no_kick():
    law = fresh(proportional_gain=1e-9, derivative_gain=1.0)
    v = []
    for k in range(60):
        u = law.command(
            Estimate(J), look([-0.01 * k, 0.0], valid=k < 40 or k == 59), np.zeros((2, 2))
        )
        v.append((J @ u)[0])
    # 0.01 m per period of 0.05 s, before, during and after the gap
    np.testing.assert_allclose(v[39:], 0.2, rtol=1e-6)
