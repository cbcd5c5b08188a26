"""Tables of runs whose answer is known."""

import json

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy import stats
from statsmodels.stats.multitest import multipletests

from kit import folders
from kit.command import python, servobench
from kit.folders import comparison, failed_only, made_up_row, sweep, write_folder
from servobench.harness.analysis.comparison import Estimate, split_conditions, split_tasks
from servobench.harness.analysis.tables import (
    Cell,
    Selection,
    curve_tables,
    judge_places,
    outcome_legend,
    overview,
    summary_legend,
    summary_tables,
    sweep_tables,
)
from servobench.harness.batch import results
from servobench.harness.cli import terminal


@pytest.fixture
def runs() -> pd.DataFrame:
    rows = []
    for seed in range(20):
        for name, time in (("quick", 1.0 + 0.01 * seed), ("slow", 2.0 + 0.02 * seed)):
            late, lost = name == "slow" and seed < 4, name == "slow" and seed == 3
            values = {
                "settling_time_s": np.nan if late else time,
                "steady_state_error": 0.001 * (1 + seed),
            }
            values["status"] = "feature_lost" if lost else "completed"
            rows.append(
                made_up_row(f"{name}-{seed}", controller=name, task="random", seed=seed, **values)
            )
    return pd.DataFrame(rows)


def choosing(runs, **further):
    """Select all controllers of some runs."""
    return Selection({name: name for name in runs["controller"].unique()}, **further)


def judge_controllers(runs):
    """Return the first table of statistics."""
    return next(judge_places(runs).tables())[1]


def compare_controllers(runs, metric=None):
    """Return the table of pairs of one place."""
    _, (title, pairs) = judge_places(runs, choosing(runs, metric=metric)).tables()
    margin = "0.2 mm" if (runs["task_kind"] == "curve").all() else "0.05 s"
    assert title.startswith(
        f"paired differences, verdicts with a margin of {margin}; the runs can tell "
    )
    return pairs


def test_each_controller_has_rates_medians_tails_and_failures(runs):
    quick, slow = judge_controllers(runs).to_dict("records")
    assert quick["settled [%]"] == "100.0 [83.9, 100.0]"  # Wilson: 1/(1 + 1.96²/20)
    assert quick["settling time [s]"].startswith("1.09 [") or quick["settling time [s]"].startswith(
        "1.10 ["
    )
    assert quick["its worst 5 % [mm]"] == "20.0"
    assert quick["failures"] == "none"
    assert slow["settled [%]"].startswith("80.0 [")
    assert slow["its worst 5 % [mm]"] == "∞"
    assert slow["failures"] == "3 not_settled, 1 feature_lost"


def test_pairs_are_compared_on_common_seeds(runs):
    (row,) = compare_controllers(runs).to_dict("records")
    assert row["A − B"] == "quick − slow"
    assert row["runs lost"] == "0 : 4"
    assert row["mean difference in settling time [s]"].startswith("-1.1")
    assert row["verdict"] == "better"
    assert row["P(A better)"] == "1.00 [0.84, 1.00]"
    assert len(list(judge_places(runs[runs["controller"] == "quick"]).tables())) == 1


def test_on_a_curve_pairs_are_compared_by_the_error_along_it(runs):
    better = runs["controller"] == "quick"
    curve = runs.assign(
        task_kind="curve", rms_error_evaluated=np.where(better, 0.002, 0.0035), status="completed"
    )
    (row,) = compare_controllers(curve).to_dict("records")
    assert row["mean difference in RMS error of the judged part [mm]"] == "-1.50 [-1.50, -1.50]"
    assert row["verdict"] == "better"


def test_a_measure_of_moves_is_compared_where_there_are_moves(runs):
    curve = runs.assign(task="circle", task_kind="curve", overshoot=np.nan)
    both = pd.concat([runs, curve]).assign(status="completed")
    move, circle = judge_places(both, choosing(runs, metric="overshoot")).places
    assert [row["verdict"].value for row in move.pairs] == ["equivalent"]
    assert (len(circle.controllers), circle.pairs) == (2, [])


