"""Tests of the pair stage: it finds delay, Jacobian and noise at every rate, and knows a moved camera."""

import dataclasses

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator
from scipy.stats import multivariate_normal

from kit.toy import (
    KNOWLEDGE,
    NETWORK,
    PERIOD,
    SPEC,
    TURN,
    M,
    N,
    assert_lanes,
    late_features,
    path,
    seen,
)
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.stages import pairing
from servobench.controllers.stages.estimation import Estimation
from servobench.plant.contract.signals import Observation, trusted_observation

MAPPED = {"delay": "identified", "noise": "identified", "model": "regression"}


class Following:
    """Pair and estimate stages of an arm whose model is `NETWORK`, with the state of one run."""

    def __init__(self, period=PERIOD, latency=0.0, **aids):
        knowledge = dataclasses.replace(
            KNOWLEDGE,
            spec=dataclasses.replace(SPEC, period=period),
            nominal_jacobian=NETWORK.jacobian,
        )
        self.period = period
        self.k = 0
        self.state = None
        delays = Delays(latency, 0.0, 0.0)
        self.stages = Estimation(
            ConstantEstimator(), knowledge, AidsConfig(**{**MAPPED, **aids}), delays
        )

    def see(self, q, y, valid=True, captured=np.nan):
        look = self.last = Observation(self.k * self.period, q, y, valid, capture_time=captured)
        if self.state is None:
            self.state = self.stages.start(look, NETWORK.jacobian(q))
        self.state = self.stages.update(self.state, look, np.zeros(M))
        self.k += 1

    def follow(self, q, y, valid=None):
        for k in range(len(q)):
            self.see(q[k], y[k], valid is None or valid[k])
        return self

    @property
    def pair(self):
        return self.state.learned.pair

    @property
    def found(self):
        return self.stages.pairing.diagnostics(self.pair)

    def error(self, true):
        """Return the relative error of Ĵ."""
        return np.linalg.norm(self.state.jacobian - true) / np.linalg.norm(true)


@pytest.mark.parametrize(
    ("period", "latency"), [(0.1, 0.2), (0.05, 0.15), (0.008, 0.12), (0.004, 0.12), (0.004, 0.0)]
)
def test_the_latency_in_seconds_is_found_at_every_rate(period, latency):
    q = path(4.0, period)
    noise = 2e-4 * np.random.default_rng(0).normal(size=(len(q), M))
    made = Following(period).follow(q, late_features(q, TURN, round(latency / period)) + noise)
    assert made.found["delay"] == pytest.approx(latency, abs=1.5 * max(period, 0.25 / 24))
    assert made.found["map_rotation"] == pytest.approx(2.0 * np.pi / 3.0, abs=0.1)
    assert len(made.pair.scores) <= 25
    # The delay may lie between two candidates
    assert made.error(TURN @ NETWORK.jacobian(q[-1])) < 0.1


@pytest.mark.parametrize(("period", "latency"), [(0.05, 0.025), (0.05, 0.0875), (0.02, 0.05)])
def test_a_latency_between_two_periods_is_found(period, latency):
    fine = path(4.0, period / 8)
    parts = 8
    y = late_features(fine, TURN, round(parts * latency / period))[::parts]
    made = Following(period).follow(
        fine[::parts], y + 2e-4 * np.random.default_rng(0).normal(size=y.shape)
    )
    assert made.found["delay"] == pytest.approx(latency, abs=1.01 * pairing.RESOLUTION)
    assert made.error(TURN @ NETWORK.jacobian(fine[-1])) < 0.1


@pytest.mark.parametrize("latency", [0.0, 0.06, 0.1, 0.25])
def test_a_given_delay_is_used_as_it_is(latency):
    made = Following(latency=latency, delay="given")
    q = path(1.0)
    made.follow(q, late_features(q, TURN, 4))
    assert made.found["delay"] == pytest.approx(latency)
    exposed, before, moved, *_ = made.stages.pairing.past(made.pair, made.last, 1)
    at = len(q) - 1 - latency / PERIOD
    newest = int(np.ceil(round(at, 9)))  # of the three rows of a parabola
    wanted = []
    for back in (0, 1):
        rows = newest - back - np.arange(3)
        wanted.append(BarycentricInterpolator(rows, q[rows])(at - back))
    np.testing.assert_allclose(exposed, wanted[0], atol=1e-15)
    np.testing.assert_allclose(before, wanted[0] - wanted[1], atol=1e-15)
    motions = before, q[-1] - exposed
    for found, begin, motion in zip(moved, (exposed - before, exposed), motions, strict=True):
        J = NETWORK.jacobian(begin + 0.5 * motion)
        np.testing.assert_allclose(found, J @ motion, atol=0.02 * np.linalg.norm(motion))


