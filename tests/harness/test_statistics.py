"""Statistics against published numbers, other libraries' functions, and properties."""

import itertools
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, stats
from statsmodels.stats.descriptivestats import sign_test
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint
from statsmodels.stats.weightstats import ttost_paired

from servobench.harness.analysis import comparison as statistics
from servobench.harness.analysis.comparison import (
    NO_ESTIMATE,
    Estimate,
    compare_pairs,
    holm,
    is_majority,
    margin,
    mean_with_interval,
    median_with_interval,
    number,
    outcomes,
    paired_difference,
    settling_times,
    success_rate,
    tail_mean,
)

NEVER = float("nan")
samples = st.lists(st.floats(0.0, 100.0, allow_subnormal=False), min_size=2, max_size=12)


def table(**columns):
    """A table of runs of two controllers or more, with all keys."""
    size = len(columns["controller"])
    fixed = {"plant": "p", "task": "t", "mismatch": "m", "status": "completed"}
    return pd.DataFrame({name: [value] * size for name, value in fixed.items()} | columns)


@given(runs=st.integers(1, 2000), share=st.floats(0.0, 1.0))
def test_the_wilson_interval_is_that_of_statsmodels(runs, share):
    successes = round(share * runs)
    found = success_rate(successes, runs)
    wanted = proportion_confint(successes, runs, method="wilson")
    assert (found.low, found.high) == pytest.approx(wanted, abs=1e-14)
    assert (found.value, found.count) == (successes / runs, runs)


def test_an_estimate_is_printed_with_its_interval_and_a_missing_one_as_a_dash():
    assert f"{Estimate(0.754, 0.5, np.inf, 3):.2f}" == "0.75 [0.50, ∞]"
    assert f"{Estimate(0.754, np.nan, np.nan, 1):.2f}" == "0.75"
    assert f"{Estimate(0.002, 0.001, 0.003, 3).scaled(1000.0):.0f}" == "2 [1, 3]"
    assert f"{NO_ESTIMATE:.1f}" == "–"


@given(p_values=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=15))
def test_holms_correction_is_that_of_statsmodels(p_values):
    with patch("gc.collect"):  # which takes statsmodels a tenth of a second
        assert holm(p_values) == multipletests(p_values, method="holm")[1].tolist()


@pytest.mark.parametrize(("successes", "runs"), [(0, 0), (3, 2), (-1, 2)])
def test_impossible_counts_are_refused(successes, runs):
    with pytest.raises(ValueError, match="successes must be from 0 to runs"):
        success_rate(successes, runs)


def test_the_bootstrap_interval_is_scipys_up_to_one_order_statistic():
    sample = np.random.default_rng(5).gamma(2.0, size=40)
    drawn = stats.bootstrap(
        (sample,), np.median, n_resamples=2000, method="percentile", rng=np.random.default_rng(0)
    )
    found = median_with_interval(sample)
    medians = np.sort(drawn.bootstrap_distribution)
    for mine, theirs in zip((found.low, found.high), drawn.confidence_interval, strict=True):
        position = np.searchsorted(medians, theirs)
        assert medians[position - 1] <= mine <= medians[position]
    assert found.value == np.median(sample)


@settings(max_examples=25, deadline=None)
@given(values=samples, never=st.integers(0, 12))
def test_runs_that_never_settle_weigh_like_runs_that_settle_after_all_others(values, never):
    found = median_with_interval(values + [NEVER] * never)
    late = median_with_interval(values + [1e6] * never)
    for mine, theirs in ((found.value, late.value), (found.low, late.low), (found.high, late.high)):
        assert mine == theirs if theirs <= 100.0 else np.isinf(mine)
    assert found.low <= found.value <= found.high


def test_a_median_is_infinite_where_half_of_the_runs_never_settle():
    assert median_with_interval([1.0, 2.0, NEVER]).value == 2.0
    assert median_with_interval([1.0, NEVER]).value == np.inf
    found = median_with_interval([NEVER] * 4)
    assert (found.value, found.low, found.high) == (np.inf, np.inf, np.inf)