def test_sequences_are_judged_by_their_later_moves_as_in_the_suite(runs):
    later = np.where(runs["controller"] == "quick", 1.5, 1.0)
    tour = runs.assign(task_kind="sequence", settling_time_later_s=later, status="completed")
    assert set(judge_controllers(tour)["later moves [s]"].str[:4]) == {"1.50", "1.00"}
    (row,) = compare_controllers(tour).to_dict("records")
    assert row["mean difference in later moves [s]"] == "0.50 [0.50, 0.50]"
    assert (row["runs lost"], row["verdict"]) == ("0 : 0", "worse")


def test_a_run_without_a_value_is_worse_than_all_that_have_one(runs):
    late = runs.assign(
        settling_time_s=runs["settling_time_s"] + np.where(runs["controller"] == "quick", 30.0, 0.0)
    )
    few = late[late["seed"] < 8]  # of which the slow one settles in four
    (row,) = compare_controllers(few).to_dict("records")
    assert row["mean difference in settling time [s]"].startswith("28.9")
    assert (row["runs lost"], row["P(A better)"][:4]) == ("0 : 4", "0.50")


def test_the_last_table_of_a_comparison_has_no_time_of_runs_that_ended_early(runs):
    early = runs.assign(status="feature_lost", settling_time_s=0.3)
    ((_, table),) = summary_tables(early)
    assert set(table["settling time [s]"]) == {"–"}


def test_of_a_measure_without_a_good_direction_the_verdict_is_less_or_more(runs):
    runs["max_joint_position_rad"] = (
        np.where(runs["controller"] == "quick", 1.0, 2.0) + 0.001 * runs["seed"]
    )
    (_, _), (_, pairs) = judge_places(
        runs, choosing(runs, metric="max_joint_position_rad")
    ).tables()
    assert pairs["verdict"].tolist() == ["less"]
    assert "P(A less)" in pairs


def test_a_median_over_many_conditions_is_one_over_runs_and_has_no_interval(runs):
    runs["status"] = "completed"
    many = [
        runs.assign(mismatch=f"links={each}%", settling_time_s=each / 10.0) for each in range(1, 6)
    ]
    lost = runs.assign(mismatch="severe", settling_time_s=np.nan)
    table = overview(pd.concat([*many, lost]))
    assert table["random", "settling time [s]"].tolist() == ["0.35", "0.35"]
    both = pd.concat([*many, lost, *(each.assign(feature_unit="px") for each in many)])
    assert {place for place, _ in overview(both)} == {
        "",
        "random, features in m",
        "random, features in px",
    }


@pytest.fixture
def three(runs):
    """Runs of three controllers on two tasks: `odd` is a little faster than `quick` on 14 of 20 robots."""
    quick = runs[runs["controller"] == "quick"]
    gain = np.where(quick["seed"] % 10 < 7, 0.02, -0.02)
    odd = quick.assign(controller="odd", settling_time_s=quick["settling_time_s"] - gain)
    one = pd.concat([runs, odd])
    return pd.concat([one, one.assign(task="exp2")])


def test_p_values_are_corrected_over_the_pairs_that_are_shown(three):
    for selection, names in (
        (None, ["quick − slow", "quick − odd", "slow − odd"]),
        (choosing(three, against="odd"), ["odd − quick", "odd − slow"]),
        (Selection({"odd": "Mine", "slow": "slow"}), ["Mine − slow"]),
    ):
        found = judge_places(three, selection)
        rows = [row for place in found.places for row in place.pairs]
        assert [str(row["A − B"]) for row in rows] == 2 * names
        p_values = [row["p (Holm)"].value for row in rows]
        corrected = multipletests([each.p for each in p_values], method="holm")[1]
        assert [each.holm for each in p_values] == corrected.tolist()
        assert f"over the {2 * len(names)} verdicts shown, 6 in this folder" in found.legend
    (row, _) = (row for row in rows if str(row["A − B"]) == "Mine − slow")
    assert row["p (Holm)"].plain() == {"p": 2.0**-19, "holm": 2.0**-18}
    assert str(row["p (Holm)"]) == "<0.001 (<0.001)"
    (place, _) = judge_places(three, choosing(three, against="odd")).places
    p_value = place.pairs[0]["p (Holm)"].value.p
    assert p_value == stats.binomtest(14, 20).pvalue
    assert str(place.pairs[0]["p (Holm)"]) == f"{p_value:.3f} ({2 * p_value:.3f})"