def test_the_scores_of_the_delays_are_their_likelihoods(monkeypatch):
    """At each delay the motions are jointly normal, with a covariance by prior, walks, model and frames."""
    monkeypatch.setattr(pairing, "RESOLUTION", PERIOD)
    rng = np.random.default_rng(4)
    sigma = 0.025
    count = 10
    q = np.concatenate([np.zeros((1, N)), np.cumsum(rng.choice([-0.03, 0.03], (count, N)), axis=0)])
    y = late_features(q, np.eye(M), 1) + sigma * rng.normal(size=(count + 1, M))
    made = Following(
        noise="given", feature_noise=sigma, longest_delay=0.2, delay_margin=0.0
    ).follow(q, y)
    J = NETWORK.jacobian(q)
    dq = np.diff(q, axis=0)
    wanted = []
    x = np.matvec((J[1:] + J[:-1]) / 2.0, dq)
    for d in range(5):
        H = np.concatenate([np.zeros((d, M + N)), np.hstack([x, dq])[: count - d]])
        lengths = np.linalg.norm(H[:, :M], axis=1)
        turns = np.linalg.norm(H[:, M:], axis=1)
        assert (lengths[d:] > sigma).all()
        S = sigma**2 * (2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
        S += (
            np.diag((pairing.UNEXPLAINED_SHARE * lengths) ** 2)
            + pairing.MAP_DEVIATION**2 * H[:, :M] @ H[:, :M].T
        )
        S += pairing.REST_DEVIATION**2 * H[:, M:] @ H[:, M:].T
        for part, walk, way in (
            (H[:, :M], pairing.MAP_LENGTH_WALK, lengths),
            (H[:, M:], pairing.REST_WALK, turns),
        ):
            S += walk**2 * np.minimum.outer(np.cumsum(way), np.cumsum(way)) * (part @ part.T)
        misses = np.diff(y, axis=0) - H[:, :M]
        density = multivariate_normal(np.zeros(count), S).logpdf(misses.T).sum()
        wanted.append(-2.0 * density)
    np.testing.assert_allclose(
        made.pair.scores - made.pair.scores[0], np.array(wanted) - wanted[0], rtol=1e-6
    )
    assert made.pair.candidate == np.argmin(wanted) == 1


@pytest.mark.parametrize("sigma", [3e-4, 0.002, 0.02])
def test_the_noise_is_found(sigma):
    q = 0.1 * path(15.0)  # so slow that the error that a model may have does not hide the noise
    y = late_features(q, TURN, 1) + sigma * np.random.default_rng(4).normal(size=(len(q), M))
    assert 0.7 < Following().follow(q, y).found["noise_level"] / sigma < 1.4


@pytest.mark.parametrize(("memory", "kept"), [(1.0, True), (0.97, False)])
def test_on_a_steady_circle_the_delay_is_kept_as_its_beginning_showed_it(memory, kept):
    """There a delay and a turn of the map explain the same, so that the latest motions say nothing of it."""
    angle = np.cumsum(0.05 * np.minimum(1.0, np.arange(401) / 5.0))[:, None]
    a, b = np.random.default_rng(3).normal(scale=0.5, size=(2, N))
    q = (np.cos(angle) - 1.0) * a + np.sin(angle) * b
    J = np.random.default_rng(0).normal(size=(M, N))
    late = np.concatenate([q[:1], q[:-1]])
    y = late @ J.T + np.random.default_rng(1).normal(scale=0.0004, size=(401, M))
    made = Following(score_memory=memory)
    delays = []
    made.stages._nominal = lambda position: np.broadcast_to(J, (*np.shape(position)[:-1], M, N))
    for k in range(401):
        made.see(q[k], y[k])
        delays.append(round(made.found["delay"] / PERIOD))
    assert (set(delays[30:]) == {1}) == kept


def test_lost_frames_do_not_mislead_jacobian_and_delay():
    q = path(6.0)
    rng = np.random.default_rng(3)
    made = Following().follow(q, late_features(q, TURN, 2), rng.random(len(q)) < 0.5)
    assert made.found["delay"] == pytest.approx(2 * PERIOD, abs=1.01 * pairing.RESOLUTION)
    assert made.error(TURN @ NETWORK.jacobian(q[-1])) < 0.1


@pytest.mark.parametrize("false", [[12], [12, 13, 14, 15], [12, 17, 18, 19, 26]])
def test_false_frames_count_as_lost_once_the_next_true_one_is_seen(false):
    q = path(1.6)
    y = late_features(q, np.eye(M), 0)
    valid = np.full(len(q), True)
    y += 5e-4 * np.random.default_rng(5).normal(size=y.shape)
    valid[false] = False
    lost = Following(noise="given", feature_noise=5e-4).follow(q, y, valid)
    y[false] += np.array([0.3, -0.1, 0.2])
    made = Following(noise="given", feature_noise=5e-4).follow(q, y)
    for now, wanted in ((made.pair, lost.pair), (made.pair.regression, lost.pair.regression)):
        np.testing.assert_allclose(now.bank, wanted.bank, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(now.scores, wanted.scores, rtol=1e-9)


def test_the_fifth_false_frame_in_a_row_is_believed():
    q = path(1.6)
    y = late_features(q, np.eye(M), 0) + np.where(np.arange(len(q)) < 12, 0.0, 0.3)[:, None]
    doubted = []
    made = Following(noise="given", feature_noise=5e-4).follow(q[:12], y[:12])
    for k in range(12, 17):
        made.see(q[k], y[k])
        doubted.append(bool(made.pair.anchor.miss > 0.0))
    assert doubted == [True] * 4 + [False]


def test_a_frame_that_another_delay_explains_is_not_taken_for_a_false_one():
    q = path(1.6)
    y = late_features(q, np.eye(M), 0)
    made = Following(noise="given", feature_noise=5e-4).follow(q[:24], y[:24])
    before = made.pair.anchor.miss
    made.see(q[24], y[21])  # it comes three periods late
    assert np.linalg.norm(y[24] - y[21]) > 0.02
    assert before == made.pair.anchor.miss == 0.0
    made.see(q[25], y[25] + 0.1)
    assert made.pair.anchor.miss > 0.0


@pytest.mark.parametrize("period", [0.05, 0.008])
def test_after_a_gap_that_is_longer_than_the_memory_nothing_is_learned_from_it(period):
    q = path(5.0, period)
    y = late_features(q, TURN, 0)
    valid = np.full(len(q), True)
    lost = slice(round(2.0 / period), round(4.0 / period))
    valid[lost] = False
    made = Following(period).follow(q[: lost.stop], y[: lost.stop], valid)
    before = made.pair
    made.see(q[lost.stop], y[lost.stop] + 0.3)
    for now, then in (
        (made.pair.bank, before.bank),
        (made.pair.regression.bank, before.regression.bank),
    ):
        np.testing.assert_array_equal(now[:, :-1, :-1], then[:, :-1, :-1])
        assert not now[:, :-1, -1].any()  # the noise of the frame before the gap is in no motion
    made.follow(q[lost.stop + 1 :], y[lost.stop + 1 :] + 0.3)
    assert made.found["camera_moves"] == 0
    assert made.error(TURN @ NETWORK.jacobian(q[-1])) < 0.1


def test_a_jump_is_no_motion_and_after_three_frames_any_map_is_possible_again():
    q = path(1.6)
    made = Following()
    y = late_features(q, np.eye(M), 0)
    moves = []
    made.follow(q[:30], y[:30])
    before = made.state.jacobian
    known = made.pair.bank[:, M:-1, :-1]
    for k in range(30, 33):
        made.see(q[k], y[k] + 0.3)
        moves.append(int(made.found["camera_moves"]))
    assert moves == [0, 0, 1]
    assert np.linalg.norm(made.state.jacobian - before) < 0.15 * np.linalg.norm(before)
    prior = np.diag([pairing.MAP_DEVIATION**2] * M + [pairing.REST_DEVIATION**2] * N)
    np.testing.assert_array_equal(made.pair.bank[:, M:-1, :-1], np.broadcast_to(prior, known.shape))
    assert (np.trace(known, axis1=1, axis2=2) < 0.8 * np.trace(prior)).all()


def test_a_camera_turned_without_a_jump_is_known_by_motions_that_it_cannot_explain():
    """The camera turns about the ball itself: only motions show it."""
    q = path(4.5)
    noise = np.random.default_rng(2).normal(scale=1e-4, size=(len(q), M))
    before = late_features(q, np.eye(M), 0)
    after = late_features(q, TURN, 0)
    y = np.concatenate([before[:61], after[61:] - after[60] + before[60]]) + noise
    made = Following(delay="given").follow(q[:61], y[:61])
    made.follow(q[61:72], y[61:72])
    assert made.found["camera_moves"] >= 1
    assert made.error(TURN @ NETWORK.jacobian(q[71])) < 0.3


def test_the_delay_is_found_where_the_jacobian_is_only_the_nominal_one():
    q = path(2.0)
    made = Following(model="nominal").follow(q, late_features(q, np.eye(M), 3))
    assert made.found["delay"] == pytest.approx(3 * PERIOD)
    np.testing.assert_array_equal(made.state.jacobian, NETWORK.jacobian(q[-1]))


def test_a_model_wrong_by_more_than_a_map_hides_neither_the_delay_nor_the_noise(monkeypatch):
    """Two columns of the Jacobian differ: without E what a map leaves passes for noise."""
    rows = NETWORK.weights.copy()
    rows[-2:] *= -0.5
    q = path(4.0, seed=2)
    levels = []
    y = late_features(q, TURN, 2, dataclasses.replace(NETWORK, weights=rows))
    y = y + 2e-4 * np.random.default_rng(2).normal(size=y.shape)
    for deviation, walk in ((pairing.REST_DEVIATION, pairing.REST_WALK), (1e-9, 0.0)):
        monkeypatch.setattr(pairing, "REST_DEVIATION", deviation)
        monkeypatch.setattr(pairing, "REST_WALK", walk)
        made = Following().follow(q, y)
        assert made.found["delay"] / PERIOD == pytest.approx(2.0, abs=0.51)
        levels.append(made.found["noise_level"])
    assert levels[0] < 4e-4 < 1e-3 < levels[1]


def test_a_feature_that_is_not_seen_teaches_nothing_whatever_its_last_frame_was():
    """The second feature is lost for a while, after a frame that was an outlier or not: the model hardly differs."""
    q = path(3.0)
    found = []
    for outlier in (0.0, 0.3):
        y = late_features(q, TURN, 0)
        made = Following(delay="given", noise="given", feature_noise=3e-4)
        y[30, 1] += outlier
        for k in range(len(q)):
            made.see(q[k], y[k], np.array([True, not 30 < k < 40, True]))
        found.append((made.state.jacobian, made.pair.bank[0, :M, :M]))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=0.01)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=0.1)


