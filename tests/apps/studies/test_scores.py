"""Scores over challenges: against hand computations, closed forms and repeated samples."""

import itertools

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from servobench.harness.apps.studies.scores import profile, ranking, resolution, scores


def tidy(column, values):
    """Return the table of values[controller][challenge][seed]."""
    rows = [
        {"challenge": challenge, "controller": controller, "seed": seed, column: value}
        for controller, challenges in values.items()
        for challenge, numbers in challenges.items()
        for seed, value in enumerate(numbers)
    ]
    return pd.DataFrame(rows)


def test_a_score_is_the_floored_reference_over_the_floored_own_value():
    own = [2.0, 0.5, 4.0, 1.0, np.nan, np.inf, 3.0, np.nan]
    reference = [1.0, 0.1, 1.0, 3.0, 1.0, 1.0, np.nan, np.nan]
    expected = [1.0, 1.0, 1.5 / 4.0, 1.0, 0.0, 0.0, 1.0, 0.0]
    assert scores(own, reference, [2.0, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5]).tolist() == expected
    assert scores(4.0, 1.0, 1.5) == 0.375
    assert scores(4.0, 1.0, 0.5) == 0.25
    for floor in (0.0, [0.0, *[1.0] * 7]):
        with pytest.raises(ValueError, match="floor must be above 0, got 0"):
            scores(own, reference, floor)


def test_an_interquartile_mean_is_that_of_the_middle_half_of_all_challenges_together():
    table = tidy("score", {"a": {"x": [0.0, 0.1, 0.2, 0.9], "y": [0.3, 0.4, 1.0, 1.0]}})
    middle = ranking(table)[0].score
    assert middle.value == pytest.approx((0.2 + 0.3 + 0.4 + 0.9) / 4)
    assert middle.value == stats.trim_mean(table["score"], 0.25)
    assert middle.low < middle.value < middle.high
    assert middle.count == 8


def test_the_interval_of_an_interquartile_mean_is_stratified_by_challenge():
    """Challenges whose robots are all alike leave nothing to chance, however different the challenges are."""
    table = tidy("score", {"a": {"x": [0.2] * 10, "y": [0.6] * 10, "z": [0.9] * 20}})
    middle = ranking(table)[0].score
    assert (middle.low, middle.high) == pytest.approx((middle.value, middle.value))


def test_the_interval_is_scipys():
    sample = np.random.default_rng(4).uniform(0.2, 0.8, 60)
    middle = ranking(tidy("score", {"a": {"x": sample}}))[0].score
    wanted = stats.bootstrap(
        (sample,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), method="percentile", rng=0
    )
    low, high = wanted.confidence_interval
    assert (middle.low, middle.high) == pytest.approx((low, high), abs=0.05 * (high - low))


def test_methods_that_cannot_be_told_apart_share_a_rank_and_the_next_keeps_its_place():
    generator = np.random.default_rng(1)
    robots = generator.uniform(0.4, 0.8, 60)
    values = {
        "worst": {"x": robots - 0.3, "y": np.where(np.arange(60) < 15, 0.0, robots - 0.2)},
        "best": {"x": robots, "y": robots},
        "alike": {
            "x": robots + generator.normal(0.0, 0.02, 60),
            "y": robots + generator.normal(0.0, 0.02, 60),
        },
    }
    ranked = ranking(tidy("score", values))
    assert {each.controller: each.rank for each in ranked} == {"best": 1, "alike": 1, "worst": 3}
    assert [each.lost for each in ranked] == [0.0, 0.0, 15 / 120]


def test_a_small_difference_on_every_robot_is_told_apart_as_robots_are_shared():
    robots = np.random.default_rng(2).uniform(0.2, 0.9, 40)
    ranked = ranking(tidy("score", {"a": {"x": robots}, "b": {"x": robots - 0.01}}))
    assert [(each.rank, each.controller) for each in ranked] == [(1, "a"), (2, "b")]
    assert ranked[0].score.low < ranked[1].score.value  # their intervals overlap


@pytest.mark.parametrize(("seed", "ranks"), [(38, [1, 2]), (18, [1, 1])])
def test_methods_are_told_apart_at_five_percent_of_both_sides(seed, ranks):
    """The p-values are 0.036 and 0.081."""
    generator = np.random.default_rng(seed)
    robots = generator.uniform(0.3, 0.7, 20)
    other = robots + 0.02 + generator.normal(0.0, 0.045, 20)
    assert [
        each.rank for each in ranking(tidy("score", {"a": {"x": other}, "b": {"x": robots}}))
    ] == ranks


