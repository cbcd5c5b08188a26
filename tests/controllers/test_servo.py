"""Tests of the composed controller: what it hands to its parts, what it refuses, what each lane does."""

from typing import NamedTuple

import numpy as np
import pytest

from kit.toy import plant_spec, seen
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.estimators.estimator import Estimator
from servobench.controllers.estimators.fixed import ConstantEstimator
from servobench.controllers.initial import InitialConfig, initial_jacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.mfac import MfacConfig, MfacLaw
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.servo import Servo, ServoController
from servobench.controllers.stages.prediction import Prediction, Predictor
from servobench.plant.faults import ControllerDiverged

J0 = np.array([[0.5, 0.1, 0.0], [0.0, 0.4, 0.2]])
KNOWLEDGE = RobotKnowledge(plant_spec(3, 2, reach=1.0), 1, nominal_jacobian=lambda q: J0)


class Recorded(NamedTuple):
    J: np.ndarray


class Recorder(Estimator):
    def __init__(self):
        self.motions = []

    def start(self, jacobian):
        return Recorded(jacobian)

    def update(self, state, motion):
        self.motions.append(motion)
        return state

    def diagnostics(self, state):
        return {"motions": len(self.motions)}


class Broken(Law):
    def start(self, observation):
        return ()

    def command(self, state, estimate, observation, reference):
        return state, np.array([0.0, np.nan, 0.0])

    def diagnostics(self, state):
        return {}


def servo(estimator, law=None, predictor=None, **initial):
    law = MfacLaw(MfacConfig(), KNOWLEDGE) if law is None else law
    provider = initial_jacobian(InitialConfig(**initial), KNOWLEDGE)
    return ServoController(Servo(estimator, law, provider, KNOWLEDGE, predictor))


def test_a_motion_spans_the_gap_that_lost_frames_leave():
    estimator = Recorder()
    controller, reference = servo(estimator), np.full((2, 2), 0.3)
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
    controller, reference = servo(estimator), np.zeros((2, 2))
    first = seen(np.zeros(3), np.zeros(2), valid=False)
    controller.reset(first, 0)
    assert controller.estimated_jacobian() is None
    controller.step(first, reference)
    controller.step(seen(np.ones(3) * 0.01, np.ones(2) * 0.01, k=1), reference)
    assert estimator.motions == []
    assert np.isnan(controller.diagnostics()["jacobian_prediction_error"])
    np.testing.assert_array_equal(controller.estimated_jacobian(), J0)


def test_the_first_step_equals_the_law_at_the_first_jacobian():
    controller, law = servo(ConstantEstimator()), MfacLaw(MfacConfig(), KNOWLEDGE)
    first, reference = seen(np.zeros(3), [0.1, 0.0]), np.full((2, 2), 0.12)
    controller.reset(first, 0)
    _, expected = law.command(law.start(first), Estimate(J0), first, reference)
    np.testing.assert_array_equal(controller.step(first, reference).joint_velocity, expected)
    assert controller.diagnostics()["probing"] == 0.0


def test_a_command_that_is_not_finite_is_a_named_fault():
    controller, first = servo(ConstantEstimator(), Broken()), seen(np.zeros(3), np.zeros(2))
    controller.reset(first, 0)
    with pytest.raises(ControllerDiverged, match="joint_velocity is not finite at 0 s"):
        controller.step(first, np.zeros((2, 2)))


def test_an_estimate_that_is_not_finite_is_a_named_fault():
    estimator, first = Recorder(), seen(np.zeros(3), np.zeros(2))
    controller = servo(estimator)
    controller.reset(first, 0)
    controller.step(first, np.zeros((2, 2)))
    controller.state = controller.state._replace(estimator=Recorded(np.full((2, 3), np.nan)))
    with pytest.raises(ControllerDiverged, match="jacobian is not finite at 0 s"):
        controller.step(first, np.zeros((2, 2)))


def test_a_predictor_stands_before_the_law_and_gets_the_command():
    class Doubling:
        def start(self, observation):
            return ()

        def predict(self, state, estimate, observation):
            return state, Prediction(2.0 * observation.feature, observation.joint_position, np.array(1.0))

        def note(self, state, joint_step):
            return (*state, joint_step)

    controller, law = servo(ConstantEstimator(), predictor=Doubling()), MfacLaw(MfacConfig(), KNOWLEDGE)
    first = seen(np.zeros(3), [0.1, 0.0])
    controller.reset(first, 0)
    u = controller.step(first, np.array([[0.0, 0.0], [0.3, 0.2]])).joint_velocity
    doubled = seen(np.zeros(3), [0.2, 0.0])
    shifted = np.array([[0.3, 0.2], [0.6, 0.4]])
    np.testing.assert_array_equal(u, law.command(law.start(first), Estimate(J0), doubled, shifted)[1])
    np.testing.assert_array_equal(controller.state.predictor, [u * 0.05])


def test_the_predictor_starts_where_the_probing_ends():
    probing = {"source": "probe", "probe_step": 0.01, "settle_periods": 1, "average_periods": 1}
    controller, q, reference = (
        servo(ConstantEstimator(), predictor=Predictor(), **probing),
        np.zeros(3),
        np.zeros((2, 2)),
    )
    controller.reset(seen(q, J0 @ q), 0)
    for k in range(40):
        u = controller.step(seen(q, J0 @ q, k=k), reference).joint_velocity
        if not controller.diagnostics()["probing"]:
            break
        q = q + 0.05 * u
    assert k > 6
    assert q.all()
    np.testing.assert_array_equal(controller.state.predictor.past, np.tile(q, (16, 1)))


def test_a_second_predict_stage_is_refused():
    law = MpcLaw(MpcConfig(use_preview=False), KNOWLEDGE)
    with pytest.raises(ValueError, match="predictor must be None for MpcLaw, which predicts itself"):
        servo(ConstantEstimator(), law, Predictor())


def test_the_law_notes_what_is_sent():
    law = MpcLaw(MpcConfig(use_preview=False, moves=1), KNOWLEDGE)
    controller = servo(Recorder(), law)
    first = seen(np.zeros(3), np.zeros(2))
    controller.reset(first, 0)
    sent = controller.step(first, np.full((2, 2), 0.3)).joint_velocity
    assert np.abs(sent).max() > 0.0
    np.testing.assert_allclose(controller.save().law.last, sent * KNOWLEDGE.spec.period, rtol=1e-12)
