import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from kit.command import servobench
from kit.folders import comparison, made_up_row, made_up_steps, sweep, write_folder
from kit.nightly import NIGHTLY
from servobench.harness.analysis.comparison import split_tasks
from servobench.harness.analysis.tables import (
    Selection,
    cost_table,
    curve_tables,
    failure_table,
    judge_places,
    move_tables,
    outcome_table,
    overview,
    runs_table,
    summary_legend,
    summary_tables,
)
from servobench.harness.analysis.verdict import judge, leaders
from servobench.harness.apps.figures.measures import draw_conditions
from servobench.harness.apps.figures.style import method_styles
from servobench.harness.apps.figures.tracks import load_ensembles, load_groups
from servobench.harness.apps.report.page import error_curves, path_views
from servobench.harness.batch import results, store, tables
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.batch.schema import MANIFEST, read_manifest
from servobench.harness.batch.tables import NEEDED
from servobench.harness.cli.runs import new_folder
from servobench.harness.run.result import RunResult
from servobench.plant.contract.checksums import SUMS, write_vouched
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, partial_path, point_latest, write_atomically

STEPS = {"time_s": 0.05 * np.arange(3), "error_norm": 1.0}


def add_part(folder, index: int, **extra: float) -> None:
    run_id = f"run{index}"
    steps = pd.DataFrame(
        {"run_id": run_id, "step": np.arange(3), "value": index + np.arange(3.0)} | STEPS | extra
    )
    store.write_part(folder, index, [RunResult(made_up_row(run_id, seed=index) | extra, steps)])


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "out"
    store.create_folder(made, {"seeds": "0"})
    return made


def test_a_metric_of_pairs_is_refused_where_there_is_one_controller():
    alone = pd.DataFrame([made_up_row(f"run{seed}", seed=seed) for seed in range(2)])
    with pytest.raises(
        ConfigurationError,
        match="no two controllers have runs of one seed to compare; leave --metric",
    ):
        judge_places(alone, Selection({"ukf_mfac": "ukf_mfac"}, "settling_time_s"))
    found = judge_places(alone)
    assert [(len(place.controllers), place.pairs) for place in found.places] == [(1, [])]
    assert found.legend == "brackets: 95 %"


def test_parts_are_readable_before_and_after_they_are_put_together(folder):
    for index in (1, 0):
        add_part(folder, index)
    before = results.load_runs(folder), results.load_steps(folder)
    assert store.collect(ResultsFolder(folder)) == 2
    after = results.load_runs(folder), results.load_steps(folder)
    for early, late in zip(before, after, strict=True):
        pd.testing.assert_frame_equal(early, late)
    assert before[0]["run_id"].tolist() == ["run0", "run1"]
    assert not (folder / results.PARTS).exists()
    assert store.collect(ResultsFolder(folder)) == 2


def test_an_opened_folder_reads_its_manifest_once(folder, monkeypatch):
    read = []

    def counted(path):
        read.append(path)
        return read_manifest(path)

    monkeypatch.setattr(results, "read_manifest", counted)
    opened = ResultsFolder(folder)
    with pytest.raises(ConfigurationError, match="out holds no finished run"):
        opened.runs()
    add_part(folder, 0)
    assert opened.runs()["run_id"].tolist() == ["run0"]
    assert opened.steps()["step"].tolist() == [0, 1, 2]
    assert (opened.describe_missing(), opened.run_count, opened.configuration) == ("", 0, {})
    assert read == [folder]


def test_an_opened_folder_follows_a_batch_that_is_under_way(folder):
    opened = ResultsFolder(folder)
    add_part(folder, 0)
    assert opened.finished_runs() == [range(1)]
    add_part(folder, 1)
    assert opened.finished_runs() == [range(1), range(1, 2)]
    assert (opened.part_indices(), opened.is_whole(2)) == ([0, 1], False)
    assert store.collect(ResultsFolder(folder)) == 2
    assert (opened.part_indices(), opened.is_whole(2), opened.is_whole(3)) == ([], True, False)
    assert opened.runs()["run_id"].tolist() == ["run0", "run1"]
    assert sorted(opened.sums) == [MANIFEST, results.RUNS, results.STEPS]


