"""Tests of sampling in physical time: numpy's interpolation, whole places, and previews that do not reach."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.controllers.periods import check_preview, in_periods, sampled


@given(
    st.integers(1, 8),
    st.lists(st.integers(0, 1000), min_size=1, max_size=6),
    st.lists(st.integers(1, 3), max_size=2),
    st.integers(0, 99),
)
def test_samples_are_those_of_linear_interpolation(count, shares, lead, seed):
    rows = np.random.default_rng(seed).normal(size=(*lead, count, 2))
    places = np.array(shares) * (count - 1) / 1000
    wanted = np.apply_along_axis(lambda line: np.interp(places, np.arange(count), line), -2, rows)
    np.testing.assert_allclose(sampled(rows, places), wanted, atol=1e-12)


def test_at_whole_places_samples_are_the_rows_themselves():
    rows = np.array([[0.1], [np.nan], [0.3], [0.7]])
    np.testing.assert_array_equal(sampled(rows, np.array([3.0, 0.0, 2.0])), [[0.7], [0.1], [0.3]])


def test_periods_that_are_whole_but_for_rounding_are_whole():
    assert 0.15 / 0.05 < 3.0 == in_periods(0.15, 0.05)
    assert in_periods(0.05, 0.02) == 2.5
    assert in_periods(0.0, 0.02) == 0.0


def test_the_rounding_of_many_periods_is_a_share_of_them_and_of_one_a_share_of_one():
    assert in_periods(0.05 * (1e4 + 1e-6), 0.05) == 1e4
    assert in_periods(0.05 * (1.0 + 1.5e-9), 0.05) != 1.0


def test_a_preview_that_does_not_reach_far_enough_is_refused():
    check_preview(0.15, 3, 0.05, "what")
    check_preview(0.05, 3, 0.02, "what")
    with pytest.raises(
        ValueError,
        match=r"preview must reach what = 0.05 s, got 2 rows of 0.02 s; lengthen run.preview_time",
    ):
        check_preview(0.05, 2, 0.02, "what")
