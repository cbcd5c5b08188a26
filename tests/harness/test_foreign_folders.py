"""Whatever a stranger's results folder holds, commands write only where the user said, and run nothing in it."""

import csv
import io
import os
import re
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import matplotlib.font_manager  # noqa: F401 - fills its cache before anything is noted
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import pytest

from kit.command import servobench
from kit.folders import MANIFEST, comparison, made_up_row, made_up_steps, write_folder
from kit.writes import noting
from servobench.harness.batch import results, store, tables
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.run.result import RunResult
from servobench.plant.contract import files
from servobench.plant.contract.checksums import SUMS, write_vouched

RUN = "kinematic-constant-exp1-moderate-0"
TEXTS = (
    "plant",
    "task",
    "mismatch",
    "robot",
    "sensing",
    "engine",
    "task_kind",
    "feature_unit",
    "outcome",
    "reason",
)
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # with which a cell begins that a spreadsheet runs
PAYLOADS = (
    "../../escaped",
    "/ELSEWHERE/escaped",
    "=cmd|'/C calc'!A1",
    "$(touch escaped)",
    "<b>",
    "x\n## y",
    "%s{0}",
)


def row(**values: object) -> dict[str, object]:
    return made_up_row(RUN, controller="constant", robot="ur5", sensing="position", **values)


def signed(folder: Path, **values: object) -> Path:
    """Write an unfinished folder with one run and with checksums that fit."""
    store.create_folder(folder, MANIFEST | {"run_count": 2})
    run = row() | values
    store.write_part(folder, 0, [RunResult(run, made_up_steps(str(run["run_id"]), periods=5))])
    return folder


def linked(name: str) -> Callable[[Path, Path], None]:
    """Return what puts a link to a file or folder of the user in the place of a name."""

    def make(folder: Path, victim: Path) -> None:
        signed(folder)
        if name == SUMS:
            (folder / SUMS).rename(victim)
        (folder / name).symlink_to(victim.parent if name == "recordings" else victim)

    return make


