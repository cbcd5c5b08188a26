"""Tests of the regression: batch least squares, likelihoods and means of joint Gaussians, quadratic features."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import softmax
from scipy.stats import multivariate_normal

from kit.toy import plant_spec
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.stages import regression as stage
from servobench.controllers.stages.regression import Regression, fresh_bank, interrupted, learn
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import stack, take

FRAME = 0.49  # σ²
N = 4
M = 3
PERIOD = 0.05
QUADRATIC = N + N * (N + 1) // 2  # columns of E and H
LOWER = np.array([-1.0, -0.5, 0.0, 0.2])
UPPER = np.array([1.0, 0.9, 0.8, 1.0])
KNOWLEDGE = RobotKnowledge(plant_spec(N, M), 0, region=(LOWER, UPPER))
TURN = Rotation.from_rotvec([0.4, -0.3, 1.5]).as_matrix()


def motions(count, m, seed=0):
    """Return regressors, motions of the feature, and the variances of the model."""
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(count, m)),
        0.6 * rng.normal(size=(count, m)),
        rng.uniform(0.1, 2.0, count),
    )


def learned(bank, h, dy, model, frame=FRAME, walk=0.0, learns=True):
    """Return one filter of a bank after one motion, and its innovation."""
    made, found = learn(
        bank[None],
        h[None],
        dy,
        np.float64(frame),
        np.array([model]),
        np.full((1, len(h)), walk),
        np.array([learns]),
    )
    return made[0], take(found, 0)


def filtered(x, dy, model, variance=0.7, frame=FRAME, **options):
    """Return the bank of one filter, with W = I at first, after motions, and its innovations."""
    size = x.shape[1]
    bank = fresh_bank(np.eye(size), np.full(size, variance), frame)
    found = []
    for k in range(len(x)):
        bank, innovation = learned(bank, x[k], dy[k], model[k], frame, **options)
        found.append(innovation)
    return bank, stack(found)


def moving_average(model, frame=FRAME):
    """Return the covariance of motions that share their frames."""
    n = len(model)
    return np.diag(2.0 * frame + model) - frame * (np.eye(n, k=1) + np.eye(n, k=-1))


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_the_filter_is_generalised_least_squares_around_the_prior(m):
    x, dy, model = motions(30, m)
    bank, found = filtered(x, dy, model)
    assert (found.variance == found.capped).all()
    prior = np.eye(m) / 0.7
    weighted = np.linalg.solve(moving_average(model), x)
    information = prior + x.T @ weighted
    np.testing.assert_allclose(np.linalg.inv(bank[m:-1, :-1]), information, rtol=1e-9, atol=1e-9)
    wanted = prior + dy.T @ weighted
    np.testing.assert_allclose(bank[:m, :m] @ information, wanted, atol=1e-9)


def test_the_noise_of_the_last_frame_is_its_mean_given_all_motions():
    """The frames' noise and W are jointly Gaussian with the motions; so is the covariance of W and e."""
    x, dy, model = motions(12, 2)
    bank, _ = filtered(x, dy, model)
    S = 0.7 * x @ x.T + moving_average(model)
    shared = FRAME * np.eye(12)[-1]  # covariance of the last frame's noise and the motions
    np.testing.assert_allclose(bank[:2, -1], shared @ np.linalg.solve(S, dy - x), atol=1e-12)
    assert bank[-1, -1] == pytest.approx(FRAME - shared @ np.linalg.solve(S, shared))
    np.testing.assert_allclose(bank[2:-1, -1], -0.7 * x.T @ np.linalg.solve(S, shared), atol=1e-12)
    np.testing.assert_allclose(bank[2:], bank[2:].T, rtol=1e-12)


