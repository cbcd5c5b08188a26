"""Tests of the map's filter: batch least squares, rotations by another library, what two known directions tell."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from servobench.controllers.algebra import nearest_rotation
from servobench.controllers.stages.feature_map import fresh_bank, map_update, near_rotation
from servobench.plant.contract.faults import FilterDiverged

FRAME = 0.49  # σ²


def motions(count, m, seed=0):
    """Return steps x of at least σ, what was seen, and the variances of the model."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, m))
    x *= (rng.uniform(1.01, 4.0, count) * np.sqrt(FRAME) / np.linalg.norm(x, axis=1))[:, None]
    return x, rng.normal(size=(count, m)), rng.uniform(0.1, 2.0, count)


def filtered(x, dy, model, P0, frame=FRAME):
    """Return the bank of one candidate after motions, and ‖ν‖²/s and s of each."""
    bank, found = fresh_bank(np.eye(len(P0)), P0, frame)[None], []
    for k in range(len(x)):
        bank, *both = map_update(bank, x[k][None], dy[k], np.array([frame]), model[k : k + 1])
        found.append([each.item() for each in both])
    return bank[0], np.array(found)


def moving_average(model, frame=FRAME):
    """Return the covariance of motions that share their frames."""
    n = len(model)
    return np.diag(2.0 * frame + model) - frame * (np.eye(n, k=1) + np.eye(n, k=-1))


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_the_filter_is_generalised_least_squares_around_the_first_map(m):
    x, dy, model = motions(30, m)
    P0, weight = 0.7 * np.eye(m), np.linalg.inv(moving_average(model))
    bank, _ = filtered(x, dy, model, P0)
    information = np.linalg.inv(P0) + x.T @ weight @ x
    np.testing.assert_allclose(np.linalg.inv(bank[m:-1, :-1]), information, rtol=1e-9)
    np.testing.assert_allclose(bank[:m, :m] @ information, np.linalg.inv(P0) + dy.T @ weight @ x, atol=1e-9)


def test_the_scores_are_the_likelihood_of_the_motions():
    """Under M ~ N(I, P₀) the steps of an axis are normal with the covariance X P₀ Xᵀ + that of the frames."""
    x, dy, model = motions(25, 2)
    _, found = filtered(x, dy, model, 0.7 * np.eye(2))
    score = found[:, 0].sum() + 2.0 * np.log(found[:, 1]).sum() + 2.0 * 25 * np.log(2.0 * np.pi)
    covariance = 0.7 * x @ x.T + moving_average(model)
    density = sum(multivariate_normal(x[:, axis], covariance).logpdf(dy[:, axis]) for axis in range(2))
    np.testing.assert_allclose(score, -2.0 * density, rtol=1e-12)


def test_one_update_by_hand_and_every_candidate_on_its_own():
    """s = 1 + 4·2² + 1 = 18 with P_ee = σ² = 1, gain = 4·2/18, ν = 5 − 2 = 3; the other sees x = 0 and s = 2."""
    bank = np.stack([fresh_bank(np.eye(1), np.array([[4.0]]), 1.0)] * 2)
    bank, surprise, s = map_update(bank, np.array([[2.0], [0.0]]), np.array([5.0]), np.ones(1), np.zeros(2))
    np.testing.assert_allclose(surprise, [9.0 / 18.0, 25.0 / 2.0])
    np.testing.assert_allclose(s, [18.0, 2.0])
    np.testing.assert_allclose(bank[0], [[1.0 + 24.0 / 18.0, 3.0 / 18.0], [4.0 - 64.0 / 18.0, -8.0 / 18.0],
                                         [-8.0 / 18.0, 1.0 - 1.0 / 18.0]])  # fmt: skip
    np.testing.assert_allclose(bank[1], [[1.0, 2.5], [4.0, 0.0], [0.0, 0.5]])


def test_steps_shorter_than_the_noise_are_considered_and_teach_nothing_of_the_map():
    """A law that undoes a slow drift of the feature makes steady short steps in which nothing is seen to move."""
    rng, x = np.random.default_rng(6), np.full((400, 1), 0.05)
    dy = np.diff(np.sqrt(FRAME) * rng.normal(size=401))[:, None]
    bank, _ = filtered(x, dy, np.full(400, 1e-4), 0.01 * np.eye(1))
    assert (bank[0, 0], bank[1, 0]) == (1.0, 0.01)
    longer = np.sqrt(FRAME) / 0.05 * 1.01
    learned, _ = filtered(longer * x, longer * x + dy, np.full(400, 1e-4), 0.01 * np.eye(1))
    assert learned[1, 0] < 1e-4


