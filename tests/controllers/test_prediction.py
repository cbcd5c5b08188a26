"""Tests of the predict stage: the joints' response, the feature's filter, the shifted reference."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import StateSpace, cont2discrete, dlsim

from kit.toy import KNOWLEDGE, PERIOD, A, M, N, ToyArm, seen
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.stages.estimation import Estimation
from servobench.controllers.stages.joint_response import JointResponse, with_response
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.controllers.stages.prediction import FeatureFilter, Predictor, shifted

RESPONSE = np.array([0.0, 0.6, 0.3, 0.1])
NO_DELAYS = Delays(0.0, 0.0, 0.0)


def answered(response, steps=40, length=4, joints=3):
    """A JointResponse that has seen random commands and their answers; and the commands, the newest last."""
    rng = np.random.default_rng(3)
    made, commands = JointResponse.immediate(length, np.zeros(joints), PERIOD), [np.zeros(joints)] * len(response)
    for _ in range(steps):
        made = made.learn(sum(g * commands[-1 - i] for i, g in enumerate(response)))
        commands.append(0.05 * rng.uniform(-1.0, 1.0, joints))
        made = made.command(commands[-1])
    return made, commands


def test_flight_and_lead_are_what_is_still_to_come():
    """Of the newest command nothing is done, of the one before 0.4 is left, of that before 0.1: lead = 1.5 periods."""
    made, commands = answered(RESPONSE)
    made = with_response(made, RESPONSE)
    assert made.lead == pytest.approx(1.0 + 0.4 + 0.1)
    expected = 1.0 * commands[-1] + 0.4 * commands[-2] + 0.1 * commands[-3]
    np.testing.assert_allclose(made.flight(), expected, atol=1e-12)


def test_at_first_an_arm_is_expected_to_follow_at_once():
    made = JointResponse.immediate(4, np.zeros(2), PERIOD).command(np.array([0.05, -0.05]))
    np.testing.assert_array_equal(made.flight(), 0.0)
    assert made.lead == 0.0


def test_the_response_is_the_regularised_least_squares_of_all_that_was_not_foreseen():
    rng, made, rows, answers = np.random.default_rng(0), JointResponse.immediate(3, np.zeros(1), PERIOD), [], []
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
    rho = 2e-4 * PERIOD * np.diag(np.exp(8.1 * PERIOD * np.arange(3)))
    expected = np.linalg.solve(U.T @ U + rho, U.T @ np.array(answers) + rho @ prior)
    assert (expected > 0.0).all()
    np.testing.assert_allclose(made.response, expected, rtol=1e-9)


def test_motions_of_overlapping_windows_are_fitted_together():
    """Windows of two periods: Δq and dq are sums over two periods, and each row counts half."""
    rng, prior, q, commands = np.random.default_rng(4), np.array([1.0, 0.0, 0.0]), [0.0, 0.0], [0.0] * 5
    made, rows, answers = JointResponse.immediate(3, np.zeros(1), PERIOD, window=2), [], []
    for _ in range(15):
        q.append(q[-1] + float(np.array([0.2, 0.5, 0.3]) @ commands[-1:-4:-1]) + 0.003 * rng.choice([-1.0, 1.0]))
        row = np.array([commands[-i] + commands[-i - 1] for i in (1, 2, 3)])
        if abs(q[-1] - q[-3] - made.response @ row) >= 0.01 * 2 * PERIOD:
            rows.append(row)
            answers.append(q[-1] - q[-3])
        made = made.learn(np.array([q[-1] - q[-3]]))
        commands.append(0.05 * rng.normal())
        made = made.command(np.array([commands[-1]]))
    U = np.array(rows)
    rho = 2e-4 * 4 * PERIOD * np.diag(np.exp(8.1 * PERIOD * np.arange(3)))
    expected = np.linalg.solve(U.T @ U / 2 + rho, U.T @ np.array(answers) / 2 + rho @ prior)
    np.testing.assert_allclose(made.response, expected, rtol=1e-9)


def identified(period, window, encoder_step=0.0):
    """Return true and found flight, (..., 3), and the found lead [s], at a delay and a lag of 0.05 s in closed form."""
    rng, count = np.random.default_rng(1), round(0.6 / period)
    true = JointResponse.given(0.05, 0.05, period, round(1.0 / period), np.zeros(3))
    made, q, past, flights = JointResponse.immediate(count, np.zeros(3), period, window), np.zeros(3), [], []
    goal = np.zeros(3)
    for k in range(round(6.0 / period)):
        reached = goal - true.flight()  # what is done of the commands up to now
        past.append(encoder_step * np.rint(reached / encoder_step) if encoder_step else reached)
        if k >= window:
            made = made.learn(past[-1] - past[-1 - window])
        if k * period > 3.0:
            flights.append([true.flight(), made.flight()])
        if k % round(0.2 / period) == 0:
            speed = rng.uniform(-1.0, 1.0, 3)
        q = q + 0.2 * (speed - q)
        goal, made, true = goal + q * period, made.command(q * period), true.command(q * period)
    wanted, found = np.moveaxis(flights, 1, 0)
    return wanted, found, made.lead * period


@pytest.mark.parametrize(
    ("period", "window"), [(0.05, 1), (0.02, 1), (0.02, 2), (0.008, 1), (0.008, 6), (0.004, 1), (0.004, 12)]
)
def test_the_flight_that_is_found_is_that_of_the_delayed_lag_at_every_rate(period, window):
    wanted, found, lead = identified(period, window)
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.1 * np.sqrt(np.mean(wanted**2))
    assert lead == pytest.approx(0.1, abs=0.012)


def test_a_window_sees_through_the_steps_of_encoders():
    """At 250 Hz and steps of 12 bits, a window of 0.05 s finds what is lost in windows of single periods."""
    wanted, found, lead = identified(0.004, 12, 2 * np.pi / 2**12)
    _, lost, _ = identified(0.004, 1, 2 * np.pi / 2**12)
    errors = [np.sqrt(np.mean((each - wanted) ** 2)) for each in (found, lost)]
    assert errors[0] < 0.15 * np.sqrt(np.mean(wanted**2)) < 0.5 * errors[1]
    assert lead == pytest.approx(0.1, abs=0.012)


def filter_at(feature, noise=0.001):
    """Return a filter that starts at a feature."""
    level = NoiseLevel.guess(noise)
    return FeatureFilter(np.asarray(feature, dtype=float), level.variance, level)


def test_the_filter_is_a_kalman_filter_by_hand():
    """σ = 0.1, c = 0.5, ‖Ĵ‖² = 5, ‖Δq‖² = 0.01, r² = 1e-8: p = 0.01 + 0.25·5·0.01/2 = 0.01625, z = 1.2 + L·0.1."""
    made = filter_at([1.0], 0.1).advance(np.array([[2.0, 1.0]]), np.array([0.1, 0.0]), 0.5, PERIOD)
    made = made.correct(np.array([1.3]), np.array([True]), False)
    p = 0.01625 + 1e-8
    np.testing.assert_allclose(made.feature, [1.2 + p / (p + 0.01) * 0.1])
    assert made.variance == pytest.approx(p * 0.01 / (p + 0.01))
    assert made.noise.variance == pytest.approx(0.01)


def test_a_motion_of_which_the_jacobian_sees_nothing_makes_the_filter_unsure_too():
    before = filter_at([0.0])
    made = before.advance(np.array([[1.0, 0.0]]), np.array([0.0, 0.1]), 0.2, PERIOD)
    np.testing.assert_array_equal(made.feature, [0.0])
    assert made.variance > 100.0 * before.variance


@pytest.mark.parametrize("noise", [0.001, 0.008])
def test_at_rest_the_filter_averages_and_without_a_frame_it_follows_the_joints(noise):
    rng, made, errors = np.random.default_rng(5), filter_at(np.zeros(3)), []
    for _ in range(900):
        made = made.advance(np.eye(3), np.zeros(3), 0.2, PERIOD).correct(
            rng.normal(scale=noise, size=3), np.full(3, True), True
        )
        errors.append(made.feature)
    assert np.sqrt(np.mean(np.square(errors[300:]))) < 1.3 * np.sqrt(0.5 * 1e-4 * noise)  # L = r/σ: σ √(L/2)
    after = made.advance(np.eye(3), np.array([0.01, 0.0, 0.0]), 0.2, PERIOD)
    np.testing.assert_allclose(after.feature, made.feature + [0.01, 0.0, 0.0])


def test_a_feature_that_is_not_seen_follows_the_joints_while_the_others_are_corrected():
    made = filter_at(np.zeros(2)).advance(np.array([[0.0], [0.5]]), np.array([0.2]), 0.2, PERIOD)
    made = made.correct(np.array([0.002, 9.0]), np.array([True, False]), True)
    assert 0.0 < made.feature[0] < 0.002
    assert made.feature[1] == pytest.approx(0.1)


def test_a_feature_far_off_restarts_the_filter():
    made = (
        filter_at(np.zeros(2))
        .advance(np.eye(2), np.zeros(2), 0.2, PERIOD)
        .correct(np.array([0.3, 0.1]), np.full(2, True), True)
    )
    np.testing.assert_array_equal(made.feature, [0.3, 0.1])
    assert made.variance == made.noise.variance


@pytest.mark.parametrize("period", [0.025, 0.01])
def test_in_motion_and_at_rest_the_filter_trusts_a_frame_alike_at_every_rate(period):
    """The variance after 0.05 s of motion or of rest, without a frame, does not depend on the control period."""
    for step in (0.02, 0.0):
        found = []
        for dt in (0.05, period):
            made = filter_at(np.zeros(2))
            for _ in range(round(0.05 / dt)):
                made = made.advance(np.eye(2), np.array([step, 0.0]) * dt / 0.05, 0.2, dt)
            found.append(made.variance)
        assert found[1] == pytest.approx(found[0], rel=1e-9)


class Seeing:
    """Pair, estimate and predict stages in front of a toy arm whose Jacobian is known."""

    def __init__(self, arm, delays=NO_DELAYS, **aids):
        config = AidsConfig(**aids)
        self.arm, self.stages = arm, Estimation(ConstantEstimator(), KNOWLEDGE, config, delays)
        self.predictor, self.look = Predictor(config, PERIOD, delays), arm.observe()
        self.estimation, self.state = self.stages.start(self.look, A), self.predictor.start(self.look)

    def predict(self):
        self.estimation = self.stages.update(self.estimation, self.look, np.zeros(M))
        pair, pairing = self.estimation.learned.pair, self.stages.pairing
        past = pairing.past(pair, self.look.joint_position, self.predictor.window)
        self.state, ahead, self.lead = self.predictor.predict(self.state, A, past, self.look)
        return ahead

    def send(self, step):
        self.state = self.predictor.note(self.state, step)
        self.look = self.arm.step(step / PERIOD)


@pytest.mark.parametrize("aids", [{"delay": "identified"}, {"delay": "given", "filter": True}], ids=["found", "given"])
def test_the_prediction_is_where_the_arm_ends_up_once_its_response_is_known(aids):
    arm, rng = ToyArm(np.eye(M), (0.0, 0.6, 0.4), latency=2), np.random.default_rng(0)
    made, joints = Seeing(arm, Delays(0.1, 0.0, 0.0), response="identified", model="nominal", **aids), []
    for k in range(60):
        bound = made.predict()
        if k > 30:
            np.testing.assert_allclose(bound.feature, arm.end(), atol=1e-3)
            assert np.linalg.norm(arm.end() - made.look.feature) > 3e-3
            assert made.lead == pytest.approx(1.4, abs=0.05)
            joints.append(A @ bound.joint_position - arm.end())
        made.send(0.05 * rng.uniform(-1.0, 1.0, N))
    np.testing.assert_allclose(joints, 0.0, atol=1e-3)


@pytest.mark.parametrize(("delay", "lag"), [(0.05, 0.05), (0.08, 0.03), (0.0, 0.1), (0.8, 0.0)])
def test_a_given_response_is_that_of_a_delayed_lag(delay, lag):
    """The arm is simulated by scipy in steps of a millisecond: once it rests it is where it was predicted to be."""
    rng, substeps = np.random.default_rng(2), 50
    made = Seeing(ToyArm(np.eye(M)), Delays(0.0, delay, lag), response="given")
    steps = np.concatenate([0.05 * rng.uniform(-1.0, 1.0, (30, N)), np.zeros((30, N))])
    held = np.repeat(steps / PERIOD, substeps, axis=0)
    late = np.concatenate([np.zeros((round(delay * 1000), N)), held])[: len(held)]
    time = 0.001 * np.arange(len(held) + 1)
    moved = np.zeros((len(time), N))
    for joint in range(N):
        if lag > 0.0:
            system = StateSpace([[-1.0 / lag, 0.0], [1.0, 0.0]], [[1.0 / lag], [0.0]], [[0.0, 1.0]], [[0.0]])
            u = np.append(late[:, joint], 0.0)
            A_, B_, C_, D_, _ = cont2discrete((system.A, system.B, system.C, system.D), 0.001)
            moved[:, joint] = dlsim((A_, B_, C_, D_, 0.001), u)[1][:, 0]
        else:
            moved[1:, joint] = np.cumsum(0.001 * late[:, joint])
    for k, step in enumerate(steps):
        q = moved[substeps * k]
        made.look = seen(q, A @ q, k=k)
        bound = made.predict()
        np.testing.assert_allclose(bound.joint_position, steps[:k].sum(axis=0), atol=1e-5)
        np.testing.assert_allclose(bound.feature, A @ steps[:k].sum(axis=0), atol=1e-5)
        assert made.lead * PERIOD == pytest.approx(delay + lag, abs=1e-6)
        made.state = made.predictor.note(made.state, step)
    np.testing.assert_allclose(moved[-1], steps.sum(axis=0), atol=1e-5)


def test_a_delay_that_is_found_to_be_another_restarts_the_filter_at_the_frame():
    made = Seeing(ToyArm(np.eye(M)), delay="identified", filter=True)
    for k in range(8):
        made.predict()
        made.send(np.full(N, 0.02 * (k + 1)))
    pair = made.estimation.learned.pair
    learned = made.estimation.learned._replace(pair=pair._replace(candidate=np.int_(3)))
    made.estimation = made.estimation._replace(learned=learned)
    made.look = seen(made.look.joint_position, np.array([0.5, 0.1, -0.2]), valid=False, k=8)
    pairing, at = made.stages.pairing, made.look.joint_position
    past = pairing.past(pairing.advance(learned.pair, at), at, 1)
    bound = made.predict()
    np.testing.assert_allclose(bound.feature, made.look.feature + A @ (at - past.exposed))
    assert made.state.delay == made.stages.pairing.delays[3]


def test_each_half_alone_makes_up_for_its_part():
    """`delay` brings the feature to the present, `response` to where the commands so far will lead."""
    rng = np.random.default_rng(0)
    made = {
        "delay": Seeing(ToyArm(np.eye(M), (0.0, 0.5, 0.5), 2), Delays(0.1, 0.0, 0.0), delay="given"),
        "response": Seeing(ToyArm(np.eye(M), (0.0, 0.5, 0.5)), NO_DELAYS, response="identified"),
    }
    for k in range(40):
        step = 0.05 * rng.uniform(-1.0, 1.0, N)
        for half, each in made.items():
            bound = each.predict()
            if k > 20:
                expected = each.arm.end() if half == "response" else A @ each.arm.q
                np.testing.assert_allclose(bound.feature, expected, atol=1e-3)
                assert (each.lead > 1.0) == (half == "response")
                np.testing.assert_array_equal(bound.joint_position == each.look.joint_position, half == "delay")
            each.send(step)


def test_the_shifted_reference_is_interpolated_and_goes_on():
    reference = np.array([[0.0], [1.0], [4.0], [5.0]])
    for lead, expected in ((0.0, [0.0, 1.0]), (1.5, [2.5, 4.5]), (2.25, [4.25, 5.25]), (7.5, [9.5, 10.5])):
        np.testing.assert_allclose(shifted(reference, np.array(lead), 2)[:, 0], expected)
    np.testing.assert_allclose(shifted(reference[:1], np.array(1.5), 1), [[0.0]])


def test_the_nominal_model_is_asked_only_where_a_stage_predicts_with_it():
    def count(**aids):
        asked = []
        knowledge = replace(KNOWLEDGE, nominal_jacobian=lambda q: asked.append(q) or A)
        estimation = Estimation(ConstantEstimator(), knowledge, AidsConfig(**aids), NO_DELAYS)
        state = estimation.start(seen(np.zeros(N), np.zeros(M)), A)
        estimation.update(state, seen(np.zeros(N), np.zeros(M), k=1), np.zeros(M))
        return len(asked)

    assert count(filter=True) == count(delay="given") == count(response="identified") == 0
    assert count(delay="identified") == count(noise="identified") == count(model="nominal") == 2