def test_one_update_by_hand_and_every_filter_on_its_own():
    """s = 1 + 4·2² + 1 = 18 with P_ee = σ² = 1, gain = 4·2/18, ν = 5 − 2 = 3; the other sees x = 0 and s = 2."""
    bank = fresh_bank(np.ones((2, 1, 1)), np.array([4.0]), 1.0)
    args = (
        np.array([[2.0], [0.0]]),
        np.array([5.0]),
        np.float64(1.0),
        np.zeros(2),
        np.zeros((2, 1)),
        np.array([True]),
    )
    bank, found = learn(bank, *args)
    np.testing.assert_allclose(
        [found.square, found.variance, found.capped], [[9.0, 25.0], [18.0, 2.0], [18.0, 2.5]]
    )
    np.testing.assert_array_equal(found.frames, 2.0)
    np.testing.assert_allclose(bank[0], [[1.0 + 24.0 / 18.0, 3.0 / 18.0], [4.0 - 64.0 / 18.0, -8.0 / 18.0],
                                         [-8.0 / 18.0, 1.0 - 1.0 / 18.0]])  # fmt: skip
    # beyond the gate: s' = 25/10, σ'² = 1 + 0.5, e = 5 · 1.5/2.5, P_ee = 1.5 (1 − 1.5/2.5)
    np.testing.assert_allclose(bank[1], [[1.0, 3.0], [4.0, 0.0], [0.0, 0.6]])


def test_motions_that_do_not_count_teach_nothing_but_the_noise_of_their_frame():
    x, dy, model = motions(6, 2)
    bank, _ = filtered(x, dy, model)
    new, found = learned(bank, x[0], dy[0], model[0], learns=False)
    usual, same = learned(bank, x[0], dy[0], model[0])
    np.testing.assert_array_equal(new[:-1, :-1], bank[:-1, :-1])
    np.testing.assert_array_equal(new[:, -1], usual[:, -1])
    assert found.variance == same.variance


def test_without_the_last_frame_a_motion_begins_with_noise_of_which_nothing_is_known():
    x, dy, model = motions(8, 2)
    bank, _ = filtered(x, dy, model)
    cut = interrupted(bank, np.float64(2.0))
    np.testing.assert_array_equal(cut[:-1, :-1], bank[:-1, :-1])
    np.testing.assert_array_equal(cut[:, -1], [*np.zeros(4), 2.0])
    np.testing.assert_array_equal(cut[-1], [*np.zeros(2), 2.0])
    assert learned(cut, x[0], dy[0], model[0], 2.0)[1].frames == 2.0


class Walking:
    """A regression with the state of one run, and the motions that it got."""

    def __init__(self, knowledge=KNOWLEDGE, sigma=1e-3):
        self.stage = Regression(knowledge)
        self.frame = np.float64(sigma**2)
        self.state = self.stage.start((), sigma**2)
        self.seen = []

    def move(self, middle, step, x, dy):
        given = (middle, step, x, dy, np.float64(PERIOD))
        self.seen.append(given)
        h = self.stage.regressors(middle, step, x)
        self.state = self.stage.update(self.state, h, dy, np.float64(PERIOD), self.frame)
        return self

    def follow(self, count, feature, nominal, seed=0, shift=None, size=0.03):
        """Learn from motions through the region, of which `shift` (count, m) is added to the measured features."""
        rng = np.random.default_rng(seed)
        shift = np.sqrt(self.frame) * rng.normal(size=(count + 1, M)) if shift is None else shift
        for k in range(count):
            q = rng.uniform(LOWER, UPPER)
            step = size * rng.normal(size=N)
            dy = feature(q + step) - feature(q) + shift[k + 1] - shift[k]
            self.move(q + step / 2, step, nominal @ step, dy)
        return self

    def jacobian(self, q, nominal):
        return self.stage.jacobian(self.state, q, nominal)


NOMINAL = 0.5 * np.random.default_rng(1).normal(size=(M, N))


def quadratic(seed=3):
    """Return a feature that is quadratic in q, and its coefficients about the centre of the region."""
    rng = np.random.default_rng(seed)
    A = 0.3 * rng.normal(size=(M, N))
    B = 0.3 * rng.normal(size=(M, N, N))
    B = B + B.swapaxes(1, 2)

    def feature(q):
        r = q - (LOWER + UPPER) / 2
        return TURN @ NOMINAL @ q + A @ r + 0.5 * np.einsum("mjk,j,k->m", B, r, r)

    return feature, A, B[:, *np.triu_indices(N)]


