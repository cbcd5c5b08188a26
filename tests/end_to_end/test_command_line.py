"""The command line as a user meets it: what it prints, what it leaves on disk, and how it refuses bad input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from kit.command import finish, judged, part_count, servobench, start, wait_for
from kit.plants import NEEDS_BULLET
from servobench.harness.batch import results


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("plants",), ("kinematic", "bullet")),
        (("controllers",), ("constant", "calibrated", "ukf_mfac")),
        (("tasks",), ("exp1", "circle", "random", "waypoints")),
        (("controllers", "ukf_mfac"), ("ukf_mfac.law.step_weight", "ukf_mfac.estimator.feature_noise")),
        (("plants", "kinematic"), ("kinematic.lag", "0.05")),
    ],
)
def test_what_there_is_can_be_listed(monkeypatch, capsys, arguments, words):
    assert servobench(monkeypatch, *arguments) == 0
    shown = capsys.readouterr().out
    for word in words:
        assert word in shown


def test_a_run_leaves_tables_a_manifest_and_figures(monkeypatch, capsys, tmp_path):
    out = tmp_path / "out"
    arguments = ["run", "--plant", "kinematic", "--controller", "calibrated", "--task", "exp2", "--seed", "3"]
    assert servobench(monkeypatch, *arguments, "--set", "exp2.duration=3", "--out", str(out)) == 0
    assert "calibrated" in capsys.readouterr().out
    runs, steps = pd.read_parquet(out / "runs.parquet"), pd.read_parquet(out / "steps.parquet")
    assert runs[["status", "seed", "mismatch"]].values.tolist() == [["completed", 3, "moderate"]]
    assert len(steps) == 60
    assert steps["time_s"].tolist() == [k * 0.05 for k in range(60)]
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["configuration"]["exp2"]["duration"] == 3
    assert manifest["seeds"] == "3"
    assert manifest["packages"]["numpy"]
    figures = {path.stem for path in (out / "figures").glob("*.png")}
    assert figures == {path.stem for path in (out / "figures").glob("*.pdf")}
    assert len(figures) == 6
    assert not (out / "report.html").exists()
    assert json.loads(runs["mismatch_values"][0])["camera_angle"] != 0.0


@pytest.mark.parametrize("plant", ["kinematic", pytest.param("bullet", marks=NEEDS_BULLET)])
def test_the_same_seeds_give_the_same_tables_bit_for_bit_in_one_process_and_in_two_workers(
    monkeypatch, tmp_path, plant
):
    tables = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        assert (
            servobench(
                monkeypatch, "compare", "--plants", plant, "--controllers", "ukf_mfac,constant",
                "--tasks", "exp2,random", "--mismatch", "moderate", "--seeds", "5:6", "--workers", workers,
                "--out", str(out), "--set", "exp2.duration=1", "--set", "random.duration=1", "--no-report",
            )
            == 0
        )  # fmt: skip
        tables.append([judged(pd.read_parquet(out / name)) for name in ("runs.parquet", "steps.parquet")])
    for single, double in zip(*tables, strict=True):
        assert len(single) >= 4
        pd.testing.assert_frame_equal(single, double, check_exact=True)


@NEEDS_BULLET
@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("run.period=0.0333", "period must be a whole number of milliseconds, because latency is no multiple of the"),
        ("bullet.sensing.feature_noise=-1", "bullet.sensing.feature_noise must be"),
    ],
)
def test_bad_settings_of_the_rendered_plant_are_one_line_and_nothing_is_written(
    monkeypatch, capsys, tmp_path, assignment, message
):
    monkeypatch.chdir(tmp_path)
    assert servobench(monkeypatch, "run", "--plant", "bullet", "--set", assignment) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("servobench: ")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


BATCH = ("compare", "--seeds", "100", "--controllers", "constant", "--tasks", "exp2", "--workers", "2")


def test_ctrl_c_keeps_what_is_finished(tmp_path):
    out = tmp_path / "out"
    process = start(*BATCH, "--out", str(out))
    wait_for(lambda: part_count(out) >= 3)
    os.killpg(process.pid, signal.SIGINT)
    code, output = finish(process)
    assert code == 130, output
    assert "Traceback" not in output
    assert "--resume" in output
    assert 3 <= len(results.load_runs(out)) < 100


def test_tests_that_are_started_with_interrupts_ignored_can_interrupt_nevertheless(tmp_path):
    (tmp_path / "test_handler.py").write_text(
        "import signal\n\n\ndef test_it():\n    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
    )
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "conftest", "-p", "no:cacheprovider", "test_handler.py"]
    done = subprocess.run(
        ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *tests], cwd=tmp_path, check=False, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_a_killed_batch_keeps_every_finished_run_and_can_be_resumed(monkeypatch, capsys, tmp_path):
    out = tmp_path / "out"
    process = start(*BATCH, "--out", str(out))
    wait_for(lambda: part_count(out) >= 3)
    assert servobench(monkeypatch, *BATCH, "--out", str(out), "--resume") == 2
    assert "is being written by process" in capsys.readouterr().err
    os.killpg(process.pid, signal.SIGKILL)
    finish(process)
    finished = results.load_runs(out)
    assert servobench(monkeypatch, "collect", str(out)) == 0
    assert len(pd.read_parquet(out / "runs.parquet")) == len(finished)
    assert servobench(monkeypatch, *BATCH, "--out", str(out), "--resume", "--no-report") == 0
    runs = pd.read_parquet(out / "runs.parquet")
    assert 3 <= len(finished) < len(runs) == 100
    kept = runs[runs["run_id"].isin(finished["run_id"])].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, finished)  # with the times: these runs were not carried out again
    assert set(pd.read_parquet(out / "steps.parquet")["run_id"]) == set(runs["run_id"])