def test_controllers_are_shown_in_the_order_and_by_the_names_that_are_given(three):
    shown = judge_places(three, Selection({"slow": "Old", "quick": "New"}))
    for place in shown.places:
        assert [str(row["controller"]) for row in place.controllers] == ["Old", "New"]


def test_a_margin_and_a_verdict_do_not_depend_on_what_is_shown(three):
    known = three.assign(
        controller=three["controller"].replace("slow", "calibrated"), task_kind="curve",
        rms_error_evaluated=three["settling_time_s"].fillna(5.0), status="completed",
    )  # fmt: skip
    some = Selection({"quick": "quick", "odd": "odd"})
    (margin, _), (other, _) = (
        [place.margin for place in judge_places(known, selection).places]
        for selection in (None, some)
    )
    assert margin == other
    assert margin != "0.2 mm"


def test_a_verdict_that_the_signs_do_not_show_is_one_on_average(three):
    gain = np.where(three["seed"] < 12, 2.0, -0.04)
    three["settling_time_s"] -= gain * (three["controller"] == "odd")
    (place, _) = judge_places(
        three, choosing(three, metric="settling_time_s", against="odd")
    ).places
    assert str(place.pairs[0]["verdict"]) == "better on average"
    three["max_joint_position_rad"] = three["settling_time_s"]
    (place, _) = judge_places(
        three, choosing(three, metric="max_joint_position_rad", against="odd")
    ).places
    assert str(place.pairs[0]["verdict"]) == "less on average"


def test_a_period_that_is_set_is_the_margin_of_times(tmp_path, monkeypatch):
    monkeypatch.setitem(folders.MANIFEST, "changed", {"run.period": 0.2})
    loaded = results.load_runs(sweep(tmp_path / "sweep"))
    assert loaded["period_s"].unique().tolist() == [0.2]
    assert "margin of 0.2 s" in [title for title, _ in judge_places(loaded).tables()][1]


def test_conditions_are_told_apart_in_words(runs):
    usual, loud = (
        runs.assign(noise_factor=1.0, latency_s=None),
        runs.assign(noise_factor=2.0, latency_s=0.15),
    )
    older = runs.assign(mismatch="none")  # without the columns of both
    assert [words for words, _ in split_conditions(pd.concat([usual, older, loud]))] == [
        "random on kinematic, moderate",
        "random on kinematic, none",
        "random on kinematic, moderate, noise × 2, latency 150 ms",
    ]


@pytest.mark.parametrize(
    ("option", "word"), [((), "quick"), (("--markdown",), "| quick | 20 | 100.0 [83.9, 100.0] |")]
)
def test_the_command_prints_the_tables_of_a_folder(output_of, runs, tmp_path, option, word):
    folder = write_folder(tmp_path / "out", runs.to_dict("records"), [])
    assert word in output_of("statistics", folder, *option)


def test_the_name_of_a_sensing_set_up_is_no_emoji(capsys):
    terminal.print_tables(
        [("random on kinematic pixel:hand: settled", pd.DataFrame({"a": ["pixel:hand:"]}))]
    )
    printed = capsys.readouterr().out
    assert printed.count("pixel:hand:") == 2


def test_a_command_whose_output_nobody_reads_any_more_does_its_work_silently():
    code = """
import os
from servobench.harness.cli.terminal import say
read, write = os.pipe()
os.dup2(write, 1)
os.close(read)
say("lost")
say("lost")
os.write(2, b"drawn")
"""
    ended = python("-c", code)
    assert (ended.returncode, ended.stderr) == (0, "drawn")


@pytest.mark.parametrize("room", [60, 80, 100, 200])
def test_no_word_of_a_table_is_cut_however_narrow_the_terminal_is(runs, monkeypatch, capsys, room):
    named = runs.replace({"controller": {"slow": "rbfnn_mfac:published"}})
    tables = [
        ("a title", judge_controllers(named)),
        ("paired differences", compare_controllers(named)),
    ]
    monkeypatch.setattr(terminal, "console", Console(width=room))
    terminal.print_tables(tables, "a legend")
    text = capsys.readouterr().out
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= room
    for _, table in tables:
        words = " ".join([*table.columns, *table.astype(str).to_numpy().ravel()]).split()
        assert set(words) <= set(text.split())
    assert text.count("a title") == text.count("a legend") == 1
    assert text.count("rbfnn_mfac:published") == {60: 4, 80: 3}.get(room, 2)