def test_given_noise_is_not_identified():
    stage = pairing.Pairing(AidsConfig(filter=True), KNOWLEDGE, 0.0)
    q = np.full(N, 0.01)
    J = np.ones((M, N))
    first = stage.start(seen(np.zeros(N), np.zeros(M)), J)
    state = stage.advance(first, q, J)
    look = seen(q, np.full(M, 0.06))
    after, paired = stage.learn(state, np.full(M, 0.06), np.float64(PERIOD), np.full(M, True), look)
    np.testing.assert_array_equal(after.noise.variance, state.noise.variance)
    assert stage.noise(state) is None
    np.testing.assert_allclose(paired.joint_step, 0.01)
    np.testing.assert_allclose(paired.predicted, 0.05)


PARTS = 25  # of a period, of which the lateness of frames is a multiple


def late_run(parts, *, stamps, offset=50.0, **aids):
    """Return stages that followed an arm whose frames are late by so many parts (k,), and its fine path."""
    count = len(parts)
    fine = path(count * PERIOD, PERIOD / PARTS)
    features = late_features(fine, TURN)
    made = Following(**aids)
    for k in range(count):
        exposed = PARTS * k - parts[k]
        captured = exposed * PERIOD / PARTS + offset if stamps else np.nan
        made.see(fine[PARTS * k], features[max(exposed, 0)], captured=captured)
    return made, fine


