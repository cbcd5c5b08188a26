"""Judging controllers on a table of runs whose answer is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from kit.command import servobench
from servobench.harness.analysis.judgement import compare_controllers, judge_controllers, places
from servobench.harness.batch import results
from servobench.harness.config.settings import ConfigurationError


@pytest.fixture
def runs() -> pd.DataFrame:
    rows = []
    for seed in range(20):
        for name, time in (("quick", 1.0 + 0.01 * seed), ("slow", 2.0 + 0.02 * seed)):
            lost = name == "slow" and seed == 3
            rows.append(
                {
                    "run_id": f"{name}-{seed}", "plant": "kinematic", "controller": name, "task": "random",
                    "mismatch": "moderate", "seed": seed, "noise_factor": 1.0, "latency_periods": None,
                    "status": "feature_lost" if lost else "completed",
                    "settling_time_s": np.nan if name == "slow" and seed < 4 else time,
                    "overshoot": 0.1, "rms_error_evaluated": 0.002, "steady_state_error": 0.001 * (1 + seed),
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def test_each_controller_has_rates_medians_tails_and_failures(runs):
    quick, slow = judge_controllers(runs).to_dict("records")
    assert quick["settled, %"] == "100.0 [83.9, 100.0]"  # Wilson: 1/(1 + 1.96²/20)
    assert quick["settling time, s"].startswith("1.09 [") or quick["settling time, s"].startswith("1.10 [")
    assert quick["worst 5 %, mm"] == "20.0"
    assert quick["failures"] == "none"
    assert slow["settled, %"].startswith("80.0 [")
    assert slow["worst 5 %, mm"] == "inf"
    assert slow["failures"] == "3 not_settled, 1 feature_lost"


def test_pairs_are_compared_on_common_seeds(runs):
    (row,) = compare_controllers(runs, never=10.0).to_dict("records")
    assert row["pair"] == "quick − slow"
    assert row["pairs"] == "20"
    assert row["difference in settling time, s"].startswith("-1.1")
    assert float(row["p after Holm"]) < 0.001
    assert compare_controllers(runs[runs["controller"] == "quick"], never=10.0).empty


def test_on_a_curve_pairs_are_compared_by_the_error_along_it(runs):
    better = runs["controller"] == "quick"
    curve = runs.assign(overshoot=np.nan, rms_error_evaluated=np.where(better, 0.002, 0.0035), status="completed")
    (row,) = compare_controllers(curve).to_dict("records")
    assert row["difference in rms error evaluated, mm"] == "-1.50 [-1.50, -1.50]"


def test_a_run_without_a_value_is_worse_than_all_that_have_one(runs):
    late = runs.assign(settling_time_s=runs["settling_time_s"] + np.where(runs["controller"] == "quick", 30.0, 0.0))
    few = late[late["seed"] < 4]  # of which the slow one settles in none
    (row,) = compare_controllers(few).to_dict("records")
    assert row["difference in settling time, s"].startswith("-31.0")


def test_an_unknown_metric_is_told_in_one_line(runs):
    with pytest.raises(ConfigurationError, match="no column of numbers 'settling_time': .*settling_time_s"):
        compare_controllers(runs, "settling_time")


def test_conditions_are_told_apart_in_words(runs):
    loud = runs.assign(noise_factor=2.0, latency_periods=3)
    assert [words for words, _ in places(pd.concat([runs, loud]))] == [
        "random on kinematic, moderate",
        "random on kinematic, moderate, noise × 2, latency 3 periods",
    ]


@pytest.mark.parametrize(("option", "word"), [((), "quick"), (("--markdown",), "| quick | 20 | 100.0 [83.9, 100.0] |")])
def test_the_command_prints_the_tables_of_a_folder(runs, tmp_path, monkeypatch, capsys, option, word):
    folder = tmp_path / "out"
    results.create_folder(folder, {})
    results.write_rows(folder, 0, runs.to_dict("records"))
    results.collect(folder)
    assert servobench(monkeypatch, "statistics", str(folder), *option) == 0
    assert word in capsys.readouterr().out
