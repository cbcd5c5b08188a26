"""Contract tests over every method: any size, any finite observation, reset, save and restore, settings.

Pairs of a law and an estimator are tested along one row and one column of their table.
"""

import dataclasses

import casadi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kit.nightly import NIGHTLY, some
from kit.toy import KNOWLEDGE, SineModel, networks, plant_spec, seen
from servobench.controllers import nmpc_calibrated, revealed
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.initial_jacobian import InitialConfig
from servobench.controllers.methods import ESTIMATORS, LAWS, METHODS, PUBLISHED, compose
from servobench.controllers.networks.config import ControllerTraining, JacobianTraining
from servobench.controllers.networks.fit import train
from servobench.controllers.servo import ServoController
from servobench.harness.apps.check.controllers import ControllerChecks
from servobench.harness.apps.check.report import report
from servobench.harness.config.settings import default_config
from servobench.plant.contract.signals import Observation

PAIRS = [compose("pid", estimator) for estimator in ESTIMATORS] + [
    compose(law, "kalman") for law in LAWS
]
COMPOSED = [
    pytest.param(entry, id=entry.name) for entry in dict.fromkeys([*METHODS.values(), *PAIRS])
]
EQUIPPED = [name for name in METHODS if not name.endswith(PUBLISHED)]
CHECKED = some(EQUIPPED, "calibrating_mfac", "regression_mfac", "rbfnn_mfac", "ukf_mpc")
ALL = [
    *COMPOSED,
    pytest.param(nmpc_calibrated.ENTRY, id="nmpc_calibrated"),
    pytest.param(revealed.ENTRY, id="revealed"),
]
PREVIEW = 20
SMALL = {"samples": 40, "width_scales": (1.0,), "regularisations": (1e-6,)}


def robot(n, m, seed):
    """What may be known about a made-up robot y = A sin(B q) of any size; its true Jacobian has other numbers."""
    rng = np.random.default_rng(seed)
    spec = plant_spec(n, m, rng.uniform(0.1, 3.0, n))
    A = rng.normal(size=(m, n))
    B = rng.normal(size=n)

    def nominal_jacobian(q):
        return A * (B * np.cos(B * q))[..., None, :]

    def train_small(config):
        jacobian = JacobianTraining(centres=6, **SMALL)
        controller = ControllerTraining(hidden=6, **SMALL)
        return train(
            dataclasses.replace(config, jacobian=jacobian, controller=controller),
            nominal_jacobian,
            spec,
        )

    return RobotKnowledge(
        spec,
        PREVIEW,
        nominal_jacobian,
        region=(np.full(n, -1.0), np.full(n, 1.0)),
        nominal_model=SineModel(A, B),
        train=train_small,
        true_jacobian=lambda q: 1.1 * A * (B * np.cos(B * q))[..., None, :],
        true_symbolic=lambda q: casadi.mtimes(casadi.DM(1.1 * A), casadi.sin(casadi.DM(B) * q)),
    )


