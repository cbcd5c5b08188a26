"""Whatever a stranger's results folder holds, commands write only where the user said, and run nothing in it."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib.font_manager  # noqa: F401 - fills its cache before anything is noted
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from kit.command import servobench
from kit.folders import MANIFEST, comparison, made_up_row, made_up_steps, write_folder
from servobench.harness.batch import results, tables
from servobench.harness.run.result import RunResult
from servobench.plant.contract import files
from servobench.plant.contract.checksums import SUMS, write_vouched

RUN = "kinematic-constant-exp1-moderate-0"
TEXTS = ("plant", "task", "mismatch", "robot", "sensing", "engine", "task_kind", "feature_unit", "outcome", "reason")
PAYLOADS = ("../../escaped", "/ELSEWHERE/escaped", "=cmd|'/C calc'!A1", "$(touch escaped)", "<b>", "x\n## y", "%s{0}")
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
TARGETS = {"os.rename": (0, 1), "os.link": (1,), "os.symlink": (1,)}  # arguments that are written, by event
TARGETS |= dict.fromkeys(("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "shutil.rmtree"), (0,))
RELATIVE = ("os.mkdir", "os.remove", "os.rmdir", "os.rename")
OWN_PROGRAMS = ("git", "fc-list")  # which servobench and matplotlib start
PROGRAMS = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen")
_notes: list[list[tuple[str, str]]] = []  # the list of the moment: a hook cannot be taken away


def _note(event: str, arguments: tuple[object, ...]) -> None:
    if not _notes:
        return
    if event == "open":
        path, mode, flags = arguments
        if isinstance(path, str | bytes) and (set(str(mode)) & set("wax+") or int(flags) & WRITING):
            _notes[-1].append((event, os.path.realpath(os.fsdecode(path))))
    elif event in TARGETS:
        at = arguments[-1] if event in RELATIVE else -1  # a descriptor of the folder from which paths count
        base = Path(f"/proc/self/fd/{at}" if isinstance(at, int) and at >= 0 else "")
        for given in (arguments[index] for index in TARGETS[event]):
            if not isinstance(given, int):  # an open file was noted when it was opened
                path = base / os.fsdecode(given)
                _notes[-1].append((event, str(path.parent.resolve() / path.name)))
    elif event in PROGRAMS and Path(str(arguments[0])).name not in OWN_PROGRAMS:
        _notes[-1].append((event, str(arguments[0])))


sys.addaudithook(_note)


@contextmanager
def noting() -> Iterator[list[tuple[str, str]]]:
    """Yield what is opened for writing, renamed, removed or started within the context."""
    _notes.append([])
    try:
        yield _notes[-1]
    finally:
        _notes.pop()


def row(**values: object) -> dict[str, object]:
    return made_up_row(RUN, controller="constant", robot="ur5", sensing="position", **values)


def signed(folder: Path, **values: object) -> Path:
    """Write an unfinished folder with one run and with checksums that fit."""
    results.create_folder(folder, MANIFEST | {"run_count": 2})
    run = row() | values
    results.write_part(folder, 0, [RunResult(run, made_up_steps(str(run["run_id"]), periods=5))])
    return folder


def linked(name: str) -> Callable[[Path, Path], None]:
    """Return what puts a link to a file or folder of the user in the place of a name."""

    def make(folder: Path, victim: Path) -> None:
        signed(folder)
        if name == SUMS:
            (folder / SUMS).rename(victim)
        (folder / name).symlink_to(victim.parent if name == "recordings" else victim)

    return make


def piped(folder: Path, _victim: Path) -> None:
    os.mkfifo(signed(folder) / "more.csv")


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
    "a pipe": piped,
    "words": worded,
    "code": coded,
}
ACCEPTED = ("words", "code")
COMMANDS = (
    "statistics {}", "figures {}", "report {}", "verify {}",
    "export {} --out out/csv", "export {} --out out/mcap --format mcap",
    f"shadow {{}} --run {RUN} --controller constant --out out/seen.csv", f"record {{}} --run {RUN} --kinds snapshots",
    "compare --controllers constant --plants kinematic --tasks exp1 --workers 1 --resume --out {}", "collect {}",
)  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_no_command_writes_outside_of_a_hostile_folder_or_runs_it(kind, tmp_path, monkeypatch, capsys):
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
    allowed = [os.path.realpath(tmp_path / name) for name in ("home/folder", "temporary", "cache", "out")]
    for command in COMMANDS:
        with noting() as noted:
            code = servobench(monkeypatch, *command.format(folder).split())
        said = capsys.readouterr()
        outside = [each for each in noted if not any(f"{each[1]}/".startswith(f"{root}/") for root in allowed)]
        assert [each for each in outside if each[1] != os.devnull] == [], command
        if kind not in ACCEPTED:
            assert code in (1, 2) if command.startswith("verify") else code == 2, (command, said)
            assert said.err.count("\n") <= 1, command
    assert victim.read_text() == before
    assert not list(tmp_path.rglob("escaped*"))


def test_a_spreadsheet_runs_no_cell_of_an_export(tmp_path, monkeypatch):
    worded(tmp_path / "folder", tmp_path)
    assert servobench(monkeypatch, "export", str(tmp_path / "folder"), "--out", str(tmp_path / "csv")) == 0
    runs = pd.read_csv(tmp_path / "csv" / "runs.csv")
    assert runs.loc[0, "controller"] == "'=cmd|'/C calc'!A1"
    assert runs.loc[0, "'=1+1"] == "'@x"
    assert not runs.map(lambda cell: isinstance(cell, str) and cell.startswith(files.FORMULA)).any(axis=None)
    assert runs.loc[0, "seed"] == 0


BOMB = pa.table({f"x{index}": pa.nulls(10**6, pa.float64()) for index in range(30)})
WRONG = {
    "texts for numbers": (lambda runs: runs.assign(rms_error="much"), "has (large_)?string in the column rms_error"),
    "numbers for texts": (lambda runs: runs.assign(controller=1), "has int64 in the column controller, where texts"),
    "no number that a metric has": (
        lambda runs: runs.assign(overshoot=-np.inf),
        "the column overshoot has the number -inf",
    ),
    "a run twice": (lambda runs: pd.concat([runs, runs, runs.assign(controller="b")]), "constant has several runs of"),
    "names of two lines": (lambda runs: runs.assign(**{"a\nb": 1}), "a name that cannot be printed"),
    "too many columns": (
        lambda runs: pd.concat([runs, pd.DataFrame(0, runs.index, [f"x{i}" for i in range(10_001)])], axis=1),
        "a table has at most 10000",
    ),
    "a bomb": (lambda runs: BOMB.to_pandas(), r"is a bomb: it unpacks to 3e\+07 cells"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_table_of_wrong_columns_is_one_line(kind, tmp_path, monkeypatch, capsys):
    folder = comparison(tmp_path / "folder", ("constant",), ("exp1",))
    change, words = WRONG[kind]
    changed = change(results.load_runs(folder))
    write_vouched(folder, {results.RUNS: changed.to_parquet})
    for command in ("statistics",) if kind == "a run twice" else ("statistics", "report"):
        assert servobench(monkeypatch, command, str(folder)) == 2
        error = capsys.readouterr().err
        assert re.search(words, error), error
        assert error.count("\n") == 1


def test_controllers_that_share_no_seed_are_no_pair(tmp_path, monkeypatch, capsys):
    rows = [made_up_row(f"{name}-{seed}", controller=name, seed=seed) for name, seed in (("a", 0), ("b", 1))]
    write_folder(tmp_path / "folder", rows, [])
    assert servobench(monkeypatch, "statistics", str(tmp_path / "folder")) == 0
    assert "a − b" not in capsys.readouterr().out


def test_empty_columns_of_numbers_have_the_type_of_numbers():
    table = tables.as_table([made_up_row(RUN, latency_s=None, period_s=None, noise_factor=1.0, nothing=None)])
    assert [str(table.schema.field(name).type) for name in ("latency_s", "period_s", "nothing")] == [
        "double", "double", "null",
    ]  # fmt: skip
