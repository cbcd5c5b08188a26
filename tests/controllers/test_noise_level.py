"""Tests of the noise level: the posterior on a grid by scipy, true levels far from the guess, outliers, lanes."""

import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import norm

from servobench.controllers.stages import noise_level
from servobench.controllers.stages.noise_level import NoiseLevel

GUESS = 1e-3
GRID = GUESS * 2.0 ** np.arange(-2, 8)


def learned(level, innovations, multiple, other):
    for nu in innovations:
        level = level.learn(
            np.vecdot(nu, nu), np.int_(len(nu)), np.float64(multiple), np.float64(other)
        )
    return level


def test_it_is_the_mean_of_the_posterior_on_the_grid():
    """ln σ of normal innovations of variance a σ² + b; of each score 0.99 is kept per sample."""
    rng = np.random.default_rng(1)
    a = 1.7
    b = 3e-6
    innovations = 4e-3 * rng.normal(size=(6, 3))
    kept = 0.99 ** np.arange(6)[::-1]
    deviation = np.sqrt(a * GRID[:, None, None] ** 2 + b)
    log = norm(scale=deviation).logpdf(innovations).sum(axis=-1) @ kept
    log = log + 0.99**6 * norm(np.log(GUESS), 1.5).logpdf(np.log(GRID))
    level = learned(NoiseLevel.start(GUESS), innovations, a, b)
    assert level.deviation == pytest.approx(np.exp(softmax(log) @ np.log(GRID)))
    assert level.variance == pytest.approx(level.deviation**2)


def test_before_there_is_an_innovation_it_is_the_guess():
    for lead in ((), (2, 3)):
        np.testing.assert_array_equal(
            NoiseLevel.start(GUESS, lead).variance, np.full(lead, GUESS**2)
        )


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_outliers_count_for_no_level_more_than_for_another(size):
    """Their density does not depend on σ: what the other frames showed is flattened by forgetting alone."""
    rng = np.random.default_rng(2)
    innovations = np.sqrt(2.0) * 2.0 * GUESS * rng.normal(size=(100, 3))
    level = learned(NoiseLevel.start(GUESS), innovations, 2.0, 0.0)
    after = learned(level, size * rng.normal(size=(5, 3)), 2.0, 0.0)
    np.testing.assert_allclose(after.scores, 0.99**5 * level.scores, rtol=1e-9, atol=1e-9)
    assert after.deviation == pytest.approx(level.deviation, rel=0.02)
    runs = frames_with_outliers(rng)
    levels = [learned(NoiseLevel.start(GUESS), run, 2.0, 0.0).deviation for run in runs]
    assert np.mean(levels) == pytest.approx(2.0 * GUESS, rel=0.2)


def frames_with_outliers(rng):
    """Return ten runs of frames with noise of twice the guess, of which each tenth is an outlier."""
    frames = 2.0 * np.sqrt(2.0) * GUESS * rng.normal(size=(10, 100, 3))
    frames[:, ::10] = noise_level.OUTLIER * rng.normal(size=(10, 10, 3))
    return frames


def test_the_same_frame_again_teaches_nothing():
    level = learned(NoiseLevel.start(GUESS), np.full((3, 3), 2e-3), 2.0, 0.0)
    for one, other in zip(level, learned(level, np.zeros((4, 3)), 2.0, 1e-6), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_innovation_without_noise_of_frames_says_nothing_of_it():
    level = learned(NoiseLevel.start(GUESS), [np.full(3, 2e-3)], 2.0, 0.0)
    np.testing.assert_allclose(
        learned(level, [np.full(3, 1e-3)], 0.0, 1e-6).scores, 0.99 * level.scores, atol=1e-9
    )


LANES = 2_000  # numpy's power of a number differs from that of an array once in so many


def test_many_lanes_have_the_bits_of_each_alone():
    rng = np.random.default_rng(1)
    square, other = 10.0 ** rng.uniform(-8, -1, (2, LANES))
    multiple = rng.uniform(1.0, 2.0, LANES)
    count = rng.integers(1, 4, LANES)
    square[::7] = 0.0
    level = (
        NoiseLevel.start(GUESS, (LANES,))
        .learn(square, count, multiple, other)
        .learn(other, count, multiple, square)
    )
    for lane in range(LANES):
        a = square[lane]
        b = other[lane]
        c = count[lane]
        d = multiple[lane]
        alone = NoiseLevel.start(GUESS).learn(a, c, d, b).learn(b, c, d, a)
        for one, among in zip(alone, level, strict=True):
            np.testing.assert_array_equal(one, among[lane])
