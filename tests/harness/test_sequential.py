"""Bets on bounded paired differences: exact sums over all outcomes, and what is said of planted cases."""

import itertools

import numpy as np
import pytest

from servobench.harness.analysis.sequential import CLIP, PARTS, WEIGHTS, decide, log_wealth

LOOKS = [*range(16, 200, 16), 200]
NEVER = float("nan")


def sequences(length):
    """Return all sequences of -1 and 1, and a function from a mean to the probability of each."""
    all_of_them = np.array(list(itertools.product([-1.0, 1.0], repeat=length)))
    ups = (all_of_them > 0.0).sum(axis=1)

    def probabilities(mean):
        up = 0.5 * (1.0 + mean)
        return up**ups * (1.0 - up) ** (length - ups)

    return all_of_them, probabilities


def test_the_wealth_is_the_weighted_mean_of_products():
    values = np.array([1.0, -0.5, np.nan, 0.25])
    wanted = sum(
        weight * np.prod([1.0 + part / 1.2 * (x - 0.2) for x in (1.0, -0.5, 0.25)])
        for part, weight in zip(PARTS, WEIGHTS, strict=True)
    )
    found = log_wealth(values, 0.2)
    assert np.exp(found[-1]) == pytest.approx(wanted)
    assert found[1] == found[2]
    assert sum(WEIGHTS) == 1.0


@pytest.mark.parametrize("bound", [-0.2, 0.0, 0.2])
def test_nobody_gets_richer_on_average_where_the_mean_is_the_bound(bound):
    """The sum over all 1024 outcomes is exact; below the bound the gambler loses, above it he wins."""
    values, probabilities = sequences(10)
    wealth = np.exp(log_wealth(values, bound)[:, -1])
    assert probabilities(bound) @ wealth == pytest.approx(1.0, abs=1e-12)
    assert probabilities(bound - 0.1) @ wealth < 1.0
    assert probabilities(bound + 0.1) @ wealth > 1.0


@pytest.mark.parametrize("level", [0.05, 0.2, 0.5])
def test_the_wealth_ever_reaches_one_over_the_level_as_rarely_as_ville_says(level):
    values, probabilities = sequences(14)
    ever = (log_wealth(values, 0.2) >= np.log(1.0 / level)).any(axis=1)
    chance = float(probabilities(0.2) @ ever)
    assert 0.0 < chance <= level


def test_of_two_bets_on_one_side_that_with_the_harder_bound_is_never_richer():
    values = np.random.default_rng(4).uniform(-1.0, 1.0, (200, 30))
    wealths = [log_wealth(values, bound) for bound in (-0.2, -0.1, 0.0, 0.2)]
    for easier, harder in itertools.pairwise(wealths):
        assert (easier >= harder).all()


def test_methods_are_equivalent_only_once_lost_runs_are_shown_to_differ_little():
    """Without a lost run, so that fewer robots say nothing of one in ten."""
    first, second = drawn(0.0, 0.1)
    found = decide(first, second, 1.0, 0.05, range(1, 201))
    assert found.verdict == "equivalent"
    assert 0.9**found.robots < 0.05
    late = decide(first, np.where(np.arange(200) < 3, np.inf, second), 1.0, 0.05, range(1, 201))
    assert late.robots > 100


def drawn(mean, deviation, count=200, seed=0):
    """Return values of two methods whose difference has this mean and deviation, in margins."""
    rng = np.random.default_rng(seed)
    second = rng.normal(20.0, 3.0, count)
    return second + rng.normal(mean, deviation, count), second


@pytest.mark.parametrize(
    ("mean", "verdict"),
    [(0.0, "equivalent"), (0.4, "equivalent"), (3.0, "worse"), (-3.0, "better")],
)
def test_methods_that_differ_clearly_are_told_long_before_the_budget(mean, verdict):
    for seed in range(5):
        found = decide(*drawn(mean, 1.0, seed=seed), 1.0, 0.05, LOOKS)
        assert found.verdict == verdict
        assert found.robots < 100
        assert not found.told_by_lost


def test_a_difference_of_one_margin_is_hardly_ever_told():
    """Both *worse* and *equivalent* are false there."""
    verdicts = [decide(*drawn(1.0, 1.0, seed=seed), 1.0, 0.05, LOOKS) for seed in range(200)]
    false = sum(each.verdict != "undecided" for each in verdicts)
    assert false <= 10
    assert all(each.robots == 200 for each in verdicts if each.verdict == "undecided")


def test_of_equal_methods_hardly_any_is_called_better_however_often_one_looks():
    false = 0
    for seed in range(300):
        found = decide(*drawn(0.0, 8.0, seed=seed), 1.0, 0.05, range(1, 201))
        false += found.verdict in ("better", "worse")
    assert false <= 15


def test_lost_runs_alone_are_told_and_never_called_equivalent_where_they_differ():
    first, second = drawn(0.0, 0.5)
    second[::6] = NEVER
    found = decide(first, second, 1.0, 0.05, LOOKS)
    assert (found.verdict, found.told_by_lost) == ("better", True)
    assert found.lost[0] == 0
    assert decide(second, first, 1.0, 0.05, LOOKS).verdict == "worse"
    rarely = decide(first, np.where(np.arange(200) % 25 == 3, np.inf, second), 1.0, 0.05, [200])
    assert rarely.verdict != "equivalent"


def test_the_mean_does_not_decide_for_the_method_that_loses_more_runs():
    first, second = drawn(-3.0, 0.5)
    first[[3, 9]] = NEVER
    assert decide(first, second, 1.0, 0.05, [64]).verdict == "undecided"
    assert decide(*drawn(-3.0, 0.5), 1.0, 0.05, [64]).verdict == "better"


def test_a_few_large_differences_do_not_decide_and_do_not_count_as_equivalent():
    first, second = drawn(0.0, 0.1)
    first[::10] += 100.0  # a mean of 10 margins; of 0.5 where each is clipped
    found = decide(first, second, 1.0, 0.05, LOOKS)
    assert found.verdict == "undecided"
    assert found.mean == pytest.approx(CLIP / 10.0, abs=0.05)


def test_what_comes_after_the_look_that_decides_changes_nothing():
    first, second = drawn(3.0, 1.0)
    found = decide(first, second, 1.0, 0.05, LOOKS)
    assert found.robots < 200
    first[found.robots :] -= 50.0
    assert decide(first, second, 1.0, 0.05, LOOKS) == found


def test_without_a_margin_or_a_look_nothing_is_decided():
    first, second = drawn(3.0, 1.0)
    assert decide(first, second, 0.0, 0.05, LOOKS).verdict == "undecided"
    nothing = decide(first, second, 1.0, 0.05, [])
    assert (nothing.verdict, nothing.robots) == ("undecided", 0)
    alike = decide(np.full(20, np.inf), np.full(20, NEVER), 1.0, 0.05, [20])
    assert (alike.verdict, alike.lost) == ("undecided", (20, 20))