def test_an_interval_is_the_same_for_any_number_of_resamples_in_memory(monkeypatch):
    sample = np.random.default_rng(1).gamma(2.0, size=301)
    found = median_with_interval(sample)
    monkeypatch.setattr(statistics, "DRAWN_AT_ONCE", 7 * len(sample))
    assert median_with_interval(sample) == found


def test_what_does_not_apply_is_left_out_when_asked():
    found = median_with_interval([3.0, NEVER, 5.0], missing="left_out")
    assert (found.value, found.count) == (4.0, 2)
    with pytest.raises(ValueError, match="at least one number"):
        median_with_interval([NEVER], missing="left_out")


def test_degenerate_samples_have_no_interval_or_one_of_no_width():
    alone, equal = median_with_interval([2.5]), median_with_interval([2.5] * 9)
    assert alone.value == 2.5
    assert np.isnan([alone.low, alone.high]).all()
    assert (equal.low, equal.value, equal.high) == (2.5, 2.5, 2.5)
    with pytest.raises(ValueError, match="−∞"):
        median_with_interval([1.0, -np.inf])


def test_the_interval_of_a_mirrored_sample_is_the_mirrored_interval(monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 60)  # hardly any ties
    sample = np.random.default_rng(4).normal(size=30)
    drawn, mirrored = (median_with_interval(values) for values in (sample, -sample))
    assert (mirrored.low, mirrored.value, mirrored.high) == (-drawn.high, -drawn.value, -drawn.low)


@settings(max_examples=30, deadline=None)
@given(values=samples, level=st.sampled_from([0.0, 0.5, 0.9, 0.95]))
def test_the_tail_mean_is_the_minimum_of_rockafellar_and_uryasev(values, level):
    """min over c of c + mean(max(x − c, 0)) / (1 − level), a linear program."""
    count = len(values)
    cost = np.concatenate([[1.0], np.full(count, 1.0 / ((1.0 - level) * count))])
    above = np.hstack([-np.ones((count, 1)), -np.eye(count)])
    bounds = [(None, None)] + [(0.0, None)] * count
    with np.errstate(all="ignore"):
        program = optimize.linprog(cost, A_ub=above, b_ub=-np.array(values), bounds=bounds)
    assert tail_mean(values, level) == pytest.approx(program.fun, rel=1e-6, abs=1e-6)


def test_the_tail_mean_of_hundred_errors_is_the_mean_of_the_worst_ten_or_five():
    errors = np.random.default_rng(2).permutation(np.arange(1.0, 101.0))
    assert tail_mean(errors, 0.9) == pytest.approx(95.5)
    assert tail_mean(errors, 0.95) == pytest.approx(98.0)
    assert tail_mean([*errors, NEVER]) == tail_mean([NEVER]) == np.inf
    assert tail_mean([3.0]) == 3.0
    with pytest.raises(ValueError, match="level must be at least 0 and below 1, got 1"):
        tail_mean(errors, 1.0)
    with pytest.raises(ValueError, match="values must hold at least one number"):
        tail_mean([])


def test_a_majority_is_what_counting_all_signs_says():
    for count in range(6, 12):
        sums = [sum(signs) for signs in itertools.product([0, 1], repeat=count)]
        for ones in range(count + 1):
            assert is_majority(ones, count - ones) == (np.mean(np.array(sums) >= ones) < 0.05)
    assert not is_majority(5, 0)
    assert not is_majority(0, 0)


def three_controllers():
    rng = np.random.default_rng(7)
    base = rng.uniform(1.0, 2.0, 25)
    values = np.concatenate(
        [base, base + rng.uniform(0.1, 0.3, 25), base + rng.normal(scale=0.1, size=25)]
    )
    return table(
        controller=["a"] * 25 + ["b"] * 25 + ["c"] * 25,
        seed=[*range(25)] * 3,
        settling_time_s=values,
    )