def jittering(count, seed=2):
    """Return parts of a period by which frames are late: two periods, and up to four more."""
    parts = np.random.default_rng(seed).integers(2 * PARTS, 6 * PARTS, count)
    parts[0] = 2 * PARTS
    return parts


def test_with_stamps_the_joints_at_exposure_are_found_however_the_latency_jitters(monkeypatch):
    """Those between two periods are those of a parabola, exactly."""
    monkeypatch.setattr(pairing, "DRIFT_STEP", 0.0)
    parts = jittering(40)
    made, fine = late_run(parts, stamps=True, delay="given", latency=2 * PERIOD)
    late = made.stages.pairing.past(made.pair, made.last, 1).late
    at = 39 - parts[-1] / PARTS
    rows = int(np.ceil(at)) - np.arange(3)
    wanted = BarycentricInterpolator(rows, fine[PARTS * rows])(at)
    np.testing.assert_allclose(late.begin, wanted, atol=1e-12)
    np.testing.assert_allclose(wanted, fine[round(PARTS * at)], atol=2e-3)
    np.testing.assert_allclose(late.begin + late.joint_step, fine[37 * PARTS], atol=1e-12)
    # The last motion is paired with that between the exposures of its frames.
    end = made.stages.pairing._candidates.ends(made.pair.past, made.pair.late / PERIOD)
    np.testing.assert_allclose(end[0, :N], wanted, atol=1e-12)


