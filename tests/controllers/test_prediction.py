"""Tests of the predict stage: the joints' response, the feature's filter, the shifted reference."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lsim

from kit.toy import KNOWLEDGE, PERIOD, A, M, N, ToyArm, seen
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.stages.estimation import Estimation
from servobench.controllers.stages.pairing import Past
from servobench.controllers.stages.prediction import (
    JointResponse,
    Predictor,
    shifted,
    with_response,
)
from servobench.controllers.stages.regression import REST_DRIFT

RESPONSE = np.array([0.0, 0.6, 0.3, 0.1])
NO_DELAYS = Delays(0.0, 0.0, 0.0)


def answered(response, steps=40, length=4, joints=3):
    """A JointResponse that has seen random commands and their answers; and the commands, the newest last."""
    rng = np.random.default_rng(3)
    made = JointResponse.immediate(length, np.zeros(joints), PERIOD)
    commands = [np.zeros(joints)] * len(response)
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


@pytest.mark.parametrize("window", [1, 2])
def test_the_response_is_the_regularised_least_squares_of_all_that_was_not_foreseen(window):
    """Over windows of two periods Δq and dq are sums over two periods, and each row counts half."""
    rng = np.random.default_rng(4)
    prior = np.array([1.0, 0.0, 0.0])
    q = [0.0] * window
    commands = [0.0] * 5
    made = JointResponse.immediate(3, np.zeros(1), PERIOD, window=window)
    rows = []
    answers = []
    for _ in range(15):
        q.append(
            q[-1]
            + float(np.array([0.2, 0.5, 0.3]) @ commands[-1:-4:-1])
            + 0.003 * rng.choice([-1.0, 1.0])
        )
        moved = q[-1] - q[-1 - window]
        row = sum(np.array(commands[-1 - k : -4 - k : -1]) for k in range(window))
        if abs(moved - made.response @ row) >= 0.01 * window * PERIOD:
            rows.append(row)
            answers.append(moved)
        made = made.learn(np.array([moved]))
        commands.append(0.05 * rng.normal())
        made = made.command(np.array([commands[-1]]))
    U = np.array(rows)
    rho = 2e-4 * window**2 * PERIOD * np.diag(np.exp(8.1 * PERIOD * np.arange(3)))
    expected = np.linalg.solve(
        U.T @ U / window + rho, U.T @ np.array(answers) / window + rho @ prior
    )
    assert (expected > 0.0).all()
    np.testing.assert_allclose(made.response, expected, rtol=1e-9)


def identified(period, window, encoder_step=0.0):
    """Return true and found flight, (..., 3), and the found lead [s], at a delay and a lag of 0.05 s in closed form."""
    rng = np.random.default_rng(1)
    count = round(0.6 / period)
    true = JointResponse.given(0.05, 0.05, period, round(1.0 / period), np.zeros(3))
    made = JointResponse.immediate(count, np.zeros(3), period, window)
    q = np.zeros(3)
    past = []
    flights = []
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
    ("period", "window"),
    [(0.05, 1), (0.02, 1), (0.02, 2), (0.008, 1), (0.008, 6), (0.004, 1), (0.004, 12)],
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


class Quadratic:
    """Pair and estimate stages of the feature y = (q₀², 2 q₁²), with the past of a motion."""

    def __init__(self, past, time):
        self.pairing = self
        self.kept = past
        pair = SimpleNamespace(base=self.ahead(None, NOW)[0])
        self.state = SimpleNamespace(
            learned=SimpleNamespace(pair=pair), last=SimpleNamespace(time=np.float64(time))
        )

    def past(self, pair, q, window):
        return self.kept

    def ahead(self, state, q):
        return np.diag([2.0, 4.0]) * q, np.diag([2.0, 4.0]) * q

    def motion(self, state, begin, joint_step, predicted):
        return at(begin + joint_step) - at(begin)


def predicted(past, look, feature, learned=True, share=None):
    """Return ŷ and z of a predictor with the filter, whose state held a feature z."""
    predictor = Predictor(AidsConfig(delay="given", filter=True), PERIOD, NO_DELAYS)
    predictor = predictor if share is None else predictor.frozen(share)
    state = predictor.start(look)._replace(feature=np.asarray(feature))
    stages = Quadratic(past, look.time - (not learned))
    state, ahead, _, J = predictor.predict(state, stages, stages.state, look)
    np.testing.assert_array_equal(J, np.diag([2.0, 4.0]) * look.joint_position)
    return ahead.feature, state.feature


def at(q):
    return np.array([q[0] ** 2, 2.0 * q[1] ** 2])


EXPOSED = np.array([0.5, -0.3])
BEFORE = np.array([0.1, 0.2])
NOW = np.array([0.9, 0.4])
MOVING = Past(
    EXPOSED, BEFORE, (np.zeros(2), np.zeros(2)), np.zeros(2), np.array([0.03, -0.02]), None
)


def test_the_noise_of_its_frame_is_taken_from_a_feature_that_was_learned_from():
    """Ĵ in the middle of a motion gives that of a quadratic feature exactly."""
    frame = at(EXPOSED) + MOVING.noise
    ahead, z = predicted(MOVING, seen(NOW, frame), at(EXPOSED - BEFORE) + 9.0)
    np.testing.assert_allclose(z, at(EXPOSED))
    np.testing.assert_allclose(ahead, at(NOW))


@pytest.mark.parametrize("missing", ["lost", "not learned from"])
def test_without_a_frame_the_feature_follows_the_joints_from_the_last_one(missing):
    look = seen(NOW, at(EXPOSED) + 0.7, valid=missing != "lost")
    ahead, z = predicted(MOVING, look, at(EXPOSED - BEFORE), learned=missing == "lost")
    np.testing.assert_allclose(z, at(EXPOSED))
    np.testing.assert_allclose(ahead, at(NOW))


def test_a_feature_that_is_not_seen_follows_the_joints_while_others_are_corrected():
    _, z = predicted(
        MOVING, seen(NOW, [0.8, 0.9], valid=np.array([True, False])), at(EXPOSED - BEFORE)
    )
    np.testing.assert_allclose(z, [0.8 - 0.03, at(EXPOSED)[1]])


def test_frozen_it_takes_a_share_of_what_it_did_not_expect():
    frame = at(EXPOSED) + [0.1, -0.2]
    _, z = predicted(MOVING, seen(NOW, frame), at(EXPOSED - BEFORE), learned=False, share=0.3)
    np.testing.assert_allclose(z, at(EXPOSED) + 0.7 * np.array([0.1, -0.2]))


class Seeing:
    """Pair, estimate and predict stages in front of a toy arm whose Jacobian is known."""

    def __init__(self, arm, delays=NO_DELAYS, **aids):
        config = AidsConfig(**aids)
        self.arm = arm
        self.stages = Estimation(ConstantEstimator(), KNOWLEDGE, config, delays)
        self.predictor = Predictor(config, PERIOD, delays)
        self.look = arm.observe()
        self.estimation = self.stages.start(self.look, A)
        self.state = self.predictor.start(self.look)

    def predict(self, noise=0.0):
        look = self.look.with_values(self.look.joint_position, self.look.feature + noise)
        self.estimation = self.stages.update(self.estimation, look, np.zeros(M))
        self.state, ahead, self.lead, _ = self.predictor.predict(
            self.state, self.stages, self.estimation, look
        )
        return ahead

    def send(self, step):
        self.state = self.predictor.note(self.state, step)
        self.look = self.arm.step(step / PERIOD)


@pytest.mark.parametrize("noise", [0.001, 0.008])
def test_at_rest_the_filter_averages(noise):
    """In the steady state z is noisy by σ √(L/2), with the share L = r √T / σ of each frame."""
    rng = np.random.default_rng(5)
    made = Seeing(ToyArm(np.eye(M)), noise="identified", filter=True)
    errors = []
    for _ in range(900):
        errors.append(made.predict(rng.normal(scale=noise, size=M)).feature)
        made.send(np.zeros(N))
    wanted = np.sqrt(0.5 * REST_DRIFT * np.sqrt(PERIOD) * noise)
    assert 0.6 * wanted < np.sqrt(np.mean(np.square(errors[300:]))) < 1.4 * wanted


def test_in_motion_the_filter_halves_the_noise_and_an_outlier_does_not_pass():
    found = []
    for filter_ in (True, False):
        rng = np.random.default_rng(6)
        errors = []
        made = Seeing(
            ToyArm(np.eye(M)), delay="given", noise="identified", model="regression", filter=filter_
        )
        for k in range(200):
            noise = rng.normal(scale=0.004, size=M)
            errors.append(
                made.predict(noise + (0.3 if k == 150 else 0.0)).feature - made.look.feature
            )
            made.send(0.01 * np.sin(0.1 * k + np.arange(N)))
        found.append(
            (
                np.sqrt(np.mean(np.square(errors[50:150]))),
                np.abs(errors[150]).max(),
                np.abs(errors[151]).max(),
            )
        )
    (filtered, outlier, after), (measured, whole, _) = found
    assert filtered < 0.5 * measured
    assert max(outlier, after) < 0.01 < 0.28 < whole


def test_frozen_at_rest_it_filters_as_it_did_when_it_learned():
    rng = np.random.default_rng(5)
    made = Seeing(ToyArm(np.eye(M)), filter=True)
    for _ in range(60):
        made.predict(rng.normal(scale=1e-3, size=M))
        made.send(np.zeros(N))
    still = made.predictor.frozen(float(made.estimation.learned.pair.regression.share))
    state = made.state
    for _ in range(10):
        frame = rng.normal(scale=1e-3, size=M)
        live = made.predict(frame).feature
        look = made.look.with_values(made.look.joint_position, frame)
        state, ahead, _, _ = still.predict(state, made.stages, made.estimation, look)
        np.testing.assert_allclose(ahead.feature, live, atol=1e-8)
        made.send(np.zeros(N))


@pytest.mark.parametrize(
    "aids", [{"delay": "identified"}, {"delay": "given", "filter": True}], ids=["found", "given"]
)
def test_the_prediction_is_where_the_arm_ends_up_once_its_response_is_known(aids):
    arm = ToyArm(np.eye(M), (0.0, 0.6, 0.4), latency=2)
    rng = np.random.default_rng(0)
    made = Seeing(arm, Delays(0.1, 0.0, 0.0), response="identified", model="nominal", **aids)
    joints = []
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
    rng = np.random.default_rng(2)
    substeps = 50
    made = Seeing(ToyArm(np.eye(M)), Delays(0.0, delay, lag), response="given")
    steps = np.concatenate([0.05 * rng.uniform(-1.0, 1.0, (30, N)), np.zeros((30, N))])
    held = np.repeat(steps / PERIOD, substeps, axis=0)
    late = np.pad(held, ((round(delay * 1000), 1), (0, 0)))[: len(held) + 1]
    response = [1.0], [lag, 1.0, 0.0] if lag > 0.0 else [1.0, 0.0]
    moved = np.stack(
        [lsim(response, u, 0.001 * np.arange(len(u)), interp=False)[1] for u in late.T], axis=-1
    )
    for k, step in enumerate(steps):
        q = moved[substeps * k]
        made.look = seen(q, A @ q, k=k)
        bound = made.predict()
        np.testing.assert_allclose(bound.joint_position, steps[:k].sum(axis=0), atol=1e-5)
        np.testing.assert_allclose(bound.feature, A @ steps[:k].sum(axis=0), atol=1e-5)
        assert made.lead * PERIOD == pytest.approx(delay + lag, abs=1e-6)
        made.state = made.predictor.note(made.state, step)
    np.testing.assert_allclose(moved[-1], steps.sum(axis=0), atol=1e-5)


def test_each_half_alone_makes_up_for_its_part():
    """`delay` brings the feature to the present, `response` to where the commands so far will lead."""
    rng = np.random.default_rng(0)
    made = {
        "delay": Seeing(
            ToyArm(np.eye(M), (0.0, 0.5, 0.5), 2), Delays(0.1, 0.0, 0.0), delay="given"
        ),
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
                np.testing.assert_array_equal(
                    bound.joint_position == each.look.joint_position, half == "delay"
                )
            each.send(step)


def test_the_shifted_reference_is_interpolated_and_goes_on():
    reference = np.array([[0.0], [1.0], [4.0], [5.0]])
    for lead, expected in (
        (0.0, [0.0, 1.0]),
        (1.5, [2.5, 4.5]),
        (2.25, [4.25, 5.25]),
        (7.5, [9.5, 10.5]),
    ):
        np.testing.assert_allclose(shifted(reference, np.array(lead), 2)[:, 0], expected)
    np.testing.assert_allclose(shifted(reference[:1], np.array(1.5), 1), [[0.0]])


@pytest.mark.parametrize(
    ("aids", "asked"), [({}, 1), ({"filter": True}, 4), ({"model": "regression"}, 4)]
)
def test_the_nominal_model_is_asked_at_the_start_and_once_a_period_by_the_pair_stage(aids, asked):
    places = []
    knowledge = replace(KNOWLEDGE, nominal_jacobian=lambda q: places.append(q) or A)
    estimation = Estimation(ConstantEstimator(), knowledge, AidsConfig(**aids), NO_DELAYS)
    state = estimation.start(seen(np.zeros(N), np.zeros(M)), A)
    for k in range(1, 4):
        state = estimation.update(state, seen(np.full(N, 0.1 * k), np.zeros(M), k=k), np.zeros(M))
    assert len(places) == asked
