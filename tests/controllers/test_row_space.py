"""Tests of the projection on the row space of the Jacobian."""

import numpy as np
import pytest

from servobench.controllers.laws.row_space import project_to_row_space


def test_the_projection_keeps_what_moves_the_feature_and_nothing_else():
    rng = np.random.default_rng(5)
    J, W = rng.normal(size=(2, 4)), rng.normal(size=(4, 3, 5))
    projected = project_to_row_space(W, J)
    np.testing.assert_allclose(np.einsum("mn,npl->mpl", J, projected), np.einsum("mn,npl->mpl", J, W), atol=1e-12)
    null = np.eye(4) - np.linalg.pinv(J) @ J
    np.testing.assert_allclose(np.einsum("ij,jpl->ipl", null, projected), 0.0, atol=1e-12)
    np.testing.assert_allclose(project_to_row_space(projected, J), projected, atol=1e-12)


@pytest.mark.parametrize("smallest", [1.0, 1e-2, 1e-6, 1e-12, 0.0])
@pytest.mark.parametrize(("m", "n"), [(2, 4), (3, 6), (3, 3), (4, 2)])
def test_the_projection_is_that_of_the_pseudo_inverse_however_close_to_singular(m, n, smallest):
    rng = np.random.default_rng(7)
    size = min(m, n)
    left, right = (np.linalg.qr(rng.normal(size=(rows, size)))[0] for rows in (m, n))
    J = left * np.array([1.0] * (size - 1) + [smallest]) @ right.T
    kept = project_to_row_space(np.eye(n)[:, :, None], J)[:, :, 0]
    rows = right if smallest > 0.0 else right[:, :-1]
    rounding = 1e-15 / smallest if smallest > 0.0 else 0.0  # of J itself, which turns its weakest direction
    np.testing.assert_allclose(kept, rows @ rows.T, atol=max(1e-9, rounding))