def test_a_motion_that_answers_to_noise_does_not_pass_for_its_cause():
    """The arm moves by r − g e(k−1) after frame k − 1; frame k shows the motion before. Variance alone says 0."""
    rng, gain, count = np.random.default_rng(5), 0.5, 600
    e = rng.normal(size=count + 2)
    moved = np.sin(0.1 * np.arange(count + 1)) - gain * e[:-1]  # after frame k − 1 was seen
    dy = moved[:-1] + np.diff(e)[1 : count + 1]
    candidates = {0: moved[1:], 1: moved[:-1]}
    assert np.var(dy - candidates[0]) < np.var(dy - candidates[1])
    scores = {}
    for delay, x in candidates.items():
        _, found = filtered(x[:, None], dy[:, None], np.zeros(count), 1e-9 * np.eye(1), frame=1.0)
        scores[delay] = found[:, 0].sum() + np.log(found[:, 1]).sum()
    assert scores[1] < scores[0] - 20.0


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6))
def test_the_nearest_rotation_is_that_of_wahbas_problem(seed):
    M = np.random.default_rng(seed).normal(size=(3, 3))
    R, _ = Rotation.align_vectors(M.T, np.eye(3))  # Σ ‖M e_i − R e_i‖²
    np.testing.assert_allclose(nearest_rotation(M), R.as_matrix(), atol=1e-6)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_the_nearest_rotation_is_proper_and_no_other_is_nearer(m):
    rng = np.random.default_rng(m)
    for _ in range(20):
        M = rng.normal(size=(m, m))
        R = nearest_rotation(M)
        np.testing.assert_allclose(R.T @ R, np.eye(m), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        skew = 0.01 * rng.normal(size=(m, m))
        other = R @ np.linalg.qr(np.eye(m) + skew - skew.T)[0]
        other *= np.sign(np.linalg.det(other)) if m % 2 else 1.0
        assert np.vdot(R, M) >= np.vdot(nearest_rotation(other), M) - 1e-12


def test_two_known_directions_of_a_rotation_give_the_third():
    R = Rotation.from_rotvec([0.4, -0.3, 2.0]).as_matrix()
    x = np.array([[0.03, 0.0, 0.01], [0.0, 0.02, -0.02]])
    bank, _ = filtered(x, x @ R.T, np.full(2, 1e-10), np.eye(3), frame=1e-12)
    M, P = bank[:3, :3], bank[3:-1, :-1]
    unknown = np.cross(*x) / np.linalg.norm(np.cross(*x))
    assert np.linalg.norm(M @ unknown - R @ unknown) > 0.5
    completed, rotation = near_rotation(M, P, 0.2)
    np.testing.assert_allclose(rotation, R, atol=0.05)
    np.testing.assert_allclose(completed @ unknown, R @ unknown, atol=0.1)
    np.testing.assert_allclose(near_rotation(M, P, 0.0)[1], R, atol=1e-3)


def test_what_is_known_of_a_map_stays_and_what_is_not_comes_from_the_rotation():
    rng = np.random.default_rng(4)
    M, root = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    P = root @ root.T
    completed, R = near_rotation(M, P, 0.5)
    inverse = np.linalg.inv(P + 0.25 * np.eye(3))
    np.testing.assert_allclose(completed, M + (R - M) @ P @ inverse, atol=1e-9)
    np.testing.assert_allclose(R, nearest_rotation(M @ inverse), atol=1e-9)
    np.testing.assert_allclose(near_rotation(M, 1e-9 * np.eye(3), 0.5)[0], M, atol=1e-7)
    same, rotation = near_rotation(M, P, 0.0)
    np.testing.assert_array_equal(same, rotation)


def test_a_covariance_that_is_none_is_a_named_fault():
    with pytest.raises(FilterDiverged, match="covariance of the map is not positive definite"):
        near_rotation(np.eye(2), -np.eye(2), 0.1)
