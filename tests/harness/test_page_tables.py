"""The tables of a page, whose answers are known."""

import numpy as np
import pandas as pd
import pytest

from kit.folders import comparison, failed_only, made_up_row, sweep
from servobench.controllers.aids import EQUIPPED
from servobench.harness.analysis import tables
from servobench.harness.analysis.folder import (
    describe_controllers,
    describe_folder,
    describe_settings,
)
from servobench.harness.analysis.verdict import leaders
from servobench.harness.apps.figures.measures import FIGURES
from servobench.harness.batch import results, store
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.run.metrics import METRICS


def moves(*times: float, **values: object) -> pd.DataFrame:
    rows = [
        made_up_row(str(seed), seed=seed, settling_time_s=time, **values)
        for seed, time in enumerate(times)
    ]
    return pd.DataFrame(rows)


def test_a_move_that_never_settled_counts_as_the_last_to_settle():
    (table,) = tables.move_tables(moves(1.0, 2.0, np.nan)).values()
    row = table.iloc[0]
    assert row["Runs", "number"] == "3"
    assert row["Runs", "settled [%]"] == "67 [21, 94]"  # Wilson
    assert row["Time", "settling time [s]"] == "2.00 [1.00, ∞]"
    assert row["Time", "overshoot [%]"] == "2.0 [2.0, 2.0]"
    assert row["Error", "error of the last second [mm]"] == "1.00 [1.00, 1.00]"


def test_beside_the_medians_of_computing_times_stands_the_share_of_lost_runs():
    lost = moves(1.0, 2.0, np.nan).assign(outcome=["settled", "settled", "not_settled"])
    assert tables.cost_table(lost)["Runs", "lost [%]"].tolist() == ["33"]


def test_a_single_run_has_a_value_without_an_interval():
    (table,) = tables.move_tables(moves(1.0)).values()
    assert table["Time", "settling time [s]"].tolist() == ["1.00"]


def test_moves_stand_apart_by_task_and_curves_beside_them(tmp_path):
    runs = results.load_runs(comparison(tmp_path / "out"))
    assert list(tables.move_tables(runs)) == ["exp1", "exp2"]
    (table,) = tables.curve_tables(runs).values()
    assert table["RMS error", "RMS error of the judged part [mm]"].tolist() == ["2.00"] * 3
    assert table["Runs", "followed [%]"].tolist() == ["100 [21, 100]"] * 3


def test_no_table_holds_the_largest_error_of_a_move_which_is_its_start(tmp_path):
    runs = results.load_runs(comparison(tmp_path / "out"))
    every = [
        *tables.move_tables(runs).values(),
        *tables.curve_tables(runs).values(),
        tables.overview(runs),
    ]
    assert not [name for table in every for name in table.columns if "largest error" in name[1]]


def test_the_headings_of_a_notebook_are_two_rows_and_no_tuples(tmp_path):
    runs = results.load_runs(comparison(tmp_path / "out"))
    every = (
        tables.overview,
        tables.cost_table,
        tables.runs_table,
        tables.outcome_table,
        tables.failure_table,
        leaders,
    )
    for table in (make(runs) for make in every):
        assert table.empty or table.columns.nlevels == 2
        assert "(" not in table.iloc[:0].to_html(index=False)


def test_a_published_method_stands_below_its_method_and_others_keep_their_order():
    names = pd.Series(["broyden", "ukf_mfac:published", "mine", "ukf_mfac", "rls:published"])
    wanted = ["broyden", "ukf_mfac", "ukf_mfac:published", "mine", "rls:published"]
    assert tables.ordered(names) == wanted
    runs = pd.concat([moves(1.0, controller=name) for name in names])
    assert tables.overview(runs)["", "controller"].tolist() == wanted
    assert next(iter(tables.move_tables(runs).values()))["", "controller"].tolist() == wanted


def test_only_conditions_that_vary_get_a_column(tmp_path):
    (table,) = tables.move_tables(results.load_runs(sweep(tmp_path / "out"))).values()
    assert [heading for group, heading in table.columns if group == ""] == [
        "controller",
        "mismatch",
        "latency [ms]",
    ]
    assert len(table) == 3 * 3 * 2
    assert set(table["", "latency [ms]"]) == {"0", "50"}


def test_the_overview_has_a_group_for_each_task(tmp_path):
    table = tables.overview(results.load_runs(comparison(tmp_path / "out")))
    assert list(dict.fromkeys(group for group, _ in table.columns)) == [
        "",
        "exp1",
        "exp2",
        "circle",
    ]
    assert table["exp1", "settling time [s]"].tolist() == ["1.50"] * 3
    assert table["circle", "RMS error of the judged part [mm]"].tolist() == ["2.00"] * 3


