"""The rivals in docs/examples: their formulas by hand and in closed form, and that the stored values are theirs."""

import math
import runpy

import numpy as np
import pytest

import servobench
from kit.documents import ROOT
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.mfac import mfac_step
from servobench.harness.config.entries import CONTROLLER, read_own
from servobench.plant.contract.signals import Observation, PlantSpec

FOLDER = ROOT / "docs" / "examples" / "rivals"
CLASSES = {"adrc": "Adrc", "pfdl_mfac": "PfdlMfac"}
PLACES = [
    f"{FOLDER / name}.py:{kind}{end}" for name, kind in CLASSES.items() for end in ("", "Alone")
]
PERIOD = 0.05


def built(name, jacobian, limit=100.0, **settings):
    """Return a rival without aids for an arm with a constant Jacobian, (m, n)."""
    m, n = jacobian.shape
    joints, features = [f"q{k}" for k in range(n)], [f"y{k}" for k in range(m)]
    spec = PlantSpec.of_joints(
        tuple(joints), tuple(features), [limit] * n, [-3.0] * n, [3.0] * n, PERIOD
    )
    found = runpy.run_path(str(FOLDER / f"{name}.py"))
    kind = CLASSES[name]
    knowledge = RobotKnowledge(spec, 0, lambda _: jacobian)
    return found[f"{kind}Alone"](found[f"{kind}Config"](**settings), knowledge)


def seen(k, feature, n=1, valid=True):
    return Observation(PERIOD * k, np.zeros(n), np.atleast_1d(feature), feature_valid=valid)


def test_the_first_step_of_adrc_is_that_of_a_proportional_controller():
    """By hand: v = 3 e = (0.3, −0.6), and u = (0.3 / 0.5, −0.6 / 0.25)."""
    law = built("adrc", np.diag([0.5, 0.25]), gain=3.0, damping=1e-9)
    first = seen(0, [1.0, 2.0], n=2)
    law.reset(first, 0)
    command = law.step(first, np.array([[1.1, 1.8]]))
    np.testing.assert_allclose(command.joint_velocity, [0.6, -2.4], rtol=1e-9)


@pytest.mark.parametrize("delay", [0, 2])
def test_the_observer_of_adrc_finds_a_constant_disturbance_with_a_double_pole(delay):
    """For y(k + 1) = y(k) + T (v(k − d) + f) the observer has z₂(k) = f (1 − aᵏ (1 + k (1 − a))), a = exp(−w T)."""
    f, y, bandwidth = 0.7, 0.2, 8.0
    law = built("adrc", np.eye(1), bandwidth=bandwidth, input_delay=delay * PERIOD, damping=1e-9)
    law.reset(seen(0, y), 0)
    inputs = [0.0] * delay
    a = math.exp(-bandwidth * PERIOD)
    for k in range(30):
        inputs.append(law.step(seen(k, y), np.ones((1, 1))).joint_velocity[0])
        assert law.z2[0] == pytest.approx(f * (1.0 - a**k * (1.0 + k * (1.0 - a))), abs=1e-12)
        y = y + PERIOD * (inputs[k] + f)


def test_adrc_ends_without_error_on_an_arm_of_half_the_gain_and_a_drift():
    law = built("adrc", np.eye(1))
    y = 0.0
    law.reset(seen(0, y), 0)
    for k in range(400):
        valid = k % 7 != 3  # some frames are lost
        u = law.step(seen(k, y if valid else 99.0, valid=valid), np.ones((1, 1))).joint_velocity[0]
        y = y + PERIOD * (0.5 * u + 0.2)
    assert y == pytest.approx(1.0, abs=2e-4)


def test_the_first_step_of_pfdl_is_that_of_model_free_adaptive_control():
    J = np.random.default_rng(0).normal(size=(3, 6))
    law = built("pfdl_mfac", J, gain=4.0, step_weight=0.3)
    first = seen(0, [0.1, 0.2, 0.3], n=6)
    law.reset(first, 0)
    command = law.step(first, np.array([[0.2, 0.1, 0.5]]))
    e = np.array([0.1, -0.1, 0.2])
    step = mfac_step(J, e, 1.0 - math.exp(-4.0 * PERIOD), 0.3)
    np.testing.assert_allclose(command.joint_velocity, step / PERIOD, rtol=1e-12)


def test_pfdl_learns_what_two_commands_do_as_the_formulas_say():
    """One joint and two steps remembered, with all formulas in numbers: Φ₁ and Φ₂ from 1 and 0 on."""
    eta, mu, weight, gain = 0.5, 0.01, 0.1, 4.0
    law = built(
        "pfdl_mfac", np.eye(1), memory=0.1, step_factor=eta, regularisation=mu,
        step_weight=weight, gain=gain,
    )  # fmt: skip
    rho = 1.0 - math.exp(-gain * PERIOD)
    first, second = 1.0, 0.0  # Φ₁ and Φ₂
    newer, older = 0.0, 0.0  # steps
    y, before = 0.0, 0.0
    law.reset(seen(0, y), 0)
    for k in range(12):
        square = mu + newer**2 + older**2
        misfit = y - before - first * newer - second * older
        first += eta * misfit * newer / square
        second += eta * misfit * older / square
        step = rho * first * (1.0 - y - second * newer) / (weight + first**2)
        u = law.step(seen(k, y), np.ones((1, 1))).joint_velocity[0]
        assert u == pytest.approx(step / PERIOD, rel=1e-9)
        newer, older = step, newer
        before, y = y, y + 0.3 * newer + 0.4 * older
    assert second > 0.01


def test_pfdl_begins_anew_where_its_jacobian_has_turned_away():
    law = built("pfdl_mfac", np.eye(1), step_factor=1.9, regularisation=1e-9)
    law.reset(seen(0, 0.0), 0)
    law.step(seen(0, 0.0), np.ones((1, 1)))
    step = law.steps[0][0]
    law.step(seen(1, -step), np.ones((1, 1)))  # the arm went the other way
    assert not law.E.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", CLASSES)
def test_a_rival_keeps_the_contract_of_controllers(name):
    place = f"{FOLDER / name}.py:{CLASSES[name]}"
    assert servobench.check_controller(f"contract_{name}={place}").ok


@pytest.mark.parametrize("place", PLACES)
def test_the_stored_values_are_those_of_the_code_as_it_is(place):
    own = read_own(CONTROLLER, place)
    assert own.tuned["settings"]
    assert "3 × 30" in own.tuned["budget"]
