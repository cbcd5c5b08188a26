"""The audit of a suite, on made-up scores whose findings are known."""

import numpy as np
import pandas as pd
import pytest

from kit.command import servobench
from servobench.harness.apps.studies.audit import (
    AUDIT,
    PROBES,
    audit,
    dependence,
    find_shortcuts,
    mark_solved,
    name_of,
    overfitting,
    significance,
)
from servobench.harness.apps.studies.challenge import find_challenge
from servobench.harness.apps.studies.suite import bounded

WORLDS = [find_challenge(name) for name in ("severe", "gears50")]


def judged(seeds=range(20), **means):
    """Return scored runs: mean scores of a controller in both challenges, with small differences between robots."""
    rng = np.random.default_rng(0)
    rows = []
    for place, world in enumerate(WORLDS):
        for name, both in means.items():
            for seed in seeds:
                score = both[place] + rng.uniform(-0.01, 0.01)
                rows.append(
                    {"challenge": world.name, "plant": "kinematic", "controller": name, "seed": seed,
                     "score": score, "reference": 1.0, "solved": ""}
                )  # fmt: skip
    return pd.DataFrame(rows)


def test_a_challenge_that_a_shortcut_solves_is_named_and_leaves_the_ranking():
    runs = judged(
        a=(0.8, 0.9), b=(0.6, 0.5), constant=(0.41, 0.1), held=(0.0, 0.3), calibrated=(1.0, 1.0)
    )
    found = find_shortcuts(runs, WORLDS)
    assert found["solved"].tolist() == [True, False]
    assert found["shortcut"].tolist() == ["constant", "held"]
    assert found["best"].round(1).tolist() == [0.8, 0.9]
    marked = mark_solved(runs, WORLDS)
    assert set(marked.loc[marked["challenge"] == "severe", "solved"]) == {"constant"}
    assert set(bounded(marked)["challenge"]) == {"gears50"}


def test_claims_are_significant_where_robots_agree():
    apart, alike = judged(a=(0.9, 0.9), b=(0.6, 0.6)), judged(a=(0.5, 0.5), b=(0.5, 0.5))
    assert [each.numbers for each in significance(apart)] == ["2 of 2 (100 %)"] * 2
    assert [each.numbers for each in significance(alike)] == ["0 of 2 (0 %)"] * 2
    three = judged(a=(0.9, 0.9), b=(0.6, 0.6), c=(0.6, 0.6))
    assert [each.numbers for each in significance(three)] == ["2 of 4 (50 %)", "4 of 6 (67 %)"]


def test_a_method_that_is_better_where_it_was_tuned_is_found():
    fresh = judged(a=(0.5, 0.5), b=(0.5, 0.5))
    tuned = judged(range(10000, 10020), a=(0.6, 0.6), b=(0.5, 0.5))
    first, second = overfitting(fresh, tuned)
    assert (first.where, first.finding) == ("a", "higher where tuned")
    assert first.numbers.startswith("+0.1")
    assert second.finding == "no higher score"


def test_orders_in_kinds_of_tasks_are_compared():
    turned = list(dependence(judged(a=(0.9, 0.1), b=(0.5, 0.5), c=(0.4, 0.6)), WORLDS))
    assert (turned[0].where, turned[0].finding) == ("moves, curves", "order differs")
    assert turned[0].numbers == "Kendall's τ -1.00"
    assert [each.finding for each in turned[1:]] == ["unknown: a single one"] * 2
    same = next(dependence(judged(a=(0.9, 0.8), b=(0.5, 0.5)), WORLDS))
    assert same.finding == "same order"


def test_the_findings_are_one_table():
    runs = judged(a=(0.8, 0.9), b=(0.6, 0.5), calibrated=(1.0, 1.0), constant=(0.1, 0.1))
    found = audit(runs, runs, WORLDS)
    assert list(dict.fromkeys(found["diagnostic"])) == [
        "shortcut",
        "significance",
        "overfitting",
        "source",
    ]
    assert not found["where"].str.contains("calibrated").any()
    assert [name_of(each) for each in PROBES] == ["constant", "open_loop", "held"]


@pytest.mark.slow
def test_the_command_runs_shortcuts_and_tuning_robots(tmp_path, monkeypatch, capsys):
    out = tmp_path / "audited"
    words = (
        "suite",
        "--challenges",
        "severe",
        "--controllers",
        "broyden",
        "--seeds",
        "2",
        "--workers",
        "1",
    )
    assert servobench(monkeypatch, *words, "--audit", "--out", str(out)) == 0
    found = pd.read_csv(out / AUDIT)
    assert list(found["diagnostic"]) == [
        "shortcut",
        "overfitting",  # a single method makes no claim about ranks
        *["source"] * 3,
    ]
    tuned = pd.read_parquet(out / "tuned_on" / "severe" / "runs.parquet")
    assert set(tuned["seed"]) == {10000, 10001}
    assert "open_loop" in capsys.readouterr().out


def test_an_audit_that_ends_early_is_refused(refusal_of, tmp_path):
    told = refusal_of(
        "suite", "--audit", "--until-decided", "--seeds", "32", "--out", tmp_path / "none"
    )
    assert "--audit needs all robots" in told