def test_equal_methods_share_a_rank_without_a_deviation():
    for other, ranks in ((0.5, [1, 1]), (0.4, [1, 2])):
        found = ranking(tidy("score", {"a": {"x": [0.5] * 4}, "b": {"x": [other] * 4}}))
        assert [each.rank for each in found] == ranks


def test_a_rank_is_shared_with_the_best_one_in_it_and_not_with_the_last():
    robots, noise = (
        np.random.default_rng(6).uniform(0.3, 0.7, 60),
        np.random.default_rng(7).normal(0.0, 0.1, 60),
    )
    values = {"best": robots, "noisy": robots - 0.01 + noise - noise.mean(), "worse": robots - 0.02}
    ranked = ranking(tidy("score", {name: {"x": own} for name, own in values.items()}))
    assert [(each.rank, each.controller) for each in ranked] == [
        (1, "best"),
        (1, "noisy"),
        (3, "worse"),
    ]


def test_a_profile_counts_pairs_within_a_factor_of_the_best():
    table = tidy(
        "value",
        {"a": {"x": [1.0, 2.0], "y": [4.0, np.nan]}, "b": {"x": [2.0, 1.0], "y": [np.nan, np.nan]}},
    )
    shares = profile(table, (1.0, 2.0))
    assert shares.loc[1.0].to_dict() == {"a": 0.5, "b": 0.25}
    assert shares.loc[2.0].to_dict() == {"a": 0.75, "b": 0.5}
    assert profile(
        tidy("value", {"b": {"x": [1.0]}, "a": {"x": [2.0]}}), (1.0,)
    ).columns.tolist() == ["b", "a"]
    for factors in ((0.5,), (0.5, 2.0)):
        with pytest.raises(ValueError, match=r"factors must be at least 1, got 0\.5"):
            profile(table, factors)


def test_halves_of_four_robots_differ_as_all_splits_say():
    """Two challenges repeat each other's scores, so a robot must be in the same half of both."""
    own = np.array([0.1, 0.2, 0.4, 0.8])
    found = resolution(
        tidy("score", {"a": {"x": own, "y": own}, "b": {"x": own - 0.1, "y": own - 0.1}})
    )
    halves = [list(half) for half in itertools.combinations(range(4), 2)]
    # The middle two of four scores that come in pairs are one of either pair: their mean is that of both robots.
    differences = [abs(own[half].mean() - np.delete(own, half).mean()) for half in halves]
    assert found == pytest.approx(np.median(differences))


def test_two_robots_are_the_least_that_have_halves():
    assert resolution(tidy("score", {"a": {"x": [0.1, 0.4]}})) == pytest.approx(0.3)
    with pytest.raises(ValueError, match="each challenge needs at least two robots"):
        resolution(tidy("score", {"a": {"x": [0.1, 0.4], "y": [0.2]}}))


def test_the_resolution_is_near_that_of_normal_means():
    """Halves of n independent scores differ by a median of 0.6745 · 2 s / √n, s that of the interquartile mean."""
    sample = np.random.default_rng(3).uniform(0.0, 1.0, (6, 400))
    found = resolution(tidy("score", {str(k): {"x": row} for k, row in enumerate(sample)}))
    # asymptotic variance of the 25 % trimmed mean of uniform scores: (E[winsorised²]) / (1 − 2 α)² = (1/24) / (1/4)
    winsorised = np.clip(sample, 0.25, 0.75).var()
    assert found == pytest.approx(0.6745 * 2.0 * np.sqrt(winsorised / 0.25 / 400), rel=0.15)


def test_an_incomplete_table_is_refused():
    table = tidy("score", {"a": {"x": [0.1, 0.2]}, "b": {"x": [0.3, 0.4]}})
    for wrong, message in (
        (table.iloc[:-1], "b lacks the score of challenge x, seed 1: methods need the same runs"),
        (
            table.assign(score=[0.1, 0.2, np.nan, np.nan]),
            "b lacks the score of challenge x, seed 0",
        ),
        (
            pd.concat([table, table.iloc[-1:]]),
            "b has several runs of challenge x, seed 1: keep one",
        ),
        (table.iloc[:0], "table must hold at least one run"),
    ):
        with pytest.raises(ValueError, match=message):
            ranking(wrong)