def test_with_stamps_a_jittering_latency_does_no_harm_whatever_the_clock_shows():
    parts = jittering(80)
    errors = []
    for stamps, offset in ((False, 0.0), (True, 0.0), (True, -1e4)):
        made, fine = late_run(parts, stamps=stamps, offset=offset, longest_delay=0.4)
        errors.append(made.error(TURN @ NETWORK.jacobian(fine[79 * PARTS])))
    assert errors[1] < 0.1
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] == pytest.approx(errors[1], rel=1e-3)
    # The delay is the latency of the first frame.
    assert made.found["delay"] == pytest.approx(2 * PERIOD, abs=1.01 * pairing.RESOLUTION)


def test_a_clock_that_drifts_is_followed_and_one_that_is_set_begins_anew():
    late = pairing.Lateness(np.float64(np.nan), np.float64(0.0)).next(np.float64(7.0))
    assert (late.age, late.last) == (7.0, 0.0)
    assert late.next(np.float64(7.2)).last == pytest.approx(0.2)
    drifting = late
    for k in range(1000):
        drifting = drifting.next(np.float64(7.0 + 0.9 * pairing.DRIFT_STEP * k))
    assert drifting.last == pytest.approx(0.0, abs=pairing.DRIFT_STEP)
    gap = late.next(np.float64(np.nan))
    assert (gap.age, gap.last) == (7.0, 0.0)
    anew = late.next(np.float64(3600.0))
    assert (anew.age, anew.last) == (3600.0, 0.0)


def test_stages_with_stamps_have_the_same_bits_in_lanes():
    lateness = 0.1 + 0.15 * np.random.default_rng(3).random((3, 30))
    q = np.stack([path(1.5, seed=1 + lane)[:30] for lane in range(3)])
    y = np.stack([late_features(q[lane], TURN, 2) for lane in range(3)])

    def run(lanes):
        made = Following()
        for k in range(30):
            valid = np.ones((*np.shape(lanes), M), dtype=np.bool_)
            look = trusted_observation(
                k * PERIOD,
                q[lanes, k],
                y[lanes, k],
                valid.all(axis=-1),
                valid,
                k * PERIOD - lateness[lanes, k],
            )
            if made.state is None:
                made.state = made.stages.start(look, NETWORK.jacobian(q[lanes, 0]))
            made.state = made.stages.update(made.state, look, np.zeros(M))
        return {"J": made.state.jacobian, "delay": made.found["delay"]}

    assert_lanes(run)