def random_run(controller, spec, seed, scale, steps=12, start=True):
    """Feed random finite observations and return commands, Jacobians and diagnostics."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(steps):
        q = rng.uniform(spec.joint_lower, spec.joint_upper)
        feature = rng.normal(scale=scale, size=spec.m)
        observation = Observation(k * spec.period, q, feature, bool(rng.random() < 0.8))
        if k == 0 and start:
            controller.reset(observation, 0)
        reference = rng.normal(scale=scale, size=(1 + PREVIEW, spec.m))
        u = controller.step(observation, reference).joint_velocity
        found.append((u, controller.estimated_jacobian(), dict(controller.diagnostics())))
    return found


@pytest.mark.parametrize("entry", ALL)
@settings(max_examples=30 if NIGHTLY else 4, derandomize=True)
@given(
    n=st.integers(2, 8),
    m=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    exponent=st.integers(-3, 6),
)
@pytest.mark.slow
def test_commands_are_finite_and_within_the_limits_for_any_observation(entry, n, m, seed, exponent):
    knowledge = robot(n, m, seed)
    controller = entry.build(default_config(entry), knowledge)
    for u, J, diagnostics in random_run(controller, knowledge.spec, seed, 10.0**exponent):
        assert u.shape == (n,)
        assert (np.abs(u) <= knowledge.spec.joint_velocity_limit * (1 + 1e-12)).all()
        assert J is None or (J.shape == (m, n) and np.isfinite(J).all())
        assert all(np.shape(value) == () for value in diagnostics.values())


@pytest.mark.parametrize(
    "entry",
    [*(METHODS[name] for name in CHECKED), nmpc_calibrated.ENTRY],
    ids=lambda entry: entry.name,
)
def test_a_method_keeps_the_contract_of_controllers(entry):
    checked = report(
        entry.name, ControllerChecks(entry).checks(), lambda _name: None, lambda _finding: None
    )
    # Which the machine decides
    assert {each.check for each in checked.failures} <= {"time"}, checked.failures
    assert len(checked.findings) == 18


@pytest.mark.parametrize("entry", COMPOSED)
def test_reset_forgets_everything_also_while_the_jacobian_is_probed(entry):
    initial = InitialConfig(source="probe", probe_step=1e-3, settle_time=0.05, average_time=0.05)
    knowledge = robot(5, 3, 7)
    config = dataclasses.replace(default_config(entry), initial=initial)
    controller = entry.build(config, knowledge)
    first = random_run(controller, knowledge.spec, 1, 0.5, 40)
    random_run(controller, knowledge.spec, 2, 0.5, 20)
    np.testing.assert_equal(random_run(controller, knowledge.spec, 1, 0.5, 40), first)


@pytest.mark.parametrize("entry", COMPOSED)
def test_a_restored_controller_goes_on_as_the_saved_one_did(entry):
    knowledge = robot(6, 3, 9)
    controller = entry.build(default_config(entry), knowledge)
    random_run(controller, knowledge.spec, 1, 0.5, steps=7)
    saved = controller.save()
    expected = random_run(controller, knowledge.spec, 2, 0.5, start=False)
    for _ in range(2):  # restoring does not use the saved state up
        controller.restore(saved)
        np.testing.assert_equal(
            random_run(controller, knowledge.spec, 2, 0.5, start=False), expected
        )


@pytest.mark.parametrize("entry", COMPOSED)
def test_estimator_law_and_servo_report_different_things(entry):
    knowledge = robot(4, 2, 3)
    controller = entry.build(default_config(entry), knowledge)
    names = ["probing", "jacobian_prediction_error"]
    (_, _, merged), *_ = random_run(controller, knowledge.spec, 3, 0.5)
    assert isinstance(controller, ServoController)
    servo = controller.servo
    state = controller.state
    estimation = servo.estimation
    learned = state.estimation.learned
    names += [
        *estimation.estimator.diagnostics(learned.estimator),
        *servo.law.diagnostics(state.law),
        "saturated",
    ]
    if estimation.pairing is not None:
        names += estimation.pairing.diagnostics(learned.pair)
    if servo.predictor is not None:
        names.append("lead")
    if servo.calibration is not None:
        names += servo.calibration.diagnostics(state.calibration)
    assert sorted(names) == sorted(merged)


@pytest.mark.parametrize("entry", ALL)
def test_what_is_of_the_wrong_size_or_not_finite_is_refused(entry):
    controller = entry.build(default_config(entry), robot(3, 2, 0))
    good = seen([0] * 3, [0] * 2)
    narrow = seen([0] * 2, [0] * 2)
    tall = seen([0] * 3, [0] * 3)
    still = np.zeros((21, 2))
    controller.reset(good, 0)
    for refused, arguments, message in (
        (
            controller.step,
            (narrow, still),
            r"observation.joint_position must have shape \(3,\), got \(2,\)",
        ),
        (controller.reset, (tall, 0), r"observation.feature must have shape \(2,\), got \(3,\)"),
        (
            controller.step,
            (good, still[:4]),
            r"reference must have shape \(21, 2\) for a preview of 20, got \(4, 2\)",
        ),
        (controller.step, (good, np.nan * still), "reference must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            refused(*arguments)


def test_what_needs_the_truth_is_refused_without_it():
    assert compose("mfac", "true").needs_truth
    knowledge = dataclasses.replace(robot(3, 2, 0), true_jacobian=None)
    with pytest.raises(ValueError, match="true_jacobian must be known"):
        METHODS["calibrated"].build(METHODS["calibrated"].config(), knowledge)


def test_a_pair_is_called_by_its_parts_and_has_a_training_only_with_networks():
    assert compose("pid", "rls").name == "pid+rls"
    parts = [field.name for field in dataclasses.fields(compose("pid", "rls").config())]
    assert parts == ["estimator", "law", "initial", "aids"]
    assert hasattr(compose("pid", "rbf").config(), "training")


def test_only_the_law_that_was_trained_on_the_nominal_model_works_in_its_frame():
    assert {name for name, part in LAWS.items() if part.make.in_model_frame} == {"rbfnn"}


def test_laws_declare_the_stages_that_they_bring():
    for name, config, owned in (
        ("pid", {}, set()),
        ("mfac", {}, set()),
        ("mpc", {}, {"limit", "preview"}),
        ("mpc", {"use_preview": False, "delay": 0.1}, {"limit", "predict"}),
        ("rbfnn", {}, {"preview"}),
        ("rbfnn", {"preview": False}, set()),
    ):
        part = LAWS[name]
        made = part.make(part.config(**config), KNOWLEDGE, *([networks()] if part.trained else []))
        assert made.owns == owned