def test_the_better_controller_has_a_negative_mean_difference_of_pairs_not_of_means():
    runs = three_controllers()
    (found,) = compare_pairs(runs, [("a", "b")])
    paired = runs.pivot_table(index="seed", columns="controller", values="settling_time_s")
    interval = stats.ttest_rel(paired["a"], paired["b"]).confidence_interval(0.9)
    assert found.mean.value == pytest.approx((paired["a"] - paired["b"]).mean())
    assert (found.mean.low, found.mean.high) == pytest.approx(tuple(interval), rel=1e-9)
    assert (found.mean.count, found.verdict, found.probability.value) == (25, "better", 1.0)
    assert compare_pairs(runs, [("b", "a")])[0].verdict == "worse"


def test_only_common_seeds_make_pairs_in_any_order_of_rows():
    runs = three_controllers()
    some = runs[(runs["controller"] == "a") | (runs["seed"] >= 15)]
    (found,) = compare_pairs(some.sample(frac=1.0, random_state=0), [("a", "b")])
    (same,) = compare_pairs(runs[runs["seed"] >= 15], [("a", "b")])
    assert found.mean.count == 10
    assert found.mean.value == pytest.approx(same.mean.value)


def test_a_run_that_never_settled_or_ended_early_is_lost_and_worse_than_any():
    runs = table(
        controller=list("ab") * 3,
        seed=[0, 0, 1, 1, 2, 2],
        settling_time_s=[1.0, NEVER, 2.0, 0.5, 3.0, 2.0],
    )
    runs.loc[3, "status"] = "feature_lost"
    (found,) = compare_pairs(runs, [("a", "b")])
    assert (found.lost, found.mean.value, found.mean.count) == ((0, 2), 1.0, 1)
    assert found.probability.value == pytest.approx(2.0 / 3.0)


@settings(max_examples=40, deadline=None)
@given(
    shift=st.floats(-0.1, 0.1), spread=st.sampled_from([0.01, 0.05, 0.2]), seed=st.integers(0, 99)
)
def test_equivalent_is_what_two_one_sided_t_tests_say(shift, spread, seed):
    rng = np.random.default_rng(seed)
    first = rng.uniform(1.0, 2.0, 20)
    second = first + rng.normal(shift, spread, 20)
    found = paired_difference(first, second, 0.05)
    p_value, _, _ = ttost_paired(first, second, -0.05, 0.05)
    assert (found.verdict == "equivalent") == (p_value < 0.05)
    for side, verdict in (("less", "better"), ("greater", "worse")):
        beyond = (
            stats.ttest_1samp(
                first - second, -0.05 if side == "less" else 0.05, alternative=side
            ).pvalue
            < 0.05
        )
        assert (found.verdict == verdict) == beyond


def test_the_probability_to_be_better_is_counted_with_ties_as_halves():
    rng = np.random.default_rng(9)
    first, second = rng.integers(0, 4, (2, 50)).astype(float)
    first[:5], second[3:9] = np.inf, NEVER
    found = paired_difference(first, second, 0.0)
    values = np.nan_to_num(np.stack([first, second]), nan=9.0, posinf=9.0)
    counted = sum(0.5 if a == b else float(a < b) for a, b in values.T)
    assert found.probability.value == pytest.approx(counted / 50)
    assert found.lost == (5, 6)


@settings(max_examples=40, deadline=None)
@given(values=st.lists(st.tuples(*[st.sampled_from([0.0, 1.0, 2.0, np.inf])] * 2), min_size=1))
def test_the_p_value_is_that_of_a_sign_test_in_which_lost_runs_are_worst(values):
    first, second = np.array(values).T
    found = paired_difference(first, second, 0.1)
    ranks = np.nan_to_num(first, posinf=9.0) - np.nan_to_num(second, posinf=9.0)
    assert found.signs == ((ranks < 0.0).sum(), (ranks > 0.0).sum())
    if ranks.any():
        _, p_value = sign_test(ranks)
        assert found.p_value == pytest.approx(p_value)
    else:
        assert found.p_value == 1.0