@pytest.mark.parametrize("third", ["latency [ms]", "plant.lag"])
def test_a_row_says_in_each_part_of_a_wide_table_what_it_is_about(monkeypatch, capsys, third):
    names = [f"a_controller_{i}" for i in range(6)]
    conditions = [
        ("moderate+camera_rotation=60deg", noise, latency)
        for noise in "014"
        for latency in ("0", "100")
    ]
    rows = [dict(zip(("mismatch", "noise factor", third), key, strict=True)) | dict.fromkeys(names, "100.0")
            for key in conditions]  # fmt: skip
    monkeypatch.setattr(terminal, "console", Console(width=80))
    terminal.print_tables([("a title", pd.DataFrame(rows))])
    lines = [tuple(line.split()) for line in capsys.readouterr().out.splitlines() if "deg" in line]
    parts = len(lines) // len(rows)
    assert parts > 1
    assert [line[:3] for line in lines] == parts * conditions


def test_errors_are_shown_in_the_unit_of_the_feature(runs):
    radians = runs.assign(feature_unit="rad")
    assert judge_controllers(radians)["its worst 5 % [rad]"].tolist() == ["0.0", "∞"]


def test_a_comparison_ends_with_a_table_for_each_task(tmp_path):
    runs = results.load_runs(comparison(tmp_path / "out"))
    titles, tables = zip(*summary_tables(runs), strict=True)
    assert titles == tuple(f"{task} on kinematic, moderate" for task in ("exp1", "exp2", "circle"))
    assert tables[0].iloc[0].tolist() == ["rbfnn_mfac", "settled", "1.50", "2", "1.0", "3", "130"]
    assert tables[2].iloc[0].tolist() == ["rbfnn_mfac", "followed", "2.0", "–", "3", "130"]


def test_a_controller_slower_than_the_period_is_marked_and_counted():
    rows = [
        made_up_row("a", controller="slow", controller_time_overruns=7.0),
        made_up_row("b", controller="quick"),
    ]
    runs = pd.DataFrame(rows)
    ((_, table),) = summary_tables(runs)
    assert table["step, median [µs]"].tolist() == ["130*", "130"]
    assert summary_legend(runs).endswith(
        "\n* some steps took longer than the period; simulated time waits"
    )
    assert "*" not in summary_legend(runs.tail(1))


def test_the_judged_part_is_named_for_each_curve_and_that_of_a_users_task_is_its_own():
    curves = pd.DataFrame(
        [
            made_up_row(task, task=task, task_kind="curve")
            for task in ("circle", "line", "Spiral", "waypoints")
        ]
    )
    assert summary_legend(curves).splitlines()[1] == (
        "judged part of circle: the last lap; judged part of line, waypoints: the second half; "
        "judged part of Spiral: from the time that its code sets as evaluate_from"
    )


def test_the_outcomes_of_several_runs_are_shares():
    words = ["settled", "settled", "target_unreachable", "settled"]
    runs = pd.DataFrame([made_up_row(str(i), seed=i, outcome=word) for i, word in enumerate(words)])
    ((_, table),) = summary_tables(runs)
    assert table["outcome"].tolist() == ["75 % settled\n25 % target_unreachable"]
    assert judge_controllers(runs)["failures"].tolist() == ["1 target_unreachable"]


def test_runs_that_never_settled_are_in_the_median_of_the_summary(runs):
    runs.loc[runs["seed"] < 12, "settling_time_s"] = np.nan
    runs.loc[runs["seed"] == 4, ["status", "settling_time_s"]] = ["collision", 0.2]
    ((_, table),) = summary_tables(runs)
    assert table["settling time [s]"].tolist() == ["∞", "∞"]