def differences(feature, q, h=1e-5):
    return np.stack(
        [(feature(q + h * e) - feature(q - h * e)) / (2.0 * h) for e in np.eye(len(q))], axis=-1
    )


def test_a_feature_that_is_quadratic_in_the_joints_is_explained_exactly():
    feature, A, B = quadratic()
    run = Walking()
    rng = np.random.default_rng(4)
    run.state = run.state._replace(mean=np.concatenate([A, B, TURN, np.ones((M, 1))], axis=1))
    for _ in range(5):
        q = rng.uniform(LOWER, UPPER)
        step = rng.normal(size=N)
        np.testing.assert_allclose(run.jacobian(q, NOMINAL), differences(feature, q), atol=1e-9)
        explained = run.stage.explained(
            run.state, run.stage.regressors(q + step / 2, step, NOMINAL @ step)
        )
        np.testing.assert_allclose(explained, feature(q + step) - feature(q), atol=1e-12)


def regressors(middle, step, x):
    """Return [Δq, the products of r and Δq, x] with products as differences of r_j r_k, or of r_j²/2."""
    first, second = np.triu_indices(N)
    centre = (LOWER + UPPER) / 2
    begin = middle - step / 2 - centre
    end = middle + step / 2 - centre
    factors = np.where(first == second, 0.5, 1.0)
    products = (end[first] * end[second] - begin[first] * begin[second]) * factors
    return np.concatenate([step, products, x])


def test_the_weights_are_the_posterior_of_the_filters_given_all_motions(monkeypatch):
    """Each filter says that motions are jointly normal, with a covariance by prior, walk, model and frames."""
    for name, value in {"MODEL_ERROR": 0.1, "GATE": 1e9, "LEAD_CAP": 1e9}.items():
        monkeypatch.setattr(stage, name, value)
    run = Walking().follow(14, lambda q: 1.1 * NOMINAL @ q + [0.5 * q[0] * q[1], 0.0, 0.0], NOMINAL)
    H = np.array([regressors(*each[:3]) for each in run.seen])
    y = np.array([dy - x for *_, x, dy, _ in run.seen])
    lengths = np.linalg.norm(H[:, :N], axis=1)
    # Two motions share the walk up to the end of the first one.
    walked = np.minimum.outer(np.cumsum(lengths), np.cumsum(lengths))
    odds = -0.5 * stage.PRIOR
    for b, deviation in enumerate(stage.DEVIATIONS):
        prior = np.repeat([deviation, 1.0], (QUADRATIC, M)) ** 2
        walk = np.repeat([stage.WALK[b] * deviation, stage.MAP_TURN_WALKS[b]], (QUADRATIC, M)) ** 2
        S = moving_average(
            stage.REST_DRIFT**2 * PERIOD + (stage.MODEL_ERROR * lengths) ** 2, run.frame
        )
        S += H * prior @ H.T + walked * (H * walk @ H.T)
        odds[b] += multivariate_normal(np.zeros(14), S).logpdf(y.T).sum()
    np.testing.assert_allclose(run.stage.weights(run.state), softmax(odds), rtol=1e-6)
    assert run.stage.deviation(run.state) == pytest.approx(softmax(odds) @ stage.DEVIATIONS)
    assert 0.01 < softmax(odds)[2] < 0.99


def test_a_short_motion_changes_the_noise_of_the_frame_and_nothing_else():
    run = Walking(sigma=3e-3).follow(14, lambda q: NOMINAL @ q, NOMINAL)
    before = run.state
    shift = np.array([[0.0] * M, [0.004] * M])
    run.follow(1, lambda q: NOMINAL @ q, NOMINAL, size=1e-4, shift=shift)
    np.testing.assert_array_equal(run.state.bank[:, :-1, :-1], before.bank[:, :-1, :-1])
    np.testing.assert_array_equal(run.stage.weights(run.state), run.stage.weights(before))
    assert (run.state.mean[:, -1] > before.mean[:, -1]).all()