def test_the_overview_of_many_conditions_is_one_group_a_task(tmp_path):
    table = tables.overview(results.load_runs(sweep(tmp_path / "out")))
    assert [group for group, _ in table.columns] == ["", "random", "random"]
    assert table["random", "settled [%]"].iloc[0].startswith("72 [")


def test_what_came_of_runs_is_told_where_not_all_went_well():
    words = ["settled", "settled", "target_unreachable", "crashed"]
    mixed = pd.DataFrame(
        [made_up_row(str(i), seed=i, outcome=word) for i, word in enumerate(words)]
    )
    row = tables.outcome_table(pd.concat([mixed, moves(1.0, 1.0, task="exp2", outcome="settled")]))
    assert row["", "task"].tolist() == ["exp1"]
    assert row["As asked", "settled [%]"].tolist() == ["50 [15, 85]"]  # Wilson
    assert row["Reached the last period", "target_unreachable [%]"].tolist() == ["25 [5, 70]"]
    assert row["Ended early", "crashed [%]"].tolist() == ["25 [5, 70]"]
    assert tables.outcome_table(moves(1.0, outcome="settled")).empty


def test_failures_are_counted_with_a_reason(tmp_path):
    table = tables.failure_table(results.load_runs(sweep(tmp_path / "out")))
    assert table["", "runs"].tolist() == ["5 of 18"] * 3
    assert table["The first of them", "reason"].tolist() == ["no valid feature for 20 periods"] * 3
    assert tables.failure_table(pd.DataFrame([made_up_row("a")])).empty


def test_errors_are_in_the_unit_of_the_feature():
    radians = moves(1.0, feature_unit="rad")
    (table,) = tables.move_tables(radians).values()
    assert table["Error", "error of the last second [rad]"].tolist() == ["0.00"]
    (both,) = tables.move_tables(pd.concat([moves(1.0), radians.assign(plant="crane")])).values()
    (metres,) = tables.move_tables(moves(1.0)).values()
    own = [
        *metres["Error", "error of the last second [mm]"],
        *table["Error", "error of the last second [rad]"],
    ]
    assert both["Error", "error of the last second [mm or rad]"].tolist() == own


def test_times_that_are_not_known_get_no_column():
    heading = ("Step of the controller", "step, median [µs]")
    assert heading in tables.cost_table(moves(1.0))
    assert heading not in tables.cost_table(moves(1.0, controller_time_median_us=np.nan))


def test_a_run_tells_how_it_ended_and_what_came_of_it():
    table = tables.runs_table(
        pd.DataFrame([made_up_row("a", outcome="joint_at_limit", settling_time_s=np.nan)])
    )
    assert table["How it ended"].iloc[0].tolist() == ["completed", "joint_at_limit"]
    assert table.iloc[0].tolist()[:3] == ["ukf_mfac", "exp1", "0"]


@pytest.mark.parametrize("folder", [comparison, sweep, failed_only])
def test_every_table_of_every_kind_of_folder_is_text_without_pythons_words(tmp_path, folder):
    path = folder(tmp_path / "out")
    runs = results.load_runs(path)
    whole = (
        tables.overview,
        tables.outcome_table,
        tables.cost_table,
        tables.runs_table,
        tables.failure_table,
    )
    by_task = (tables.move_tables, tables.curve_tables)
    made = [make(runs) for make in whole] + [own for make in by_task for own in make(runs).values()]
    cells = [cell for table in made for cell in table.to_numpy().ravel()]
    assert cells
    assert all(isinstance(cell, str) for cell in cells)
    assert not {"nan", "inf", "None", "NaN"} & {
        word.strip("[],") for cell in cells for word in cell.split()
    }
    assert describe_folder(ResultsFolder(path).manifest, runs)["runs"].startswith(
        f"{len(runs)}, of which "
    )


def test_settings_are_told_in_words(tmp_path):
    folder = comparison(tmp_path / "out")
    opened = ResultsFolder(folder)
    assert describe_settings(opened.manifest) == {}
    limits = {"limit": "inf", "gain": 0.5, "view": False, "bounds": [1, None]}
    store.write_manifest(folder, opened.manifest | {"configuration": {"law": limits}})
    assert describe_settings(ResultsFolder(folder).manifest) == {
        "law.limit": "no limit", "law.gain": "0.5", "law.view": "no", "law.bounds": "1, not set",
    }  # fmt: skip