def test_an_endless_curve_tells_its_second_lap_and_its_joints():
    laps = {"rms_error_second_lap": 0.003, "max_joint_position_rad": 2.345, "task_kind": "curve"}
    runs = pd.DataFrame(
        [made_up_row("a", task="endurance", settling_time_s=np.nan, outcome="followed", **laps)]
    )
    ((_, table),) = summary_tables(runs)
    second, judged, joints = (
        "RMS error of the second lap [mm]", "RMS error of the judged part [mm]", "largest joint position [rad]",
    )  # fmt: skip
    assert table[[second, judged, joints]].iloc[0].tolist() == ["3.0", "2.0", "2.35"]
    ((_, short),) = summary_tables(runs.assign(rms_error_second_lap=runs["rms_error_evaluated"]))
    assert second not in short  # of two laps, the second one is the judged one
    assert (
        second
        not in curve_tables(runs.assign(rms_error_second_lap=0.002))["endurance"]["RMS error"]
    )


def test_the_legend_tells_the_band_of_the_feature(runs):
    banded = runs.assign(settling_band=0.02)
    assert outcome_legend([banded]) == "settled: came within 20 mm and stayed"
    curve = banded.assign(feature_unit="px", settling_band=2.0, task_kind="curve")
    assert outcome_legend([curve]) == "followed: RMS error of the judged part at most 4 px"
    assert "within the settling band" in outcome_legend([banded, runs.assign(settling_band=0.005)])


def test_a_sweep_ends_with_the_share_of_settled_runs_in_each_condition(tmp_path):
    runs = results.load_runs(sweep(tmp_path / "out"))
    wanted = runs[runs["run_id"] != "someone_elses-60-0"].assign(latency_s=None)
    (title, table), (second, kinds) = sweep_tables([wanted.iloc[:7], wanted.iloc[7:]])
    assert second == "random on kinematic: outcomes of the runs [%]"
    assert kinds.columns.tolist() == ["controller", "settled", "feature_lost"]
    assert kinds[["settled", "feature_lost"]].values.tolist() == [
        ["72.2", "27.8"],
        ["72.2", "27.8"],
        ["76.5", "23.5"],
    ]
    assert title == "random on kinematic: settled [%]"
    assert table.values.tolist() == [
        ["camera_rotation=0deg", "1", "–", "100.0", "100.0", "100.0", "6"],
        ["camera_rotation=30deg", "1", "–", "66.7", "66.7", "66.7", "6"],
        ["camera_rotation=60deg", "1", "–", "50.0", "50.0", "60.0", "6"],
    ]
    assert dict(sweep_tables([wanted.drop(columns="latency_s")]))[title].equals(table)


def test_moves_and_curves_are_told_apart_and_tasks_that_nobody_began_are_neither(tmp_path):
    moves, curves = split_tasks(results.load_runs(comparison(tmp_path / "a")))
    assert set(moves["task"]) == {"exp1", "exp2"}
    assert set(curves["task"]) == {"circle"}
    assert [len(part) for part in split_tasks(results.load_runs(failed_only(tmp_path / "b")))] == [
        0,
        0,
    ]


def test_statistics_are_there_for_programs(monkeypatch, capsys, tmp_path, runs):
    folder = write_folder(tmp_path / "out", runs.to_dict("records"), [])
    assert servobench(monkeypatch, "statistics", str(folder), "--json") == 0
    (place,) = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    quick, slow = place["controllers"]
    settled = slow["settled [%]"]
    assert (slow["controller"], slow["runs"], settled["value"], settled["count"]) == (
        "slow",
        20,
        80.0,
        20,
    )
    assert quick["settled [%]"]["low"] == pytest.approx(83.9, abs=0.05)
    assert slow["its worst 5 % [mm]"] == "inf"
    (pair,) = place["pairs"]
    assert pair["mean difference in settling time [s]"]["value"] < -1.0
    assert (pair["runs lost"], pair["verdict"], pair["margin"]) == ("0 : 4", "better", "0.05 s")


def test_a_number_that_there_is_not_is_null_for_programs():
    nothing = {"value": None, "low": None, "high": None, "count": 0}
    assert Cell(Estimate(np.nan, np.nan, np.nan, 0), ".1f").plain() == nothing


def test_times_that_are_not_known_are_a_dash_in_the_summary(tmp_path):
    runs = results.load_runs(sweep(tmp_path / "out")).assign(controller_time_median_us=np.nan)
    assert [str(table["step, median [µs]"].iloc[0]) for _, table in summary_tables(runs)] == [
        "–"
    ] * 3
