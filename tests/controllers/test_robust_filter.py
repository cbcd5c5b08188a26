"""The robust filter of feature and Jacobian: what it is without outliers, and what it bears."""

import numpy as np
import pytest

from kit.toy import Learning, motion
from servobench.controllers.estimators.kalman import (
    KalmanConfig,
    RlsConfig,
    RlsEstimator,
    kalman_estimator,
)
from servobench.controllers.estimators.robust_filter import (
    BISQUARE,
    MEMORY,
    RobustConfig,
    RobustEstimator,
    bisquare_weight,
    irls_weight,
)
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import carry_out_together
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve

M = 3
N = 4
NOISE = 0.001


def frames(count, share, size=0.2, frames_each=1, seed=0):
    """Return the Jacobian, joint motions, and features seen with noise, of which a share are outliers."""
    rng = np.random.default_rng(seed)
    J = rng.normal(scale=0.4, size=(M, N))
    dq = rng.normal(scale=0.02, size=(count, N))
    y = np.cumsum(dq @ J.T, axis=0) + NOISE * rng.normal(size=(count, M))
    wrong = np.repeat(rng.random(count // frames_each + 1) < share, frames_each)[:count]
    directions = np.repeat(rng.normal(size=(count // frames_each + 1, M)), frames_each, axis=0)[
        :count
    ]
    y += wrong[:, None] * size * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return J, dq, y


def learned(estimator, J, dq, y):
    """Return an estimator that has learned from all frames, and has begun with J."""
    run = Learning(estimator, J)
    for k in range(1, len(y)):
        run.update(motion(dq[k], y[k] - y[k - 1]))
    return run


def error_after(estimator, share, **values):
    """Return ‖Ĵ − J‖/‖J‖ after 600 frames, begun from a Jacobian that is wrong by a tenth."""
    J, dq, y = frames(600, share, **values)
    return np.linalg.norm(learned(estimator, 1.1 * J, dq, y).jacobian() - J) / np.linalg.norm(J)


def test_a_filter_without_weights_is_the_kalman_filter_of_feature_and_jacobian():
    config = RobustConfig(initial_deviation=0.1, feature_noise=NOISE)
    J, dq, y = frames(30, 0.0)
    run = Learning(RobustEstimator(config), J + 0.05)
    x = np.concatenate([y[0][:, None], J + 0.05], axis=1)
    P = np.repeat(np.diag([NOISE**2, *[0.1**2] * N])[None], M, axis=0)
    for k in range(1, 30):
        before = run.state
        run.update(motion(dq[k], y[k] - y[k - 1]))
        F = np.eye(N + 1)
        Q = config.walk**2 * 0.05 * np.eye(N + 1)
        F[0, 1:] = dq[k]
        Q[0, 0] = (config.motion_error * np.linalg.norm(x[:, 1:] @ dq[k])) ** 2
        for i in range(M):
            x[i], P[i] = F @ x[i], F @ P[i] @ F.T + Q
            R = (NOISE * before.scale) ** 2
            w = irls_weight(y[k, i] - x[i, :1], P[i, :1, 0], np.array([R]))[0]
            K = P[i, :, 0] / (P[i, 0, 0] + R / w)
            x[i] = x[i] + K * (y[k, i] - x[i, 0])
            P[i] = (np.eye(N + 1) - np.outer(K, np.eye(N + 1)[0])) @ P[i]
        np.testing.assert_allclose(run.jacobian(), x[:, 1:], atol=1e-10)
        np.testing.assert_allclose(run.state.deviation, y[k] - x[:, 0], atol=1e-10)
        np.testing.assert_allclose(run.state.P, P, atol=1e-10)
    of_jacobian = np.mean([np.diagonal(each)[1:] for each in P])
    np.testing.assert_allclose(
        run.diagnostics()["jacobian_deviation"], np.sqrt(of_jacobian), rtol=1e-6
    )


def test_the_weight_is_that_of_tukey_and_belongs_to_the_residual():
    u = np.array([0.0, 1.0, BISQUARE / np.sqrt(2.0), BISQUARE, 100.0])
    np.testing.assert_allclose(
        bisquare_weight(u), [1.0, (1.0 - 1.0 / BISQUARE**2) ** 2, 0.25, 0.0, 0.0], atol=1e-15
    )
    innovation = np.array([0.002])
    variance = np.array([1e-6])
    noise = np.array([4e-6])
    w = irls_weight(innovation, variance, noise)
    residual = innovation * noise / (w * variance + noise)
    np.testing.assert_allclose(bisquare_weight(residual / np.sqrt(noise)), w, atol=1e-6)
    assert irls_weight(np.array([0.2]), variance, noise) == 0.0


@pytest.mark.parametrize("frames_each", [1, 5])
def test_it_holds_at_40_percent_outlier_frames_where_others_do_not(frames_each):
    shares = {"share": 0.4, "frames_each": frames_each}
    robust = RobustEstimator(RobustConfig(walk=0.01, motion_error=0.0))
    assert error_after(robust, 0.0) < 0.02
    assert error_after(robust, **shares) < 0.04
    for other in (kalman_estimator(KalmanConfig(walk=0.01)), RlsEstimator(RlsConfig())):
        assert error_after(other, 0.0) < 0.08
        assert error_after(other, **shares) > 0.3


def test_an_outlier_in_the_first_frame_is_a_delay_only():
    J, dq, y = frames(400, 0.0)
    y[0] += 0.2
    run = learned(RobustEstimator(RobustConfig(walk=0.01)), 1.1 * J, dq, y)
    assert np.linalg.norm(run.jacobian() - J) < 0.03 * np.linalg.norm(J)
    assert np.abs(run.state.deviation).max() < 0.01


def test_a_rejected_frame_counts_by_its_time():
    run = Learning(RobustEstimator(RobustConfig()), np.ones((M, N)))
    run.update(motion(np.zeros(N), np.full(M, 9.0)))
    np.testing.assert_allclose(run.state.rejected, 1.0 - np.exp(-0.05 / MEMORY), rtol=1e-12)
    for rejected in range(2, 26):  # 0.7 of the last second takes 1.2 s
        assert run.state.deviation.min() > 8.0, rejected
        run.update(motion(np.zeros(N), np.zeros(M)))
    assert not np.any([run.state.deviation, run.state.rejected])


def test_the_scale_follows_noise_that_is_larger_than_configured():
    J, dq, y = frames(600, 0.0)
    y += 0.01 * np.random.default_rng(7).normal(size=y.shape)
    run = learned(RobustEstimator(RobustConfig(walk=0.01, motion_error=0.0)), 1.1 * J, dq, y)
    assert 6.0 < run.diagnostics()["noise_scale"] < 16.0
    assert run.diagnostics()["rejected_share"] < 0.1


@pytest.mark.slow
def test_in_the_loop_its_jacobian_bears_40_percent_outlier_frames():
    def jacobian_errors(estimator):
        name = f"pid+{estimator}"
        sections = {
            "random": {"duration": 8.0},
            "kinematic": {"sensing": {"outlier_size": 0.2}},
            name: {"law": {"proportional_gain": 1.0, "damping": 0.02}},
        }
        requests = [
            RunRequest("kinematic", name, "random", "moderate+outliers=40%", seed)
            for seed in range(6)
        ]
        results = carry_out_together([resolve(request, Settings(sections)) for request in requests])
        return np.array([result.row["jacobian_error_mean"] for result in results])

    robust = jacobian_errors("robust")
    assert np.median(robust) < 0.4
    assert np.median(jacobian_errors("rls")) > 2.0 * np.median(robust)
    assert np.median(jacobian_errors("kalman")) > 10.0 * np.median(robust)
