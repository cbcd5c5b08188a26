"""A sweep gives the same table however it is interrupted, and no run is lost."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pandas as pd
import pytest

from kit.command import finish, judged, part_count, servobench, start, wait_for
from servobench.harness.batch import results
from servobench.harness.batch.blocks import CHUNK
from servobench.harness.batch.plan import Batch, SweepPlan
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.result import RunResult

SWEEP = (
    "sweep", "--controllers", "constant,broyden", "--vary", "camera_rotation=0:40:20deg", "--noise", "1,2",
    "--seeds", "4", "--workers", "2", "--set", "random.duration=2",
)  # fmt: skip
RUNS = 48


def assert_same_runs(*folders: Path) -> None:
    one, other = (judged(results.load_runs(folder)) for folder in folders)
    pd.testing.assert_frame_equal(one, other, check_exact=True)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sweep") / "whole"
    code, output = finish(start(*SWEEP, "--out", str(out)))
    assert code == 0, output
    return out


def test_every_combination_is_a_row_and_says_where_it_stands(undisturbed):
    table = judged(results.load_runs(undisturbed))
    assert len(table) == RUNS
    assert table["run_id"].is_unique
    assert (table["status"] == "completed").all()
    assert set(table["axis"]) == {"camera_rotation"}
    assert list(dict.fromkeys(table["magnitude"])) == [0.0, 20.0, 40.0]
    assert set(table["unit"]) == {"deg"}
    assert set(table["noise_factor"]) == {1.0, 2.0}
    assert set(table["mismatch"]) == {f"moderate+camera_rotation={angle}deg" for angle in (0, 20, 40)}
    assert not (undisturbed / results.PARTS).exists()
    assert not (undisturbed / results.STEPS).exists()


def test_a_killed_sweep_that_is_resumed_gives_the_table_of_an_undisturbed_one(undisturbed, tmp_path, monkeypatch):
    out = tmp_path / "killed"
    process = start(*SWEEP, "--out", str(out))
    wait_for(lambda: part_count(out) > 0)
    os.killpg(process.pid, signal.SIGKILL)
    finish(process)
    assert 0 < len(results.load_runs(out)) < RUNS
    assert servobench(monkeypatch, *SWEEP, "--out", str(out), "--resume") == 0
    assert_same_runs(out, undisturbed)


def test_a_sweep_that_is_collected_half_way_can_still_be_resumed(undisturbed, tmp_path, monkeypatch):
    out = tmp_path / "half"
    results.create_folder(out, results.read_manifest(undisturbed))
    rows = results.load_runs(undisturbed).to_dict("records")
    part = [RunResult(row, None) for row in rows[CHUNK : 2 * CHUNK]]
    results.write_part(out, CHUNK, part)
    assert servobench(monkeypatch, "collect", str(out)) == 0
    assert len(results.load_runs(out)) == CHUNK
    assert servobench(monkeypatch, *SWEEP, "--out", str(out), "--resume") == 0
    assert_same_runs(out, undisturbed)


def test_a_finished_sweep_is_not_run_again(undisturbed, monkeypatch, capsys):
    stamp = (undisturbed / results.RUNS).stat().st_mtime_ns
    assert servobench(monkeypatch, *SWEEP, "--out", str(undisturbed), "--resume") == 0
    assert (undisturbed / results.RUNS).stat().st_mtime_ns == stamp
    assert "camera_rotation=20deg" in capsys.readouterr().out


def test_a_sweep_over_control_periods_has_the_same_robots_and_the_rows_of_single_runs(monkeypatch, capsys, tmp_path):
    out, alone = tmp_path / "periods", tmp_path / "alone"
    common = ("sweep", "--controllers", "rbf_pid", "--seeds", "2", "--workers", "1", "--set", "random.duration=1")
    assert servobench(monkeypatch, *common, "--period", "0.05,0.02", "--out", str(out)) == 0
    assert "50" in capsys.readouterr().out
    assert servobench(monkeypatch, *common, "--set", "run.period=0.02", "--out", str(alone)) == 0
    table, fast = results.load_runs(out), judged(results.load_runs(alone))
    assert table["period_s"].tolist() == [0.05, 0.05, 0.02, 0.02]
    assert table["periods"].tolist() == [20, 20, 50, 50]
    assert table["run_id"].str.contains("-period").all()
    drawn = table.groupby("seed")["mismatch_values"].nunique()
    assert drawn.tolist() == [1, 1]
    own = ["run_id", "period_s"]
    pd.testing.assert_frame_equal(
        judged(table).iloc[2:].drop(columns=own).reset_index(drop=True), fast.drop(columns=own), check_exact=True
    )


def test_ctrl_c_keeps_what_is_finished(tmp_path):
    out = tmp_path / "stopped"
    process = start(*SWEEP, "--out", str(out))
    wait_for(lambda: part_count(out) > 0)
    process.send_signal(signal.SIGINT)
    code, output = finish(process)
    assert code == 130
    assert "Traceback" not in output
    assert "--resume" in output
    assert len(results.load_runs(out)) >= 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--vary", "lens=0:1:1"), "--vary: unknown mismatch axis 'lens': did you mean 'links'? valid: "),
        (("--vary", "links=30:0:10%"), "--vary: the range '30:0:10%' of links is empty"),
        (("--vary", f"links={'9' * 320}:30:10%"), "of links is empty"),
        (("--noise", "loud"), "kinematic.sensing.noise_factor must be a number, got 'loud'"),
        (("--noise", "-1"), "kinematic.sensing.noise_factor must be at least 0, got -1"),
        (("--period", "fast"), "run.period must be a number, got 'fast'"),
        (("--period", "0"), "run.period must be above 0, got 0"),
        (("--vary", "run.period=0:0.2:0.05"), "run.period must be above 0, got 0"),
        (("--vary", "run.perod=0.1"), "run has no setting 'perod': did you mean 'period'?"),
        (("--vary", "plant.lag=1:0:0.5"), "--vary: the range '1:0:0.5' of plant.lag is empty"),
        (("--vary", "plant.lag="), "--vary plant.lag needs values, such as run.period=0.02,0.05"),
        (("--vary", "plant.lag=0,0"), "--vary plant.lag names 0 twice"),
        (("--vary", "latency=0,0.1", "--latency", "0"), "--vary gives latency twice"),
        (("--vary", "latency=0,0.1", "--vary", "plant.sensing.latency=0"), "a setting is varied twice in latency"),
        (("--vary", "bullet.lag=0.1"), "the setting bullet.lag cannot be varied in runs of rbfnn_mfac on kinematic"),
        (
            ("--vary", "plant.sensing.jitter=0.1", "--mismatch", "jitter=50ms"),
            "is varied, and the mismatch jitter=50ms",
        ),
        (("--period", "0.0333"), "period must be a whole number of milliseconds"),
        (("--scheduler", "nowhere"), "--scheduler needs an address such as tcp://127.0.0.1:8786, got 'nowhere'"),
        (("--mismatch", "moderate,moderate"), "--mismatch names moderate twice"),
        (("--controllers", "ukf_mfca"), "did you mean 'ukf_mfac'"),
        (("--resume",), "is not a results folder"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing_behind(monkeypatch, capsys, tmp_path, arguments, message):
    out = tmp_path / "out"
    assert servobench(monkeypatch, "sweep", "--seeds", "1", "--out", str(out), *arguments) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1
    assert not out.exists()


def test_a_folder_that_exists_or_belongs_to_another_sweep_is_refused(undisturbed, monkeypatch, capsys):
    assert servobench(monkeypatch, *SWEEP, "--out", str(undisturbed)) == 2
    assert "exists already" in capsys.readouterr().err
    assert servobench(monkeypatch, *SWEEP, "--seeds", "5", "--out", str(undisturbed), "--resume") == 2
    assert "holds results of other runs or settings" in capsys.readouterr().err
    assert servobench(monkeypatch, *SWEEP, "--set", "kinematic.lag=0.03", "--out", str(undisturbed), "--resume") == 2
    assert "holds results of other runs or settings" in capsys.readouterr().err


def test_variations_are_put_on_top_of_the_mismatch_one_by_one():
    batch = Batch(("kinematic",), ("constant",), ("random",), ("none", "moderate"), (0, 1))
    plan = SweepPlan.parse(batch, ("links=10/20%", "tool=5mm", "latency=0,2"))
    cells = plan.cells()
    assert len(cells) == 3 * 2 * 2 * 2
    assert {str(cell.request.mismatch) for cell in cells} == {
        "links=10%", "moderate+links=10%", "links=20%", "moderate+links=20%", "tool=5mm", "moderate+tool=5mm",
    }  # fmt: skip
    with pytest.raises(ConfigurationError, match="--vary: unknown mismatch axis"):
        SweepPlan.parse(batch, ["zoom=1:2:1"])