def test_an_opened_folder_names_a_file_that_was_changed_meanwhile(folder):
    opened = ResultsFolder(folder)
    add_part(folder, 0)
    opened.runs()
    name = results.part_name(0, results.RUNS)
    assert (opened.fault_of(name), opened.expects(name)) == (None, True)
    (folder / name).unlink()
    assert (opened.fault_of(name), opened.expects(name)) == ("is missing", True)
    (folder / "mine.txt").write_text("a note")
    assert (opened.unlisted(), opened.accompanying()) == (["mine.txt"], {})
    opened.vouch([folder / "mine.txt"])
    assert (opened.unlisted(), list(opened.accompanying())) == ([], ["mine.txt"])


def test_tables_have_the_columns_that_were_written_and_no_others(folder):
    steps = pd.DataFrame({"run_id": "run0", "step": np.arange(3)} | STEPS, index=[7, 8, 9])
    outcome = [RunResult(made_up_row(name), steps.assign(run_id=name)) for name in ("run0", "run1")]
    store.write_part(folder, 0, outcome)
    assert list(results.load_steps(folder)) == list(steps)
    assert list(results.load_runs(folder)) == list(made_up_row("run0"))


def test_a_folder_that_a_killed_batch_had_begun_to_make_is_made(tmp_path):
    begun = tmp_path / "out"
    (begun / results.PARTS).mkdir(parents=True)
    half = begun / f".{results.MANIFEST}-12-34"
    half.write_text("{")
    (begun / SUMS).write_text("of another time")
    store.create_folder(begun, {"seeds": "0"})
    assert not half.exists()
    assert ResultsFolder(begun).manifest["seeds"] == "0"
    assert not examine(ResultsFolder(begun)).findings


def test_tables_with_different_columns_join_with_gaps(folder):
    add_part(folder, 0)
    add_part(folder, 1, torque=2.5)
    store.collect(ResultsFolder(folder))
    steps = results.load_steps(folder)
    assert steps["torque"].isna().tolist() == [True] * 3 + [False] * 3
    assert results.load_steps(folder, ["run1"])["torque"].tolist() == [2.5] * 3


def test_a_run_without_its_row_does_not_count(folder):
    add_part(folder, 0)
    add_part(folder, 1)
    (folder / results.PARTS / f"00000001.{results.RUNS}").unlink()
    (folder / results.PARTS / f".00000002.{results.RUNS}").write_bytes(b"half")
    assert store.collect(ResultsFolder(folder)) == 1
    assert results.load_steps(folder)["run_id"].unique().tolist() == ["run0"]


def test_a_run_that_ended_before_its_first_period_has_a_row_and_no_steps(folder):
    store.write_part(folder, 0, [RunResult(made_up_row("run0"), pd.DataFrame())])
    assert store.collect(ResultsFolder(folder)) == 1
    with pytest.raises(ConfigurationError, match="holds no steps"):
        results.load_steps(folder)


def test_a_killed_clean_up_loses_nothing(folder):
    add_part(folder, 0)
    add_part(folder, 1)
    parts = {path.name: path.read_bytes() for path in (folder / results.PARTS).iterdir()}
    store.collect(ResultsFolder(folder))
    (folder / results.PARTS).mkdir()
    name = f"00000001.{results.RUNS}"
    (folder / results.PARTS / name).write_bytes(parts[name])
    assert store.collect(ResultsFolder(folder)) == 2
    assert not (folder / results.PARTS).exists()
    assert len(results.load_runs(folder)) == 2


