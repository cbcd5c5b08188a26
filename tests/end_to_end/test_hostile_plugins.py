"""What a plug-in does to one run costs no other run, whichever command carries the runs out."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from servobench.harness.batch import results
from servobench.harness.studies.tuning.files import read_tuned

PACKAGE = Path(__file__).parents[2] / ".package"

HOSTILE = """
import os
import time
from dataclasses import replace

from servobench.plant.kinematic import ENTRY as KINEMATIC

HOW = os.environ["HOSTILE"]


def build(config, setup):
    plant = KINEMATIC.build(config, setup)
    if int(abs(setup.start[0]) * 1e4) % 2:  # about half of the robots
        return plant
    if HOW == "build":
        raise RuntimeError("no licence")
    step, close = plant.step, plant.close

    def attack(command):
        if HOW == "exit":
            os._exit(9)
        while HOW == "hang":
            time.sleep(0.1)
        return step(command)

    def fail():
        close()
        raise RuntimeError("the window is gone")

    plant.step = attack
    if HOW == "close":
        plant.close = fail
    return plant


ENTRY = replace(KINEMATIC, name="hostile", build=build)
"""
REASONS = {
    "exit": ("crashed", "the run killed the process that carried it out"),
    "build": ("crashed", "RuntimeError: no licence"),
    "close": ("crashed", "RuntimeError: the window is gone"),
    "hang": ("timed_out", "the run took longer than 8 s"),
}
COMMANDS = {
    "compare": ("--no-report", "--tasks", "random", "--seeds", "4", "--set", "random.duration=1"),
    "sweep": ("--seeds", "4", "--set", "random.duration=1"),
    "tune": ("--seeds", "4", "--trials", "1"),
}


@pytest.fixture
def plugin(tmp_path) -> Path:
    """A third party's plant, installed as far as Python can tell."""
    folder = tmp_path / "site"
    info = folder / "hostile-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "hostile.py").write_text(HOSTILE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hostile\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[servobench.plants]\nhostile = hostile:ENTRY\n")
    return folder


@pytest.mark.parametrize("how", REASONS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_run_that_fails_is_a_row_and_takes_no_other_run_with_it(plugin, tmp_path, command, how):
    out = tmp_path / "out"
    limit = ("--run-timeout", "8") if how == "hang" else ()
    finished = subprocess.run(
        [sys.executable, "-m", "servobench", command, "--plants", "hostile", "--controllers", "constant",
         "--workers", "2", *COMMANDS[command], *limit, "--out", str(out)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(PACKAGE), str(plugin))), "HOSTILE": how},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert finished.returncode == 0, finished.stderr
    assert "Traceback" not in finished.stderr
    if command == "tune":
        assert 0.0 < read_tuned(out / "constant.toml").score < 4.0
        assert "[2.0" in (out / "constant.journal").read_text() or ", 2.0" in (out / "constant.journal").read_text()
        return
    runs = results.load_runs(out)
    failed = runs[runs["status"] != "completed"]
    assert len(runs) == 4
    assert 0 < len(failed) < 4
    assert set(zip(failed["status"], failed["reason"], strict=True)) == {REASONS[how]}
    assert not (out / results.PARTS).exists()


def test_a_time_limit_holds_with_one_worker_too(plugin, tmp_path):
    out = tmp_path / "out"
    subprocess.run(
        [sys.executable, "-m", "servobench", "sweep", "--plants", "hostile", "--controllers", "constant",
         "--workers", "1", *COMMANDS["sweep"], "--run-timeout", "8", "--out", str(out)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(PACKAGE), str(plugin))), "HOSTILE": "hang"},
        capture_output=True, check=True, timeout=300,
    )  # fmt: skip
    assert set(results.load_runs(out)["status"]) == {"completed", "timed_out"}
