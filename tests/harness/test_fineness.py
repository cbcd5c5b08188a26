"""The least difference against simulated tests, and agreement of halves against all splits one by one."""

import itertools

import numpy as np
import pytest

from servobench.harness.analysis.comparison import mean_with_interval, paired_difference
from servobench.harness.analysis.fineness import POWER, agreement_of_halves, least_difference


def test_a_least_difference_is_told_as_often_as_its_power_says():
    rng = np.random.default_rng(3)
    values = rng.normal(0.0, 0.3, 40)
    values = 0.3 * (values - values.mean()) / values.std(ddof=1)
    least = least_difference(mean_with_interval(values), 0.1)
    told = [
        paired_difference(rng.normal(least, 0.3, 40), np.zeros(40), 0.1).verdict == "worse"
        for _ in range(400)
    ]
    assert np.mean(told) == pytest.approx(POWER, abs=0.06)
    assert least == pytest.approx(0.1 + (1.685 + 0.851) * 0.3 / 40**0.5, abs=1e-3)


def test_a_single_robot_tells_no_difference():
    assert np.isnan(least_difference(mean_with_interval(np.array([1.0])), 0.1))


@pytest.mark.parametrize(
    ("less", "more", "ties"), [(5, 2, 1), (4, 4, 0), (6, 0, 0), (1, 0, 5), (0, 0, 4), (4, 2, 1)]
)
def test_halves_agree_as_often_as_in_all_splits(less, more, ties):
    signs = np.array([-1] * less + [1] * more + [0] * ties)
    count = len(signs)
    agreed = []
    for chosen in itertools.combinations(range(count), count // 2):
        one = np.sign(signs[list(chosen)].sum())
        other = np.sign(np.delete(signs, chosen).sum())
        agreed.append(one == other != 0)
    assert agreement_of_halves((less, more), count) == pytest.approx(np.mean(agreed), abs=1e-12)
