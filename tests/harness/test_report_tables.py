from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from kit.folders import comparison, failed_only, made_up_row, sweep
from servobench.harness.analysis.report_tables import (
    cost_table,
    describe_folder,
    failure_table,
    other_tables,
    runs_table,
    settling_table,
    split_tasks,
    tracking_table,
)
from servobench.harness.batch import results


def test_a_move_that_never_settled_counts_as_one_that_settles_after_all_others():
    runs = pd.DataFrame(
        [made_up_row(str(seed), seed=seed, settling_time_s=time) for seed, time in enumerate((1.0, 2.0, np.nan))]
    )
    assert settling_table(runs)["settling [s]"].tolist() == [2.0]
    runs["settling_time_s"] = [1.0, np.nan, np.nan]
    assert settling_table(runs)["settling [s]"].tolist() == [np.inf]


def test_a_run_that_ended_early_counts_as_not_settled():
    runs = pd.DataFrame([made_up_row("a"), made_up_row("b", seed=1, status="feature_lost")])
    table = settling_table(runs)
    assert table[["moves", "settled", "settled [%]"]].values.tolist() == [[2, 1, 50]]


def test_moves_and_curves_are_told_apart_and_tasks_that_nobody_began_are_neither(tmp_path):
    moves, curves = split_tasks(results.load_runs(comparison(tmp_path / "a")))
    assert set(moves["task"]) == {"exp1", "exp2"}
    assert set(curves["task"]) == {"circle"}
    assert [len(part) for part in split_tasks(results.load_runs(failed_only(tmp_path / "b")))] == [0, 0]


def test_a_row_of_the_settling_table_is_in_handy_units():
    runs = pd.DataFrame([made_up_row(str(seed), seed=seed, settling_time_s=1.0 + seed) for seed in range(3)])
    row = settling_table(runs).iloc[0]
    assert row["settling [s]"] == 2.0
    assert row["overshoot [%]"] == 2.0
    assert row["last second [mm]"] == 1.0
    assert "–" in row["settling, 95 %"]


def test_only_conditions_that_vary_get_a_column(tmp_path):
    table = settling_table(results.load_runs(sweep(tmp_path / "out")))
    assert "latency_periods" in table
    assert "noise_factor" not in table
    assert len(table) == 3 * 3 * 2


def test_curves_are_judged_by_task(tmp_path):
    table = tracking_table(results.load_runs(comparison(tmp_path / "out")))
    assert table["task"].unique().tolist() == ["circle"]
    assert table["RMS, evaluated part [mm]"].tolist() == [2.0] * 3


def test_failures_are_counted_with_a_reason(tmp_path):
    table = failure_table(results.load_runs(sweep(tmp_path / "out")))
    assert table["runs"].tolist() == ["5 of 18"] * 3
    assert table["reason"].tolist() == ["no valid feature for 20 periods"] * 3
    assert failure_table(pd.DataFrame([made_up_row("a")])).empty


@pytest.mark.parametrize("folder", [comparison, sweep, failed_only])
def test_every_table_can_be_made_of_every_kind_of_folder(tmp_path, folder):
    path = folder(tmp_path / "out")
    runs = results.load_runs(path)
    for table in (cost_table(runs), runs_table(runs)):
        assert len(table) > 0
    assert f"**{len(runs)} run" in describe_folder(path, runs)


def test_a_long_reason_is_shortened_in_the_table_of_runs():
    table = runs_table(pd.DataFrame([made_up_row("a", reason="x" * 200)]))
    assert table["reason"][0] == "x" * 59 + "…"


def test_further_tables_of_a_folder_are_found(tmp_path):
    folder = comparison(tmp_path / "out")
    pd.DataFrame({"claim": [1]}).to_csv(folder / "claims.csv", index=False)
    assert [name for name, _ in other_tables(folder)] == ["claims"]
