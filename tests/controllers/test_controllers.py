"""Contract tests over every composed controller: any size, any finite observation, nothing remembered after reset."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servobench.controllers import (
    broyden,
    calibrated,
    cfdl_mfac,
    constant,
    kalman_mfac,
    rbf_pid,
    rbfnn_mfac,
    rbfnn_mfac_plus,
    rls,
    ukf_mfac,
)
from servobench.controllers.composed import (
    ESTIMATORS,
    LAWS,
    compose,
    servo_entry,
)
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.initial import InitialConfig
from servobench.controllers.networks.config import ControllerTraining, JacobianTraining
from servobench.controllers.networks.fit import train
from servobench.controllers.servo import ServoController
from servobench.harness.config.defaults import default_config
from servobench.plant.signals import Observation, PlantSpec

MODULES = (
    broyden,
    calibrated,
    cfdl_mfac,
    constant,
    kalman_mfac,
    rbf_pid,
    rbfnn_mfac,
    rbfnn_mfac_plus,
    rls,
    ukf_mfac,
)
PRESETS = [module.ENTRY for module in MODULES]
PAIRS = [compose(law, estimator) for law in sorted(LAWS) for estimator in sorted(ESTIMATORS)]
ENTRIES = [pytest.param(entry, id=entry.name) for entry in PRESETS + PAIRS]
PREVIEW = 20
SMALL = {"samples": 40, "width_scales": (1.0,), "regularisations": (1e-6,)}


def robot(n, m, seed):
    """What may be known about a made-up robot y = A sin(B q) of any size; its true Jacobian has other numbers."""
    rng = np.random.default_rng(seed)
    names = tuple(f"j{i}" for i in range(n)), tuple(f"y{i}" for i in range(m))
    spec = PlantSpec(*names, rng.uniform(0.1, 3.0, n), np.full(n, -6.0), np.full(n, 6.0), 0.05)
    A, B = rng.normal(size=(m, n)), rng.normal(size=n)

    def nominal_jacobian(q):
        return A * (B * np.cos(B * q))[..., None, :]

    def train_small(config):
        jacobian, controller = JacobianTraining(centres=6, **SMALL), ControllerTraining(hidden=6, **SMALL)
        return train(dataclasses.replace(config, jacobian=jacobian, controller=controller), nominal_jacobian, spec)

    return RobotKnowledge(
        spec,
        PREVIEW,
        nominal_jacobian,
        region=(np.full(n, -1.0), np.full(n, 1.0)),
        train=train_small,
        true_jacobian=lambda q: 1.1 * A * (B * np.cos(B * q))[..., None, :],
    )


def random_run(controller, spec, seed, scale, steps=12):
    """Feed random finite observations and return commands, Jacobians and diagnostics."""
    rng, told = np.random.default_rng(seed), []
    for k in range(steps):
        observation = Observation(
            k * spec.period,
            rng.uniform(spec.joint_lower, spec.joint_upper),
            rng.normal(scale=scale, size=spec.m),
            bool(rng.random() < 0.8),
        )
        if k == 0:
            controller.reset(observation, 0)
        reference = rng.normal(scale=scale, size=(1 + PREVIEW, spec.m))
        u = controller.step(observation, reference).joint_velocity
        told.append((u, controller.estimated_jacobian(), dict(controller.diagnostics())))
    return told


@pytest.mark.parametrize("entry", ENTRIES)
@settings(max_examples=8, deadline=None, derandomize=True)
@given(n=st.integers(2, 8), m=st.integers(1, 4), seed=st.integers(0, 10**6), exponent=st.integers(-3, 6))
def test_commands_are_finite_and_within_the_limits_for_any_observation(entry, n, m, seed, exponent):
    knowledge = robot(n, m, seed)
    controller = entry.build(default_config(entry), knowledge)
    for u, J, diagnostics in random_run(controller, knowledge.spec, seed, 10.0**exponent):
        assert u.shape == (n,)
        assert (np.abs(u) <= knowledge.spec.joint_velocity_limit * (1 + 1e-12)).all()
        assert J is None or (J.shape == (m, n) and np.isfinite(J).all())
        assert all(isinstance(value, float) for value in diagnostics.values())


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("source", ["nominal", "probe"])
def test_reset_forgets_everything(entry, source):
    knowledge = robot(5, 3, 7)
    initial = InitialConfig(source=source, probe_step=1e-3, settle_periods=1, average_periods=1)
    controller = entry.build(dataclasses.replace(default_config(entry), initial=initial), knowledge)
    steps = 40 if source == "probe" else 12
    first = random_run(controller, knowledge.spec, 1, 0.5, steps)
    random_run(controller, knowledge.spec, 2, 0.5, steps // 2)
    np.testing.assert_equal(random_run(controller, knowledge.spec, 1, 0.5, steps), first)


@pytest.mark.parametrize("entry", ENTRIES)
def test_estimator_law_and_servo_tell_different_things(entry):
    knowledge = robot(4, 2, 3)
    settings_, names = default_config(entry), ["probing", "jacobian_prediction_error"]
    controller = entry.build(settings_, knowledge)
    (_, _, merged), *_ = random_run(controller, knowledge.spec, 3, 0.5)
    assert isinstance(controller, ServoController)
    for part in (controller.estimator, controller.law):
        names += part.diagnostics()
    assert sorted(names) == sorted(merged)


def test_only_the_calibrated_controller_is_told_the_truth():
    assert [entry.name for entry in PRESETS if entry.needs_truth] == ["calibrated"]
    assert compose("mfac", "true").needs_truth
    knowledge = dataclasses.replace(robot(3, 2, 0), true_jacobian=None)
    with pytest.raises(ValueError, match="true_jacobian must be known"):
        calibrated.ENTRY.build(calibrated.CalibratedConfig(), knowledge)


def test_the_kalman_preset_commands_what_the_unscented_one_does():
    knowledge = robot(6, 3, 11)
    runs = [
        random_run(entry.build(default_config(entry), knowledge), knowledge.spec, 5, 0.5, steps=60)
        for entry in (ukf_mfac.ENTRY, kalman_mfac.ENTRY)
    ]
    for (u, J, _), (u_kalman, J_kalman, _) in zip(*runs, strict=True):
        np.testing.assert_allclose(u, u_kalman, atol=1e-9)
        np.testing.assert_allclose(J, J_kalman, atol=1e-9)


def test_composing_the_same_pair_twice_gives_the_same_entry():
    assert compose("pid", "rls") is compose("pid", "rls")
    assert compose("pid", "rls").name == "pid+rls"
    assert [f.name for f in dataclasses.fields(compose("pid", "rls").config)] == ["estimator", "law", "initial"]


def test_an_unknown_part_is_refused_with_the_valid_choices():
    with pytest.raises(ValueError, match=r"law must be one of .*mfac.*pid.*, got 'lqr'"):
        compose("lqr", "rls")
    with pytest.raises(ValueError, match=r"estimator must be one of .*ukf, got 'ekf'"):
        servo_entry("x", "y", ukf_mfac.UkfMfacConfig, law="pid", estimator="ekf")
