"""Tests of the composed controller: what it hands to its parts, what it refuses, what each lane does."""

import dataclasses

import numpy as np
import pytest

from kit.toy import Recorded, Recorder, plant_spec, seen
from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.mfac import MfacConfig, MfacLaw
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.servo import Servo, ServoController
from servobench.plant.contract.faults import ControllerDiverged

J0 = np.array([[0.5, 0.1, 0.0], [0.0, 0.4, 0.2]])
KNOWLEDGE = RobotKnowledge(plant_spec(3, 2, reach=1.0), 1, nominal_jacobian=lambda q: J0)


class Broken(Law):
    def start(self, observation):
        return ()

    def command(self, state, estimate, observation, reference):
        return state, np.array([0.0, np.nan, 0.0])

    def diagnostics(self, state):
        return {}


def servo(estimator, law=None, aids=None, knowledge=KNOWLEDGE, **initial):
    law = MfacLaw(MfacConfig(), knowledge) if law is None else law
    provider = initial_jacobian(InitialConfig(**initial), knowledge)
    return ServoController(Servo(estimator, law, provider, knowledge, aids and AidsConfig(**aids)))


def test_a_motion_spans_the_gap_that_lost_frames_leave():
    estimator = Recorder()
    controller = servo(estimator)
    reference = np.full((2, 2), 0.3)
    first = seen([0.0, 0.0, 0.0], [0.1, 0.1])
    controller.reset(first, 0)
    controller.step(first, reference)
    controller.step(seen([0.01, 0.0, 0.0], [0.1, 0.1], valid=False, k=1), reference)
    controller.step(seen([0.02, 0.0, 0.0], [0.1, 0.1], valid=False, k=2), reference)
    controller.step(seen([0.03, 0.0, 0.01], [0.12, 0.11], k=3), reference)
    (motion,) = estimator.motions
    np.testing.assert_array_equal(motion.joint_position, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(motion.joint_step, [0.03, 0.0, 0.01])
    np.testing.assert_allclose(motion.feature_step, [0.02, 0.01])
    np.testing.assert_allclose(motion.error, [0.18, 0.19])
    assert motion.duration == pytest.approx(0.15)
    expected = np.linalg.norm([0.02 - 0.5 * 0.03, 0.01 - 0.2 * 0.01])
    assert controller.diagnostics()["jacobian_prediction_error"] == pytest.approx(expected)


def test_nothing_is_learnt_before_a_second_valid_feature():
    estimator = Recorder()
    controller = servo(estimator)
    reference = np.zeros((2, 2))
    first = seen(np.zeros(3), np.zeros(2), valid=False)
    controller.reset(first, 0)
    assert controller.estimated_jacobian() is None
    controller.step(first, reference)
    controller.step(seen(np.ones(3) * 0.01, np.ones(2) * 0.01, k=1), reference)
    assert estimator.motions == []
    assert np.isnan(controller.diagnostics()["jacobian_prediction_error"])
    np.testing.assert_array_equal(controller.estimated_jacobian(), J0)


def test_a_command_that_is_not_finite_is_a_named_fault():
    controller = servo(ConstantEstimator(), Broken())
    first = seen(np.zeros(3), np.zeros(2))
    controller.reset(first, 0)
    with pytest.raises(ControllerDiverged, match="joint_velocity is not finite at 0 s"):
        controller.step(first, np.zeros((2, 2)))


def test_an_estimate_that_is_not_finite_is_a_named_fault():
    estimator = Recorder()
    first = seen(np.zeros(3), np.zeros(2))
    controller = servo(estimator)
    controller.reset(first, 0)
    controller.step(first, np.zeros((2, 2)))
    estimation = controller.state.estimation
    learned = estimation.learned._replace(estimator=Recorded(np.full((2, 3), np.nan)))
    controller.state = controller.state._replace(estimation=estimation._replace(learned=learned))
    with pytest.raises(ControllerDiverged, match="jacobian is not finite at 0 s"):
        controller.step(first, np.zeros((2, 2)))


class Wishing(Law):
    """A law that wants the sum of all it gets, and remembers what it got and what was sent."""

    def start(self, observation):
        return ()

    def command(self, state, estimate, observation, reference):
        return (*state, (estimate.jacobian, observation, reference)), np.array([0.4, -0.2, 0.1])

    def noted(self, state, joint_velocity, limited):
        return (*state, (joint_velocity, limited))

    def diagnostics(self, state):
        return {}


def test_the_law_gets_the_feature_and_the_reference_of_when_commands_are_carried_out():
    """A given delay of one period: all of the last step is still to come, and takes that period."""
    controller = servo(
        ConstantEstimator(),
        Wishing(),
        {"response": "given", "command_delay": 0.05, "lag": 0.0, "feedforward": True},
    )
    reference = np.array([[0.0, 0.0], [0.3, 0.2]])
    controller.reset(seen(np.zeros(3), [0.1, 0.0]), 0)
    for k in range(2):
        controller.step(seen(np.zeros(3), [0.1, 0.0], k=k), reference)
    (J, first, rows), _, (_, look, _), (sent, _) = controller.state.law
    np.testing.assert_array_equal(J, J0)
    np.testing.assert_array_equal(first.feature, [0.1, 0.0])
    np.testing.assert_allclose(look.joint_position, sent * 0.05)
    np.testing.assert_allclose(look.feature, [0.1, 0.0] + J0 @ sent * 0.05)
    # One period later, and beyond the preview
    np.testing.assert_allclose(rows, [[0.3, 0.2], [0.6, 0.4]])
    assert controller.diagnostics()["lead"] == pytest.approx(0.05)


def test_the_last_stages_change_what_is_sent_and_the_law_notes_it():
    aids = {"feedforward": True, "limit": "clip"}
    controller = servo(ConstantEstimator(), Wishing(), aids)
    reference = np.array([[0.0, 0.0], [0.02, 0.01]])
    controller.reset(seen(np.zeros(3), np.zeros(2)), 0)
    u = controller.step(seen(np.zeros(3), np.zeros(2)), reference).joint_velocity
    wanted = (
        np.array([0.4, -0.2, 0.1])
        + J0.T @ np.linalg.solve(J0 @ J0.T + 0.02**2 * np.eye(2), reference[1]) / 0.05
    )
    assert np.abs(wanted).max() > 1.0
    np.testing.assert_allclose(u, np.clip(wanted, -1.0, 1.0))
    noted, limited = controller.state.law[-1]
    np.testing.assert_array_equal(noted, u)
    assert limited
    assert controller.diagnostics()["saturated"]


def test_a_law_of_the_model_works_in_the_frame_of_the_model():
    """Turning the camera turns what such a law gets not at all, up to the part of the turn that E takes."""

    class Trained(Wishing):
        in_model_frame = True

    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    for law, frame in ((Trained(), np.eye(2)), (Wishing(), turn)):
        controller = servo(ConstantEstimator(), law, {"model": "regression"})
        rng = np.random.default_rng(0)
        q = 0.0
        for k in range(40):
            q = q + 0.05 * rng.normal(size=3)
            y = turn @ J0 @ q
            look = seen(q, y, k=k)
            if k == 0:
                controller.reset(look, 0)
            controller.step(look, np.tile(turn @ [0.3, 0.1], (2, 1)))
        J, look, reference = controller.state.law[-2]
        np.testing.assert_allclose(J, frame @ J0, atol=0.03)
        np.testing.assert_allclose(look.feature, frame @ J0 @ q, atol=0.03)
        np.testing.assert_allclose(reference, np.tile(frame @ [0.3, 0.1], (2, 1)), atol=0.03)
        np.testing.assert_allclose(controller.estimated_jacobian(), turn @ J0, atol=0.03)


def test_the_stages_start_where_the_probing_ends():
    probing = {"source": "probe", "probe_step": 0.01, "settle_time": 0.05, "average_time": 0.05}
    knowledge = dataclasses.replace(KNOWLEDGE, preview=1)
    controller = servo(ConstantEstimator(), None, EQUIPPED, knowledge, **probing)
    q = np.zeros(3)
    reference = np.zeros((2, 2))
    controller.reset(seen(q, J0 @ q), 0)
    for k in range(40):
        u = controller.step(seen(q, J0 @ q, k=k), reference).joint_velocity
        if not controller.diagnostics()["probing"]:
            break
        assert controller.diagnostics()["lead"] == 0.0
        q = q + 0.05 * u
    assert k > 6
    assert q.all()
    past = controller.state.estimation.learned.pair.past[..., :3]
    np.testing.assert_array_equal(past, np.tile(q, (len(past), 1)))
    np.testing.assert_allclose(controller.estimated_jacobian(), J0, atol=1e-9)


PREDICTIVE = MpcLaw(MpcConfig(use_preview=False, delay=0.1), KNOWLEDGE)
PREVIEWING = MpcLaw(MpcConfig(horizon_time=0.05, moves=1), KNOWLEDGE)


@pytest.mark.parametrize(
    ("law", "aids", "message"),
    [
        (
            PREDICTIVE,
            {"delay": "identified"},
            "aids: MpcLaw predicts by itself; leave delay, response and filter off",
        ),
        (
            PREDICTIVE,
            {"response": "given"},
            "aids: MpcLaw predicts by itself; leave delay, response and filter off",
        ),
        (
            PREDICTIVE,
            {"filter": True},
            "aids: MpcLaw predicts by itself; leave delay, response and filter off",
        ),
        (
            PREVIEWING,
            {"feedforward": True},
            "aids.feedforward: MpcLaw brings its own preview; leave this aid out",
        ),
        (
            PREVIEWING,
            {"limit": "clip"},
            "aids.limit: MpcLaw brings its own limit; leave this aid out",
        ),
        (None, {"feedforward": True}, "preview must be at least 1 for feedforward, got 0"),
    ],
)
def test_an_aid_that_the_law_brings_or_that_lacks_a_preview_is_refused_in_one_line(
    law, aids, message
):
    knowledge = KNOWLEDGE if law else dataclasses.replace(KNOWLEDGE, preview=0)
    with pytest.raises(ValueError, match=f"^{message}$"):
        servo(ConstantEstimator(), law, aids, knowledge)