def test_a_mean_that_a_few_robots_lead_tells_the_two_apart_on_average_only():
    second = np.full(20, 2.0)
    alike = paired_difference(second - np.linspace(0.5, 0.6, 20), second, 0.1)
    assert (alike.verdict, alike.on_average, alike.p_value) == ("better", False, 2.0**-19)
    few = np.where(np.arange(20) < 12, second - 1.0, second + 0.01)
    found = paired_difference(few, second, 0.1)
    assert (found.verdict, found.on_average) == ("better", True)
    assert found.p_value == pytest.approx(0.5034, abs=1e-4)  # 12 of 20
    against = paired_difference(np.where(np.arange(20) < 4, -9.0, 2.01), second, 0.1)
    assert (against.verdict, against.on_average, against.p_value < 0.05) == ("better", True, True)
    lost = np.where(np.arange(20) < 6, np.inf, second - 0.01)
    assert paired_difference(lost, second, 0.1).verdict == "worse"
    assert not paired_difference(lost, second, 0.1).on_average


@pytest.mark.parametrize(
    ("lost", "shift", "verdict"),
    [
        ((0, 6), 0.5, "better"),
        ((0, 5), 0.5, "worse"),  # five signs tell nothing
        ((6, 0), 0.0, "worse"),
        ((1, 0), 0.0, "equivalent"),
        ((2, 0), 0.0, "undecided"),  # 2 of 40 are more than three points
        ((40, 40), 0.0, "undecided"),
    ],
)
def test_lost_runs_come_first_where_a_sign_test_tells_them_apart(lost, shift, verdict):
    base = np.linspace(1.0, 2.0, 40)
    first, second = base + shift + 0.01 * np.sin(7.0 * base), base.copy()
    first[: lost[0]], second[40 - lost[1] :] = NEVER, np.inf
    assert paired_difference(first, second, 0.05).verdict == verdict


def test_few_robots_and_samples_without_a_spread_decide_nothing_by_themselves():
    assert paired_difference(np.zeros(5), np.ones(5), 0.1).verdict == "undecided"
    assert paired_difference(np.zeros(6), np.ones(6), 0.1).verdict == "better"
    alone, none = (mean_with_interval(np.full(count, 2.0)) for count in (1, 0))
    assert (alone.value, np.isnan(alone.low), none) == (2.0, True, NO_ESTIMATE)
    assert paired_difference([], [], 0.1).probability == NO_ESTIMATE


def test_margins_are_a_period_a_share_of_the_band_or_of_the_bound_and_a_hundredth():
    runs = table(controller=["ukf_mfac", "calibrated", "calibrated", "calibrated"]).assign(
        settling_band=0.005
    )
    assert margin("settling_time_s", runs) == 0.05
    assert margin("settling_time_s", runs.assign(period_s=0.2)) == 0.2
    assert margin("overshoot", runs) == 0.01
    errors = runs.assign(rms_error_evaluated=[0.1, 0.0014, 0.0012, NEVER])
    assert margin("rms_error_evaluated", errors) == pytest.approx(0.2e-3)
    assert margin(
        "rms_error_evaluated", errors.assign(rms_error_evaluated=[0.1, 0.01, 0.02, 0.02])
    ) == pytest.approx(2e-3)
    efforts = runs.assign(control_effort_rad=[4.0, 2.0, 3.0, NEVER], mass=[-2.0, 3.0, 5.0, 9.0])
    assert margin("control_effort_rad", efforts) == pytest.approx(0.25)  # a tenth of 2.5
    assert margin("mass", efforts) == pytest.approx(0.2)
    assert margin("control_effort_rad", runs) == 0.0


def test_six_robots_and_a_difference_of_the_margin_are_equivalent():
    for margin_ in (0.5, -0.5):
        assert paired_difference(np.full(6, 1.0 + margin_), np.ones(6), 0.5).verdict == "equivalent"
    assert paired_difference(np.full(5, 1.1), np.ones(5), 0.5).verdict == "undecided"


def test_shares_of_lost_runs_that_differ_by_three_points_are_equivalent():
    first, second = np.ones((2, 100))
    first[:3] = NEVER
    assert paired_difference(first, second, 0.1).verdict == "equivalent"
    first[3], second[-2:] = NEVER, NEVER  # four and two
    assert paired_difference(first, second, 0.1).verdict == "equivalent"
    assert (
        paired_difference(np.where(np.arange(100) < 4, NEVER, 1.0), np.ones(100), 0.1).verdict
        == "undecided"
    )