@pytest.mark.parametrize(
    ("name", "message"),
    [("", "exists already; give another one as `out`"), ("file/out", "cannot be made")],
)
def test_a_folder_with_something_in_it_or_that_cannot_be_made_is_refused(tmp_path, name, message):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigurationError, match=message):
        store.create_folder(tmp_path / name, {})


def test_a_folder_of_another_schema_is_refused(folder):
    with pytest.raises(ConfigurationError, match="holds no finished run"):
        results.load_runs(folder)
    (folder / SUMS).unlink()  # an earlier version had none
    (folder / results.MANIFEST).write_text(json.dumps({"schema_version": "0"}))
    with pytest.raises(ConfigurationError, match="results of schema '0'; this servobench reads"):
        results.load_runs(folder)


def without_file(name: str) -> Callable[[Path], None]:
    return lambda folder: (
        comparison(folder, controllers=("constant",), tasks=("exp1",)) / name
    ).unlink()


def of_schema_3(folder: Path) -> None:
    manifest = comparison(folder, controllers=("constant",), tasks=("exp1",)) / results.MANIFEST
    manifest.write_text(
        manifest.read_text().replace('"schema_version": "4"', '"schema_version": "3"')
    )
    (folder / SUMS).unlink()


@pytest.mark.parametrize(
    ("make", "command", "words"),
    [
        (sweep, "shadow DIR --controller constant", "DIR holds no steps: a sweep keeps none; use run or c"),
        (sweep, "record DIR", "DIR holds no steps: a sweep keeps none"),
        (sweep, "export DIR --out new", "DIR holds no steps: a sweep keeps none"),
        (sweep, "figures DIR --kind errors", "DIR holds no steps: a sweep keeps none"),
        (without_file(results.STEPS), "export DIR --out new", "DIR/steps.parquet is missing; repeat the command"),
        (without_file(results.STEPS), "figures DIR", "DIR/steps.parquet is missing; repeat the command"),
        (without_file(results.RUNS), "statistics DIR", "DIR/runs.parquet is missing; repeat the command"),
        (of_schema_3, "verify DIR", "DIR has results of schema '3'; this servobench reads '4'; the column "
         "latency_periods [periods] is now latency_s [s]"),
        (lambda folder: None, "verify DIR", "DIR is not a results folder: it does not exist"),
        (lambda folder: sweep(folder / "slow"), "statistics DIR", "DIR is not a results folder: take one that is in "
         "it, such as DIR/slow"),
        (lambda folder: (sweep(folder / "slow"), (folder / "manifest.json").write_text("{")), "statistics DIR",
         "DIR is not a results folder: its manifest.json cannot be read"),
    ],
)  # fmt: skip
def test_what_a_folder_lacks_is_named(refusal_of, monkeypatch, tmp_path, make, command, words):
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "DIR")
    assert refusal_of(*command.split()).startswith(f"servobench: {words}")
    assert not (tmp_path / "new").exists()


def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(3):
        new_folder().mkdir(parents=True)
    assert len(list(Path("results").iterdir())) == 3


def test_latest_points_at_the_newest_folder_and_never_replaces_a_real_one(folder):
    point_latest(folder)
    newer = folder.parent / "newer"
    store.create_folder(newer, {})
    point_latest(newer)
    assert (folder.parent / "latest").resolve() == newer.resolve()
    (folder.parent / "latest").unlink()
    (folder.parent / "latest").mkdir()
    point_latest(newer)
    assert not (folder.parent / "latest").is_symlink()


def test_the_manifest_is_json_for_every_reader(tmp_path):
    store.create_folder(
        tmp_path / "out", {"limit": float("inf"), "low": (1.5, float("-inf")), "count": 3}
    )
    text = (tmp_path / "out" / results.MANIFEST).read_text(encoding="utf-8")
    assert text.startswith('{\n  "schema_version": "4",\n  "limit": "inf",\n')
    manifest = json.loads(text)
    assert (manifest["limit"], manifest["low"], manifest["count"]) == ("inf", [1.5, "-inf"], 3)


