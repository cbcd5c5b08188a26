"""Tests of the noise level that is estimated from innovations."""

import numpy as np
import pytest

from servobench.controllers.stages.noise_level import NoiseLevel


@pytest.mark.parametrize("true", [0.0003, 0.001, 0.004])
def test_the_noise_is_found_whatever_the_first_guess(true):
    rng, level, found = np.random.default_rng(6), NoiseLevel.guess(0.001), []
    for k in range(800):
        other = 1e-6 * (k % 3)  # variance that is not noise, and known
        nu = rng.normal(scale=np.sqrt(2.0 * true**2 + other), size=3)
        level = level.learn(nu @ nu / 3.0, 2.0, other)
        found.append(level.variance)
    assert np.sqrt(np.mean(found[200:])) == pytest.approx(true, rel=0.15)


def test_one_sample_of_noise_by_hand():
    """σ² = 1 counts once: weight (2/(2 + 2))² = 0.25, sample (8 − 2)/2 = 3: (0.99 + 0.75)/(0.99 + 0.25)."""
    level = NoiseLevel.guess(1.0).learn(8.0, 2.0, 2.0)
    assert level.variance == pytest.approx(1.74 / 1.24)
    assert level.deviation == pytest.approx(np.sqrt(1.74 / 1.24))


def test_a_jump_counts_at_most_nine_times_the_noise_and_at_first_ninety_times():
    level = NoiseLevel.guess(1.0).learn(1e6, 1.0, 0.0)
    assert level.variance == pytest.approx((0.99 + 90.0) / 1.99)
    for _ in range(LANES):
        level = level.learn(1.0, 1.0, 0.0)
    before = level.variance
    assert before == pytest.approx(1.0, rel=0.01)
    level = level.learn(1e6, 1.0, 0.0)
    assert level.variance == pytest.approx((99.0 * before + 9.0 * before) / 100.0, rel=0.01)


def test_eight_times_the_noise_is_known_after_three_samples_in_most_lanes():
    rng, level = np.random.default_rng(7), NoiseLevel.guess(0.001, (200,))
    for _ in range(3):
        nu = rng.normal(scale=np.sqrt(2.0) * 0.008, size=(200, 3))
        level = level.learn(np.vecdot(nu, nu) / 3.0, 2.0, np.zeros(200))
    assert 0.005 < np.median(level.deviation) < 0.011


def test_lanes_learn_each_for_itself_and_a_repeated_frame_teaches_nothing():
    squares, other = np.array([[2e-6, 0.0, 5e-6], [0.0, 0.0, 9e-3]]), np.array([0.0, 1e-7, 3e-6])
    lanes, single = NoiseLevel.guess(0.001, (3,)), [NoiseLevel.guess(0.001)] * 3
    for square in squares:
        lanes = lanes.learn(square, 2.0, other)
        single = [level.learn(square[k], 2.0, other[k]) for k, level in enumerate(single)]
    for array, numbers in zip(lanes, zip(*single, strict=True), strict=True):
        np.testing.assert_array_equal(array, numbers)
    assert lanes.variance[1] == 0.001**2


LANES = 20_000  # numpy's power of a number differs from that of an array once in so many


def test_many_lanes_have_the_bits_of_each_alone():
    generator = np.random.default_rng(1)
    square, other = 10.0 ** generator.uniform(-8, -4, (2, LANES))
    level = NoiseLevel.guess(0.001, (LANES,)).learn(square, 2.0, other).learn(other, 1.0, square)
    for lane in range(LANES):
        alone = NoiseLevel.guess(0.001).learn(square[lane], 2.0, other[lane]).learn(other[lane], 1.0, square[lane])
        assert [x[lane] for x in level] == list(alone)