def test_settings_of_a_mismatch_stand_beside_those_of_the_plant():
    plant = {"lag": 0.05, "command_delay": 0.02, "max_joint_speed": 1.0, "sensing.jitter": 0.0}
    manifest = {
        "configuration": {"kinematic": plant, "exp2": {"lag": 3.0}},
        "plants": ["kinematic"],
        "changed": ["kinematic.command_delay"],
        "mismatches": ["moderate", "lab", "severe+jitter=70ms"],
    }
    assert describe_settings(manifest) == {
        "kinematic.lag": "0.05; 0.03 with lab",
        "kinematic.command_delay": "0.02",
        "kinematic.max_joint_speed": "1.0",
        "kinematic.sensing.jitter": "0.0; 0.07 with severe+jitter=70ms",
        "exp2.lag": "3.0",
    }


def test_each_metric_is_shown_in_its_unit_with_its_digits():
    values = dict.fromkeys(METRICS, 1.2345678) | {"rms_error_second_lap": 2.3456789}
    curve = values | {"task": "circle", "task_kind": "curve"}
    runs = pd.DataFrame([made_up_row("0", **values), made_up_row("1", **curve)])
    pages = {
        "moves": tables.move_tables(runs)["exp1"],
        "curves": tables.curve_tables(runs)["circle"],
    }
    pages |= {"cost": tables.cost_table(runs[:1]), "runs": tables.runs_table(runs)}
    shown = {
        name: {heading: table[group, heading][0] for group, heading in table}
        for name, table in pages.items()
    }
    for table in shown.values():
        for name in ("controller", "number", "settled [%]", "followed [%]", "lost [%]"):
            table.pop(name, None)
    assert shown["moves"] == {
        "settling time [s]": "1.23", "later moves [s]": "1.23", "overshoot [%]": "123.5",
        "error of the last second [mm]": "1234.57", "pose error of the last second [mm]": "1.2",
        "angle error of the last second [deg]": "1.23", "path ratio": "1.235", "sign switches": "1",
    }  # fmt: skip
    assert shown["curves"] == {
        "RMS error of the second lap [mm]": "2345.68", "RMS error of the judged part [mm]": "1234.57",
        "largest joint position [rad]": "1.23", "sign switches": "1",
    }  # fmt: skip
    assert shown["cost"] == {
        "step, median [µs]": "1", "step, 99 % [µs]": "1", "steps over the period": "1", "control effort [rad]": "1.23",
        "saturated periods [%]": "123.5", "RMS acceleration [rad/s²]": "1.23", "RMS jerk [rad/s³]": "1.2",
        "mean Jacobian error [%]": "123.5",
    }  # fmt: skip
    assert shown["runs"] == {
        "task": "exp1", "seed": "0", "status": "completed", "outcome": "settled", "settling time [s]": "1.23",
        "error of the last second [mm]": "1234.57", "RMS error of the judged part [mm]": "1234.57",
        "control effort [rad]": "1.23",
    }  # fmt: skip
    moves, curves = (table.iloc[0, 2:].to_dict() for _, table in tables.summary_tables(runs))
    assert moves == {
        "settling time [s]": "1.23", "overshoot [%]": "123", "error of the last second [mm]": "1234.6",
        "sign switches": "1", "step, median [µs]": "1*",
    }  # fmt: skip
    assert curves == {
        "RMS error of the second lap [mm]": "2345.7", "RMS error of the judged part [mm]": "1234.6",
        "largest joint position [rad]": "1.23", "sign switches": "1", "step, median [µs]": "1*",
    }  # fmt: skip


def test_every_place_that_a_metric_names_exists():
    for metric in METRICS.values():
        assert all(group in tables.GROUPS[table] for table, group in metric.tables.items()), (
            metric.column
        )
        assert metric.figure in ("", *FIGURES), metric.column


def test_a_folder_says_which_of_its_controllers_have_the_aids():
    every = {f"aids.{name}": value for name, value in EQUIPPED.items()}
    sections = {
        "ukf_mfac": every,
        "Mine": {"gain": 2.0},
        "ukf_mpc": every | {"aids.limit": "scale"},
        "run": {},
    }
    manifest = {
        "controllers": ["ukf_mfac", "Mine", "ukf_mpc", "fmu:a.fmu"],
        "configuration": sections | {"fmu:a.fmu": {}},
    }
    wanted = "with all aids: ukf_mfac; without aids: Mine; with all aids but limit: ukf_mpc; aids unknown: fmu:a.fmu"
    assert describe_controllers(manifest) == wanted
    manifest["controllers"] = ["Mine"]
    assert describe_controllers(manifest) == ""
