"""Tests of nearest rotations, the damped inverse, the projection on the row space, and motion in the null space."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from servobench.controllers.algebra import damped_inverse, nearest_rotation, project_to_row_space


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


def damped_inverse_by_svd(J, damping):
    U, sigma, Vt = np.linalg.svd(J, full_matrices=False)
    return (Vt.T * (sigma / (sigma**2 + damping**2))) @ U.T


@pytest.mark.parametrize("smallest", [1.0, 1e-2, 1e-6, 1e-12, 0.0])
@pytest.mark.parametrize(("m", "n"), [(2, 4), (3, 6), (3, 3), (4, 2)])
def test_the_projection_is_that_of_the_pseudo_inverse_however_close_to_singular(m, n, smallest):
    rng = np.random.default_rng(7)
    size = min(m, n)
    left, right = (np.linalg.qr(rng.normal(size=(rows, size)))[0] for rows in (m, n))
    J = left * np.array([1.0] * (size - 1) + [smallest]) @ right.T
    kept = project_to_row_space(np.eye(n)[:, :, None], J)[:, :, 0]
    rows = right if smallest > 0.0 else right[:, :-1]
    # of J itself, which turns its weakest direction
    rounding = 1e-15 / smallest if smallest > 0.0 else 0.0
    np.testing.assert_allclose(kept, rows @ rows.T, atol=max(1e-9, rounding))


@settings(max_examples=100)
@given(seed=st.integers(0, 10**6), exponent=st.floats(-4.0, 8.0), damping=st.floats(1e-3, 1.0))
def test_the_damped_inverse_is_that_by_singular_values(seed, exponent, damping):
    J = 10.0**exponent * np.random.default_rng(seed).normal(size=(3, 6))
    wanted = damped_inverse_by_svd(J, damping)
    np.testing.assert_allclose(
        damped_inverse(J, damping), wanted, rtol=1e-7, atol=1e-7 * np.abs(wanted).max()
    )


def test_each_lane_is_inverted_by_the_formula_that_is_accurate_for_it():
    """An ordinary Jacobian beside a huge singular one, of which the normal equations have no solution."""
    ordinary = np.random.default_rng(4).normal(size=(2, 2))
    huge = 1e9 * np.ones((2, 2))
    both = damped_inverse(np.array([ordinary, huge, ordinary]), 0.02)
    for lane, single in enumerate((ordinary, huge, ordinary)):
        np.testing.assert_array_equal(both[lane], damped_inverse(single, 0.02))
    np.testing.assert_allclose(both[1], damped_inverse_by_svd(huge, 0.02), rtol=1e-6)