def test_maps_near_rotations_are_completed_and_all_else_moves_as_jointly_gaussian():
    """Given that M + N(0, ς²) is R, W has its conditional mean; R solves Wahba's problem by the axes of the weight."""
    run = Walking(sigma=3e-3).follow(6, lambda q: TURN @ NOMINAL @ q, NOMINAL)
    weights = softmax(-0.5 * run.state.scores)
    wanted = 0.0
    for b, bank in enumerate(run.state.bank):
        W = bank[:M]
        P = bank[M:]
        if b == len(stage.ROTATION_DEVIATIONS):
            wanted = wanted + weights[b] * W
            break
        C = np.eye(len(P))[QUADRATIC : QUADRATIC + M]
        believed = C @ P @ C.T + stage.ROTATION_DEVIATIONS[b] ** 2 * np.eye(M)
        values, axes = np.linalg.eigh(believed)
        R, _ = Rotation.align_vectors(axes.T @ (W @ C.T).T, axes.T, 1.0 / values)
        gain = np.linalg.solve(believed, C @ P)
        wanted = wanted + weights[b] * (W + (R.as_matrix() - W @ C.T) @ gain)
        if b == weights.argmax():
            np.testing.assert_allclose(run.state.rotation, R.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(run.state.mean, wanted, atol=1e-6)
    assert np.abs(run.state.mean[:, :QUADRATIC] - run.state.bank[0, :M, :QUADRATIC]).max() > 1e-5


def jumping(shift, count=60):
    """Return a run that knows a turned camera, and measures features shifted by `shift` (frames, m) from motion 40."""
    shifts = np.zeros((count + 1, M))
    shifts[41 : 41 + len(shift)] = shift[: count - 40]
    return Walking().follow(count, lambda q: TURN @ NOMINAL @ q, NOMINAL, shift=shifts)


@pytest.mark.parametrize("frames", [1, 2])
def test_outliers_go_into_the_noise_of_their_frames_and_leave_the_model_alone(frames):
    outliers = np.array([[0.3, -0.2, 0.1], [-0.2, 0.3, 0.2]])[:frames]
    run = jumping(outliers, 40 + frames)
    without = jumping(np.zeros((frames, M)), 40 + frames)
    np.testing.assert_allclose(run.state.mean[:, -1], outliers[-1], atol=0.03)
    assert run.state.share > 0.95 > 0.7 > without.state.share
    run = jumping(outliers)
    without = jumping(np.zeros((frames, M)))
    error = np.linalg.norm(without.jacobian(UPPER, NOMINAL) - TURN @ NOMINAL)
    assert (
        np.linalg.norm(run.jacobian(UPPER, NOMINAL) - without.jacobian(UPPER, NOMINAL))
        < error + 0.005
    )
    assert run.state.moves == without.state.moves == 0


def test_a_moved_camera_is_three_frames_that_fit_only_one_another_not_three_outliers():
    jump = np.full((20, M), 0.3)
    apart = 0.3 * np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
    moved = jumping(jump, 43)
    assert moved.state.moves == 1
    W = jumping(jump, 42).state.bank[..., :M, :-1]
    P0 = np.repeat(
        np.stack([stage.DEVIATIONS**2, np.ones_like(stage.DEVIATIONS)], axis=1),
        (QUADRATIC, M),
        axis=1,
    )
    np.testing.assert_allclose(moved.state.bank[:, :M, :-1], W, atol=0.05)
    np.testing.assert_array_equal(
        moved.state.bank[:, M:], [np.diag([*each, moved.frame]) for each in P0]
    )
    assert (jumping(jump, 42).state.moves, jumping(jump).state.moves) == (0, 1)
    assert jumping(jump[:2]).state.moves == jumping(apart).state.moves == 0


def test_a_covariance_that_is_singular_is_a_named_fault():
    run = Walking()
    bank = run.state.bank.copy()
    near = len(stage.ROTATION_DEVIATIONS)
    bank[:near, M + QUADRATIC : -1, QUADRATIC:-1] = -(
        stage.ROTATION_DEVIATIONS[:, None, None] ** 2
    ) * np.eye(M)
    run.state = run.state._replace(bank=bank)
    with pytest.raises(FilterDiverged, match="covariance of the map is singular"):
        run.move(LOWER, np.full(N, 0.1), np.zeros(M), np.zeros(M))