def test_a_robot_alone_and_two_of_them_have_what_can_be_known():
    assert paired_difference([1.0], [2.0], 0.1).probability.value == 1.0
    two = mean_with_interval(np.array([1.0, 3.0]))
    wanted = stats.t.interval(0.9, 1, loc=2.0)
    assert (two.value, two.low, two.high, two.count) == pytest.approx((2.0, *wanted, 2))
    assert median_with_interval([2.0]).count == 1
    assert (NO_ESTIMATE.count, f"{Estimate(np.nan, np.nan, np.nan, 3):.1f}") == (0, "–")


def test_no_share_has_an_interval_beyond_all_or_none():
    found = [success_rate(share * count, count) for count in range(1, 300) for share in (0, 1)]
    assert (min(each.low for each in found), max(each.high for each in found)) == (0.0, 1.0)


def test_places_are_named_with_a_sensing_set_up_that_is_not_the_usual_one():
    assert [statistics.place_name("p", sensing) for sensing in (None, NEVER, "position", "pixel")] == [
        "p", "p", "p", "p pixel",
    ]  # fmt: skip
    runs = table(controller=["a", "b"], sensing=["position", "pixel"])
    assert statistics.with_places(runs)["plant"].tolist() == ["p", "p pixel"]
    assert statistics.with_places(runs[:1])["plant"].tolist() == ["p"]
    assert statistics.shown_value(2.5) == "2.5"


def test_a_curve_is_followed_up_to_two_bands_and_moves_count_in_percent():
    runs = table(
        controller=["a", "b"],
        task_kind=["curve"] * 2,
        rms_error_evaluated=[0.01, 0.0101],
        settling_band=0.005,
    )
    assert outcomes(runs).tolist() == ["followed", "not_followed"]
    assert (
        statistics.settled_share(table(controller=list("ab"), settling_time_s=[1.0, NEVER])).value
        == 50.0
    )


def test_a_margin_is_of_the_longest_period_the_widest_band_and_the_best_bound():
    runs = table(
        controller=["calibrated", "nmpc_calibrated"],
        settling_band=[0.005, 0.05],
        period_s=[0.1, 0.2],
    )
    assert margin("settling_time_s", runs) == 0.2
    assert margin("rms_error_evaluated", runs) == pytest.approx(2e-3)
    assert margin(
        "rms_error_evaluated", runs.assign(rms_error_evaluated=[0.03, 0.05])
    ) == pytest.approx(3e-3)


@pytest.mark.parametrize(
    ("pairs", "change", "message"),
    [
        ([("a", "nobody")], {}, "a and nobody have no run in common"),
        ([("a", "b")], {"seed": 0}, "a has several runs of the same plant, task, mismatch, seed"),
    ],
)
def test_comparisons_that_cannot_be_made_are_refused(pairs, change, message):
    with pytest.raises(ValueError, match=message):
        compare_pairs(three_controllers().assign(**change), pairs)


def test_runs_are_classed_by_how_they_ended():
    runs = table(controller=list("aabbb"), settling_time_s=[1.0, NEVER, 2.0, NEVER, 1.5])
    runs["status"] = ["completed", "completed", "feature_lost", "crashed", "completed"]
    assert outcomes(runs).tolist() == [
        "settled",
        "not_settled",
        "feature_lost",
        "crashed",
        "settled",
    ]
    assert settling_times(runs).notna().tolist() == [True, False, False, False, True]


def test_runs_that_all_ended_before_their_first_period_are_classed_without_metrics():
    runs = table(controller=["a", "b"], seed=[0, 0]).assign(status="crashed")
    assert outcomes(runs).tolist() == ["crashed", "crashed"]
    (found,) = compare_pairs(runs, [("a", "b")])
    assert (found.mean, found.verdict) == (NO_ESTIMATE, "undecided")


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (-0.001, "+.2f", "+0.00"),
        (-0.001, ".2f", "0.00"),
        (1.5, "+.1f", "+1.5"),
        (np.inf, ".2f", "∞"),
        (NEVER, ".2f", "–"),
    ],
)
def test_a_number_has_the_sign_that_is_asked_for_and_never_a_negative_zero(value, spec, text):
    assert number(value, spec) == text
