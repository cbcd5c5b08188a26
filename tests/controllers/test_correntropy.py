"""The correntropy filters against transcriptions of the published formulas, with the matrices of the papers."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from kit.toy import Learning, motion
from servobench.controllers.estimators.correntropy import (
    MIN_ERROR,
    GmckfConfig,
    ImcckfConfig,
    MckfConfig,
    RmckfConfig,
    gmckf_estimator,
    imcckf_estimator,
    mckf_estimator,
    rmckf_estimator,
)

M = 3
N = 4
WALK = 0.09
NOISE = 0.001
FILTERS = {
    "mckf": (MckfConfig, mckf_estimator),
    "imcckf": (ImcckfConfig, imcckf_estimator),
    "gmckf": (GmckfConfig, gmckf_estimator),
    "rmckf": (RmckfConfig, rmckf_estimator),
}


def published_fixed_point(x, P, H, z, R, kernel, tolerance, iterations):
    """Chen et al. (2017), algorithm 1, steps 3 to 6, with any kernel."""
    s = len(x)
    B_p = np.linalg.cholesky(P)
    B_r = np.linalg.cholesky(R)
    B = block_diag(B_p, B_r)
    D = np.linalg.solve(B, np.concatenate([x, z]))
    W = np.linalg.solve(B, np.vstack([np.eye(s), H]))
    last = x
    for _ in range(iterations):
        weights = kernel(D - W @ last)
        P_tilde = B_p @ np.linalg.inv(np.diag(weights[:s])) @ B_p.T
        R_tilde = B_r @ np.linalg.inv(np.diag(weights[s:])) @ B_r.T
        K = P_tilde @ H.T @ np.linalg.inv(H @ P_tilde @ H.T + R_tilde)
        new = x + K @ (z - H @ x)
        done = np.linalg.norm(new - last) <= tolerance * np.linalg.norm(last)
        last = new
        if done:
            break
    A = np.eye(s) - K @ H
    return last, A @ P @ A.T + K @ R @ K.T


def published_mckf(x, P, H, z, R, config):
    def gaussian(e):
        return np.exp(-(e**2) / (2 * config.bandwidth**2))

    return published_fixed_point(x, P, H, z, R, gaussian, config.tolerance, config.iterations)


def published_gmckf(x, P, H, z, R, config):
    """Mo et al. (2022): the same with the weights of the generalised Gaussian density, its constant factors kept."""
    a = config.shape
    b = config.bandwidth

    def generalised(e):
        size = np.maximum(np.abs(e), MIN_ERROR)
        return a / b**a * size ** (a - 2) * np.exp(-((size / b) ** a))

    return published_fixed_point(x, P, H, z, R, generalised, config.tolerance, config.iterations)


def published_imcckf(x, P, H, z, R, config):
    """Kulikova (2017), algorithm 1."""
    e = z - H @ x
    square = e @ np.linalg.inv(R) @ e
    weight = np.exp(-square / (2 * config.bandwidth**2))
    S = weight * H @ P @ H.T + R
    K = weight * P @ H.T @ np.linalg.inv(S)
    A = np.eye(len(x)) - K @ H
    return x + K @ e, A @ P


def published_rmckf(x, P, H, z, R, config):
    """Leite et al. (2023)."""
    B_r = np.linalg.cholesky(R)
    e = np.linalg.solve(B_r, z - H @ x)
    C = np.diag(np.exp(-(e**2) / (2 * config.bandwidth**2)))
    regularised = C + config.regularisation * np.eye(len(z))
    R_tilde = B_r @ np.linalg.inv(regularised) @ B_r.T
    S = H @ P @ H.T + R_tilde
    K = P @ H.T @ np.linalg.inv(S)
    A = np.eye(len(x)) - K @ H
    return x + K @ (z - H @ x), A @ P @ A.T + K @ R @ K.T


PUBLISHED = {
    "mckf": published_mckf, "gmckf": published_gmckf, "imcckf": published_imcckf, "rmckf": published_rmckf,
}  # fmt: skip


def motions(count, outliers=0.3, seed=5):
    """Motions of an arm with a constant Jacobian, some of which are seen with an outlier in some features."""
    rng = np.random.default_rng(seed)
    J = rng.normal(scale=0.4, size=(M, N))
    for _ in range(count):
        dq = rng.normal(scale=0.03, size=N)
        wrong = (rng.random(M) < outliers) * rng.normal(scale=0.01, size=M)
        yield dq, J @ dq + rng.normal(scale=0.0014, size=M) + wrong


@pytest.mark.parametrize("name", FILTERS)
def test_every_update_equals_the_published_formulas(name):
    kind, make = FILTERS[name]
    config = kind(initial_deviation=0.3, walk=WALK, feature_noise=NOISE)
    J = np.random.default_rng(1).normal(scale=0.4, size=(M, N))
    run = Learning(make(config), J)
    x = J.ravel()
    P = 0.09 * np.eye(M * N)
    assert run.diagnostics() == {
        "estimator_updated": False,
        "jacobian_deviation": pytest.approx(0.3),
    }
    for dq, dy in motions(40):
        run.update(motion(dq, dy))
        H = np.kron(np.eye(M), dq)
        R = 2 * NOISE**2 * np.eye(M)
        x, P = PUBLISHED[name](x, P + WALK**2 * 0.05 * np.eye(M * N), H, dy, R, config)
        np.testing.assert_allclose(run.jacobian().ravel(), x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(block_diag(*run.state.P), P, rtol=1e-12, atol=1e-12)
    deviation = np.sqrt(np.trace(P) / (M * N))
    assert run.diagnostics() == {
        "estimator_updated": True,
        "jacobian_deviation": pytest.approx(deviation),
    }


@pytest.mark.parametrize("name", FILTERS)
def test_an_outlier_beyond_all_measure_passes_the_regularised_filter_only(name):
    kind, make = FILTERS[name]
    run = Learning(make(kind()), np.full((M, N), 0.3))
    run.update(motion(np.full(N, 0.01), np.full(M, 1e9)))
    change = np.abs(run.jacobian() - 0.3).max()
    assert change > 1e4 if name == "rmckf" else change < 1e-3  # a weight of at least ε lets it pass
    assert run.diagnostics()["estimator_updated"]