def test_columns_that_one_part_has_only_as_nothing_take_the_type_of_the_others(folder):
    for index, latency in enumerate((None, 2, None)):
        store.write_part(
            folder, index, [RunResult(made_up_row(f"run{index}", latency_s=latency), None)]
        )
    before = results.load_runs(folder)
    store.collect(ResultsFolder(folder))
    pd.testing.assert_frame_equal(results.load_runs(folder), before)
    assert before["latency_s"].tolist() == pytest.approx([np.nan, 2.0, np.nan], nan_ok=True)


def test_what_is_no_number_is_null_and_a_column_of_it_one_of_numbers():
    rows = [
        {"some": np.nan, "none": np.nan, "latency_s": None, "nothing": None},
        {"some": 2.0, "none": np.nan},
    ]
    table = tables.as_table(rows)
    assert [str(each) for each in table.schema.types] == ["double", "double", "double", "null"]
    assert [column.null_count for column in table.columns] == [1, 2, 2, 2]


def test_a_part_of_several_runs_says_which_runs_are_there(folder):
    store.write_part(
        folder, 8, [RunResult(made_up_row(f"run{index}"), None) for index in (8, 9, 10)]
    )
    add_part(folder, 2)
    assert ResultsFolder(folder).finished_runs() == [range(2, 3), range(8, 11)]


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "table"
    path.write_text("old")

    def fail(file):
        file.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="Not a directory"):
        write_atomically(
            path / "page", lambda _: pytest.fail("its content is made although it cannot be kept")
        )


def test_a_file_and_its_name_are_on_the_disk_before_the_next_is_written(tmp_path, monkeypatch):
    kept: list[tuple[int, list[str]]] = []

    def note(descriptor):
        kept.append((os.fstat(descriptor).st_ino, [each.name for each in tmp_path.iterdir()]))

    monkeypatch.setattr("os.fsync", note)
    write_atomically(tmp_path / "table", lambda file: file.write_text("new"))
    name = partial_path(tmp_path / "table").name
    assert kept == [
        ((tmp_path / "table").stat().st_ino, [name]),
        (tmp_path.stat().st_ino, ["table"]),
    ]


def test_a_file_that_cannot_be_read_while_another_is_made_is_not_said_to_be_written(tmp_path):
    page, font = tmp_path / "out" / "page", tmp_path / "a.ttf"
    page.parent.mkdir()
    for path, kind in ((page, "report"), (page.parent, "")):
        line = f"^{font}, which {path} needs, cannot be read: No such file or directory$"
        with pytest.raises(ConfigurationError, match=line), accessing(path, kind):
            write_atomically(page, lambda _: font.read_bytes())
        with pytest.raises(OSError, match="cannot identify"), accessing(path, kind):
            write_atomically(page, Image.open)