def piped(name: str) -> Callable[[Path, Path], None]:
    """Return what puts a pipe, which would be read for ever, in the place of a name."""

    def make(folder: Path, _victim: Path) -> None:
        (signed(folder) / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return make


def worded(folder: Path, _victim: Path) -> None:
    """Put payloads into every text column, and into the name of a column."""
    texts = {name: PAYLOADS[k % len(PAYLOADS)] for k, name in enumerate(TEXTS)}
    signed(folder, controller=PAYLOADS[2], status="crashed", **texts, **{"=1+1": "@x"})


def coded(folder: Path, _victim: Path) -> None:
    signed(folder, sensing=f"{folder}/evil.py")
    (folder / "evil.py").write_text(f"open({str(folder.parent / 'escaped')!r}, 'w')\n")


HOSTILE = {
    "a run that climbs": lambda folder, _: signed(folder, run_id="../../../escaped"),
    "a run elsewhere": lambda folder, victim: signed(folder, run_id=str(victim)),
    "a run that is an option": lambda folder, _: signed(folder, run_id="-rf"),
    "a link for the lock": linked(".lock"),
    "a link for the checksums": linked(SUMS),
    "a link for the report": linked("report.html"),
    "a link for films": linked("recordings"),
    "a link beside the tables": linked("notes.csv"),
    "a pipe": piped("more.csv"),
    "a pipe for a part": piped(results.part_name(0, results.RUNS)),
    "words": worded,
    "code": coded,
}
ACCEPTED = ("words", "code")
COMMANDS = (
    "statistics {}", "figures {} --format svg", "report {}", "verify {}",
    "export {} --out out/csv", "export {} --out out/mcap --format mcap",
    f"shadow {{}} --run {RUN} --controller constant --out out/seen.csv", f"record {{}} --run {RUN} --kinds snapshots",
    "compare --controllers constant --plants kinematic --tasks exp1 --workers 1 --resume --out {}", "collect {}",
    "merge {} --out out/merged", "sweep --controllers constant --plants kinematic --seeds 0:1 --resume --out {}",
)  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_no_command_writes_outside_of_a_hostile_folder_or_runs_it(
    kind, tmp_path, monkeypatch, capsys
):
    for name in ("home", "temporary", "out"):
        (tmp_path / name).mkdir()
    folder, victim = tmp_path / "home" / "folder", tmp_path / "home" / "victim.csv"
    victim.write_text("precious")
    HOSTILE[kind](folder, victim)
    before = victim.read_text()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    # Those of `figures`
    monkeypatch.setattr("servobench.harness.apps.report.page.report_pictures", lambda *_: [])
    allowed = [
        os.path.realpath(tmp_path / name) for name in ("home/folder", "temporary", "cache", "out")
    ]
    for command in COMMANDS:
        with noting() as noted:
            code = servobench(monkeypatch, *command.format(folder).split())
        said = capsys.readouterr()
        outside = [
            each
            for each in noted
            if not any(f"{each[1]}/".startswith(f"{root}/") for root in allowed)
        ]
        assert [each for each in outside if each[1] != os.devnull] == [], command
        if kind not in ACCEPTED:
            assert code in (1, 2) if command.startswith("verify") else code == 2, (command, said)
            assert said.err.count("\n") <= 1, command
    assert victim.read_text() == before
    assert not list(tmp_path.rglob("escaped*"))


@pytest.mark.parametrize(
    "command", ["verify {}", "export {} --out {}/../csv", "merge {} --out {}/../m", "collect {}"]
)
def test_a_run_that_is_called_as_the_table_of_runs_is_refused_by_every_command(
    refusal_of, tmp_path, command
):
    folder = signed(tmp_path / "folder", run_id="runs")
    assert "'runs', is a name of its folder" in refusal_of(*command.format(folder, folder).split())
    assert [each.name for each in tmp_path.iterdir()] == ["folder"]


def test_parts_with_the_same_run_are_not_merged(refusal_of, tmp_path):
    one = signed(tmp_path / "one")
    store.create_folder(tmp_path / "two", MANIFEST | {"run_count": 2})
    store.write_part(tmp_path / "two", 1, [RunResult(row() | {"run_id": RUN.upper()}, None)])
    line = refusal_of("merge", one, tmp_path / "two", "--out", tmp_path / "out")
    assert "rows 0 and 1 have the run_id" in line
    assert not (tmp_path / "out").exists()


def test_no_picture_is_merged_to_a_place_that_a_run_names(refusal_of, tmp_path):
    (signed(tmp_path / "home" / "folder", run_id="../../picture") / "pictures").mkdir()
    (tmp_path / "home" / "picture.png").write_text("somebody's")
    (tmp_path / "out").mkdir()
    line = refusal_of("merge", f"{tmp_path}/home/folder", "--out", f"{tmp_path}/out/merged")
    assert "is unfit for the name of a file" in line
    assert not list((tmp_path / "out").rglob("*.png"))


def test_a_spreadsheet_runs_no_cell_of_an_export(tmp_path, monkeypatch):
    worded(tmp_path / "folder", tmp_path)
    assert (
        servobench(monkeypatch, "export", str(tmp_path / "folder"), "--out", str(tmp_path / "csv"))
        == 0
    )
    runs = pd.read_csv(tmp_path / "csv" / "runs.csv")
    assert runs.loc[0, "controller"] == "'=cmd|'/C calc'!A1"
    assert runs.loc[0, "'=1+1"] == "'@x"
    assert not runs.map(lambda cell: isinstance(cell, str) and cell.startswith(FORMULA)).any(
        axis=None
    )
    assert runs.loc[0, "seed"] == 0


@pytest.mark.parametrize(
    "end",
    ["\r", "\r\n", "\n", "\x0b", "\x0c", "\x1c", "\x85", "\u2028", "\u2029", ";", "\t", "\x00\r"],
)
def test_no_text_of_an_export_begins_a_row_or_a_formula(end, tmp_path):
    table = pd.DataFrame(
        {"reason": [f'a{end}=HYPERLINK("http://x","y")', "plain, text"], "seed": [1, 2]}
    )
    files.write_csv(table, tmp_path / "runs.csv")
    text = (tmp_path / "runs.csv").read_bytes().decode()
    rows = list(csv.reader(io.StringIO(text, newline="")))
    assert [len(each) for each in rows] == [2, 2, 2]
    assert rows[2] == ["plain, text", "2"]
    lines = text.splitlines()
    assert len(lines) == 3 + end.endswith("\n")  # within quotes
    for mark in ";\t":
        assert not any(
            cell.startswith(FORMULA) for line in rows for cell in ",".join(line).split(mark)
        )


BOMB = pa.table(dict.fromkeys(map("x{}".format, range(30)), pa.nulls(10**6, pa.float64())))
WRONG = {
    "texts for numbers": (lambda runs: runs.assign(rms_error="much"), "has (large_)?string in the column rms_error"),
    "numbers for texts": (lambda runs: runs.assign(controller=1), "has int64 in the column controller, where texts"),
    "no number that a metric has": (lambda runs: runs.assign(overshoot=-np.inf),
        "overshoot is -inf"),
    "a time below 0": (lambda runs: runs.assign(settling_time_s=-1.0), "settling_time_s is -1"),
    "a share above 1": (lambda runs: runs.assign(saturation_fraction=2.0), "saturation_fraction is 2"),
    "truths for numbers": (lambda runs: runs.assign(rms_error=True), "has bool in the column rms_error, where numbers"),
    "half seeds": (lambda runs: runs.assign(seed=0.5), "has double in the column seed, where whole numbers belong"),
    "a run twice": (lambda runs: pd.concat([runs, runs, runs.assign(controller="b")]),
        "rows 0 and 1 have the run_id"),
    "runs whose names differ in capitals": (lambda runs: pd.concat([runs, runs.assign(run_id=RUN.upper(), seed=1)]),
        "rows 0 and 1 have the run_id"),
    "a run called runs": (lambda runs: runs.assign(run_id="Runs"), "'Runs', is a name of its folder"),
    "a run called as the checksums": (lambda runs: runs.assign(run_id=SUMS), "'SHA256SUMS', is a name of its folder"),
    "a run called as a part": (lambda runs: runs.assign(run_id="steps.parquet"), "is a name of its folder"),
    "names of two lines": (lambda runs: runs.assign(**{"a\nb": 1}), "a name that cannot be printed"),
    "too many columns": (lambda runs: runs.assign(**{f"x{i}": 0 for i in range(51)}), "a table has at most 50"),
    "a bomb": (lambda runs: BOMB.to_pandas(), r"is a bomb: it unpacks to 3e\+07 cells"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_a_table_of_wrong_columns_is_one_line(refusal_of, monkeypatch, kind, tmp_path):
    monkeypatch.setattr(tables, "MAX_COLUMNS", 50)
    folder = comparison(tmp_path / "folder", ("constant",), ("exp1",))
    change, words = WRONG[kind]
    changed = change(results.load_runs(folder))
    write_vouched(folder, {results.RUNS: changed.to_parquet})
    assert re.search(words, refusal_of("statistics", folder))


def rewritten(
    name: str, change: Callable[[pd.DataFrame], pd.DataFrame]
) -> Callable[[Path], object]:
    """Return what changes a table of a folder, with a checksum that fits."""
    return lambda folder: write_vouched(
        folder, {name: change(pd.read_parquet(folder / name)).to_parquet}
    )


def manifest(**values: object) -> Callable[[Path], object]:
    return lambda folder: store.write_manifest(folder, ResultsFolder(folder).manifest | values)


def lists_in_lists(folder: Path) -> None:
    manifest(configuration={"run": {"period": "deep"}})(folder)
    deep = 2000 if sys.version_info >= (3, 13) else 900  # read by json, and too deep for Python
    text = (folder / results.MANIFEST).read_text().replace('"deep"', "[" * deep + "]" * deep)
    write_vouched(folder, {results.MANIFEST: lambda file: file.write_text(text)})


def part_behind_the_last_run(folder: Path) -> None:
    """Put a part behind the last run of the batch."""
    (folder / results.PARTS).mkdir()
    for name in (results.RUNS, results.STEPS):
        content = (folder / name).read_bytes()
        write_vouched(
            folder,
            {
                results.part_name(99_999_999, name): lambda file, content=content: file.write_bytes(
                    content
                )
            },
        )
        (folder / name).unlink()
    manifest(run_count=2)(folder)


def hostile_metadata(folder: Path) -> None:
    """Tell pandas about columns that there are not, in a table without a checksum."""
    words = {b"pandas": b'{"index_columns": ["none"], "columns": [], "column_indexes": [{}]}'}
    table = pa.parquet.read_table(folder / results.RUNS).replace_schema_metadata(words)
    pa.parquet.write_table(table, folder / results.RUNS)
    (folder / SUMS).unlink()


def differing_parts(folder: Path) -> None:
    (folder / results.PARTS).mkdir()
    for index, value in enumerate((0.5, True)):
        run = row() | {"run_id": f"b{index}"}
        store.write_part(
            folder, index, [RunResult(run, made_up_steps(f"b{index}").assign(jacobian_error=value))]
        )
    for name in (results.RUNS, results.STEPS):
        (folder / name).unlink()


def large_numbers(folder: Path) -> None:
    """Put a whole number into one part that has no place among the floats of the other."""
    differing_parts(folder)
    name = results.part_name(1, results.STEPS)
    write_vouched(
        folder, {name: pd.read_parquet(folder / name).assign(jacobian_error=2**63 - 1).to_parquet}
    )


def table_beside(table: pa.Table) -> Callable[[Path], object]:
    return lambda folder: pa.parquet.write_table(table, folder / "more.parquet")


runs, steps = partial(rewritten, results.RUNS), partial(rewritten, results.STEPS)
LATEX = "statistics {} --latex"
FIGURE = "figures {} --kind errors --format svg"
EXPORT, MCAP = "export {} --out out", "export {} --out out --format mcap"
ODD = {  # what a folder holds: the command, its exit code, and words of its one line
    "a seed far from the others": (runs(lambda old: old.assign(seed=[0, 1, 2**40])), "report {}", 0, ""),
    "no settling band": (runs(lambda old: old.assign(settling_band=None)), "report {}", 0, ""),
    "values that are none": (runs(lambda old: old.assign(mismatch_values="[1")), FIGURE, 2, "that are none"),
    "a setting that is none": (
        runs(lambda old: old.assign(**{"plant.lag": "[1"})), f"shadow {{}} --run {RUN}", 2, "that is no value",
    ),
    "no number of periods": (runs(lambda old: old.drop(columns="periods")), EXPORT, 0, ""),
    "a name too long for a file": (runs(lambda old: old.assign(run_id="x" * 300, periods=0)), EXPORT, 0, ""),
    "steps at no time": (steps(lambda old: old.assign(time_s=np.nan)), MCAP, 2, "steps at no time"),
    "steps without a number": (steps(lambda old: old.assign(jacobian_error=None)), MCAP, 0, ""),
    "columns of several types": (differing_parts, "collect {}", 2, "Unable to merge"),
    "numbers that are no floats": (large_numbers, "collect {}", 2, "not in range"),
    "a part behind the last run": (part_behind_the_last_run, "verify {}", 1, "holds more runs than the batch has"),
    "a camera that moves at a word": (manifest(configuration={"run": {"camera_moves_at": "noon"}}), FIGURE, 0, ""),
    "lists in lists": (lists_in_lists, "report {}", 2, "nested too deeply"),
    "code that is a list": (manifest(plugins=[1]), "statistics {}", 2, "plugins must be an object of an object"),
    "a version that is a command": (
        manifest(robots=[{}], packages={"servobench": r"\input{x}"}), LATEX, 0, r"\textbackslash{}input\{x\}~",
    ),
    "a pipe for a lock": (lambda folder: os.mkfifo(folder / ".lock"), "verify {}", 2, "a results folder holds files"),
    "words for pandas": (hostile_metadata, "verify {}", 1, "nothing vouches"),
    "a table beside that is a bomb": (table_beside(BOMB), "report {}", 2, "it unpacks to 3e+07 cells"),
    "a table beside with lists": (table_beside(pa.table({"a": [[1, 2], [3]]})), "report {}", 0, ""),
    "a name of two lines": (lambda folder: (folder / "a\nb").touch(), "statistics {}", 2, r"be printed, 'a\nb'"),
    "a name that is no text": (lambda folder: (folder / "\udcff").touch(), "statistics {}", 2, "cannot be printed"),
}  # fmt: skip


@pytest.mark.parametrize("kind", ODD)
def test_an_odd_folder_is_read_or_refused_in_one_line(kind, tmp_path, monkeypatch, capsys):
    make, command, code, words = ODD[kind]
    monkeypatch.chdir(tmp_path)
    # Which take seconds
    monkeypatch.setattr("servobench.harness.apps.report.page.report_pictures", lambda *_: [])
    make(
        comparison(
            tmp_path / "folder",
            ("constant",),
            ("exp1", "exp2", "circle")[: 1 + 2 * ("seed" in kind)],
        )
    )
    assert servobench(monkeypatch, *command.format("folder").split()) == code, capsys.readouterr()
    said = capsys.readouterr()
    assert words in said.out + said.err
    assert said.err.count("\n") <= 1


def test_checksums_of_files_elsewhere_are_not_looked_at(output_of, tmp_path):
    folder = signed(tmp_path / "folder")
    with (folder / SUMS).open("a") as sums:
        sums.writelines(
            f"{'0' * 64}  {name}\n"
            for name in ("/dev/zero", "../victim", "parts/../../victim", "a\0b", "..")
        )
    assert "3 files are as they were written" in output_of("verify", folder)


def test_a_terminal_obeys_no_word_of_a_folder(output_of, tmp_path):
    rows = [
        made_up_row(f"{RUN}-{seed}", controller="a\x1b]0;b\x07\u202ec", seed=seed)
        for seed in range(2)
    ]
    write_folder(tmp_path / "folder", rows, [])
    for form in ((), ("--markdown",), ("--json",), ("--latex",)):
        said = output_of("statistics", tmp_path / "folder", *form)
        assert files.harmless(said) == said
        assert "]0;b" in said


def test_controllers_that_share_no_seed_are_no_pair(output_of, tmp_path):
    rows = [
        made_up_row(f"{name}-{seed}", controller=name, seed=seed)
        for name, seed in (("a", 0), ("b", 1))
    ]
    write_folder(tmp_path / "folder", rows, [])
    assert "a − b" not in output_of("statistics", tmp_path / "folder")
