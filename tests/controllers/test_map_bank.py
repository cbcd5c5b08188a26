"""Tests of the map's filter: batch least squares, rotations by another library, what two known directions tell."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from servobench.controllers.rotation import nearest_rotation
from servobench.controllers.stages.map_bank import map_update, near_rotation
from servobench.plant.faults import FilterDiverged


def motions(count, m, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, m)), rng.normal(size=(count, m)), rng.uniform(0.1, 2.0, count)


def filtered(x, dy, r, P0):
    m = len(P0)
    bank = np.concatenate([np.eye(m), P0])[None]
    for k in range(len(x)):
        bank, surprise, s = map_update(bank, x[k][None], dy[k], r[k : k + 1])
    return bank[0, :m], bank[0, m:], surprise, s


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_the_filter_is_batch_least_squares_around_the_first_map(m):
    x, dy, r = motions(30, m)
    P0 = 0.7 * np.eye(m)
    M, P, _, _ = filtered(x, dy, r, P0)
    information = np.linalg.inv(P0) + (x.T / r) @ x
    np.testing.assert_allclose(np.linalg.inv(P), information, rtol=1e-9)
    np.testing.assert_allclose(M @ information, np.linalg.inv(P0) + (dy.T / r) @ x, atol=1e-9)


def test_without_a_prior_worth_the_name_the_filter_is_the_least_squares_of_numpy():
    x, dy, _ = motions(40, 3)
    M, _, _, _ = filtered(x, dy, np.ones(40), 1e9 * np.eye(3))
    np.testing.assert_allclose(M, np.linalg.lstsq(x, dy, rcond=None)[0].T, atol=1e-6)


def test_one_update_by_hand_and_every_candidate_on_its_own():
    """s = 1 + 4·2² = 17, gain = 4·2/17, ν = 5 − 2 = 3: M = 1 + 24/17, P = 4 − 64/17; the other sees x = 0."""
    bank = np.array([[[1.0], [4.0]], [[1.0], [4.0]]])
    bank, surprise, s = map_update(bank, np.array([[2.0], [0.0]]), np.array([5.0]), np.ones(2))
    np.testing.assert_allclose(bank[:, 0, 0], [1.0 + 24.0 / 17.0, 1.0])
    np.testing.assert_allclose(bank[:, 1, 0], [4.0 - 64.0 / 17.0, 4.0])
    np.testing.assert_allclose(surprise, [9.0 / 17.0, 25.0])
    np.testing.assert_allclose(s, [17.0, 1.0])


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
    M, P, _, _ = filtered(x, x @ R.T, np.full(2, 1e-10), np.eye(3))
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