def test_the_last_picture_of_a_run_is_kept_at_twice_its_size(folder):
    cv2 = pytest.importorskip("cv2")
    picture = np.full((6, 8, 3), (200, 30, 10), dtype=np.uint8)
    store.write_part(
        folder,
        0,
        [RunResult(made_up_row("run0"), None, picture), RunResult(made_up_row("run1"), None)],
    )
    store.write_part(folder, 2, [RunResult(made_up_row("run2"), None, picture)])
    written = sorted((folder / results.PICTURES).iterdir())
    assert [path.name for path in written] == ["run0.png", "run2.png"]
    colours = cv2.cvtColor(cv2.imread(str(written[0])), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(colours, np.full((12, 16, 3), (200, 30, 10)))


def test_a_long_table_is_read_in_groups_with_the_columns_that_it_has(folder, monkeypatch):
    monkeypatch.setattr(tables, "ROW_GROUP", 2)
    for index in range(5):
        add_part(folder, index)
    assert ResultsFolder(folder).has_steps()
    store.collect(ResultsFolder(folder))
    assert ResultsFolder(folder).has_steps()
    groups = list(ResultsFolder(folder).iterate_runs(["seed", "no such column"]))
    assert [list(group.columns) for group in groups] == [["seed"]] * 3
    assert [group["seed"].tolist() for group in groups] == [[0, 1], [2, 3], [4]]
    changed = results.load_runs(folder).drop(columns="controller")
    write_vouched(folder, {results.RUNS: changed.to_parquet})
    with pytest.raises(ConfigurationError, match="it lacks the column controller"):
        ResultsFolder(folder).iterate_runs(["seed"])


def read_runs(folder):
    """Make of a table of runs what `statistics`, `compare`, `report` and the notebook make of it."""
    runs = results.load_runs(folder)
    judge_places(runs)
    list(summary_tables(runs))
    summary_legend(runs)
    makers = (
        overview,
        move_tables,
        curve_tables,
        cost_table,
        outcome_table,
        failure_table,
        runs_table,
    )
    for make in (*makers, judge, leaders):
        make(runs)
    draw_conditions(split_tasks(runs)[0], method_styles(runs["controller"]))


def read_steps(folder):
    """Read what figures, paths and curves are drawn of."""
    results.load_steps(folder)
    runs = results.load_runs(folder)
    for group in load_groups(ResultsFolder(folder), runs):
        load_ensembles(ResultsFolder(folder), runs[runs["mismatch"] == group.mismatch])
    path_views(ResultsFolder(folder), runs)
    error_curves(ResultsFolder(folder), runs)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "read"), [(results.RUNS, read_runs), (results.STEPS, read_steps)])
def test_a_foreign_table_lacking_a_column_is_read_without_it_or_refused_in_one_line(
    tmp_path, kind, read
):
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac", "rls"), tasks=("exp1", "circle"))
    (folder / SUMS).unlink()
    whole = pd.read_parquet(folder / kind)
    needed = NEEDED[kind.partition(".")[0]] + ("settling_time_s",) * (kind == results.RUNS)
    keys = {*needed, "rms_error_evaluated"} & set(whole)  # the last one: what pairs are compared by
    others = [name for name in whole if name not in keys]
    groups = len(others) if NIGHTLY else 4  # of columns that are left out together
    refused = {}
    for names in [*([name] for name in keys), *(others[k::groups] for k in range(groups))]:
        whole.drop(columns=names).to_parquet(folder / kind)
        try:
            read(folder)
        except ConfigurationError as error:
            refused[names[0]] = str(error)
    assert all(name in line and len(line.splitlines()) == 1 for name, line in refused.items()), (
        refused
    )
    assert sorted(name for name, line in refused.items() if str(folder / kind) in line) == sorted(
        needed
    )
    assert set(refused) <= keys


def test_a_run_that_does_not_say_which_it_is_is_named(tmp_path):
    folder = comparison(tmp_path / "out")
    (folder / SUMS).unlink()
    runs = results.load_runs(folder)
    runs.assign(controller=runs["controller"].where(runs.index != 1)).to_parquet(
        folder / results.RUNS
    )
    with pytest.raises(
        ConfigurationError, match=r"runs.parquet is no table of runs: row 1 has no controller$"
    ):
        results.load_runs(folder)
    runs.drop(columns="settling_time_s").assign(status="crashed").to_parquet(folder / results.RUNS)
    assert len(results.load_runs(folder)) == len(runs)  # no run has one


def test_a_table_that_is_none_of_runs_names_all_that_it_lacks(tmp_path):
    folder = comparison(tmp_path / "out")
    (folder / SUMS).unlink()
    pd.DataFrame({"run_id": ["a"], "plant": ["kinematic"], "x": [1.0]}).to_parquet(
        folder / results.RUNS
    )
    lack = "lacks the columns controller, task, mismatch, seed, status"
    with pytest.raises(ConfigurationError, match=f"runs.parquet is no table of runs: it {lack}$"):
        results.load_runs(folder)
    assert lack in [finding.fault for finding in examine(ResultsFolder(folder)).findings]
    pd.DataFrame({"run_id": ["a"], "time_s": [0.0]}).to_parquet(folder / results.STEPS)
    with pytest.raises(
        ConfigurationError, match="is no table of steps: it lacks the column error_norm$"
    ):
        results.load_steps(folder)


@pytest.mark.parametrize(
    "run_id",
    ["../../escaped", "/tmp/escaped", "..", ".hidden", "a\\b", "a\0b", "a b", "", "-rf", "=1", 3],
)
def test_a_run_identifier_that_is_unfit_for_a_file_is_refused(tmp_path, run_id):
    folder = write_folder(tmp_path / "out", [made_up_row(run_id)], [made_up_steps("a")])
    fault = "it has int64 in the column run_id" if run_id == 3 else "the run_id of row 0"
    with pytest.raises(ConfigurationError, match=f"runs.parquet is no table of runs: {fault}"):
        results.load_runs(folder)


@pytest.fixture
def unfinished(tmp_path, monkeypatch):
    """The folder `out` below the working directory, with two of three runs; reports on it have no pictures."""
    monkeypatch.chdir(tmp_path)
    # Which take seconds
    monkeypatch.setattr("servobench.harness.apps.report.page.report_pictures", lambda *_: [])
    store.create_folder(Path("out"), {"run_count": 3})
    for index in range(2):
        add_part(Path("out"), index)
    return Path("out")


MISSING = "2 of 3 runs are there: --resume carries out the others"


@pytest.mark.parametrize(
    "command", ["export out --out files", "report out", "statistics out", "verify out"]
)
def test_commands_first_say_how_many_runs_of_a_batch_are_missing(output_of, unfinished, command):
    assert output_of(*command.split()).startswith(f"{MISSING}\n")
    if command == "report out":
        assert MISSING in (unfinished / "report.html").read_text(encoding="utf-8")
    add_part(unfinished, 2)
    shutil.rmtree("files", ignore_errors=True)
    assert "runs are there" not in output_of(*command.split())


@pytest.mark.parametrize("command", ["export out --out files", "statistics out"])
def test_commands_first_say_that_a_folder_has_lost_its_checksums(output_of, unfinished, command):
    (unfinished / SUMS).unlink()
    assert output_of(*command.split()).startswith(
        f"{MISSING}; SHA256SUMS is missing, so that nothing vouches for"
    )


def test_statistics_of_an_unfinished_batch_stay_json(monkeypatch, capsys, unfinished):
    assert servobench(monkeypatch, "statistics", str(unfinished), "--json") == 0
    told = capsys.readouterr()
    assert json.loads(told.out)
    assert told.err == f"{MISSING}\n"


@pytest.mark.parametrize("value", [1e308, 1e160])
def test_a_number_whose_square_no_number_can_be_is_refused(tmp_path, value):
    rows = [made_up_row("a", settling_time_s=1.0), made_up_row("b", settling_time_s=value)]
    folder = write_folder(tmp_path / "out", rows, [made_up_steps("a"), made_up_steps("b")])
    with pytest.raises(
        ConfigurationError, match=re.escape(f"no table of runs: settling_time_s is {value:g}")
    ):
        results.load_runs(folder)


def test_an_empty_table_of_runs_is_named_for_pages_figures_and_notebooks(tmp_path):
    runs = pd.DataFrame({"run_id": []})
    with pytest.raises(ConfigurationError, match="^out holds no finished run$"):
        ResultsFolder(Path("out")).check_runs(runs)
    notebook = (Path(__file__).parents[2] / "notebooks" / "analysis.ipynb").read_text(
        encoding="utf-8"
    )
    assert "folder.check_runs(runs)" in notebook
