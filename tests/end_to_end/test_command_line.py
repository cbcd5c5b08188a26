"""The command line as a user meets it: what it prints, what it leaves on disk, and how it refuses bad input."""

import json
import os
import signal
import sys
from pathlib import Path

import pandas as pd
import pytest

from kit.command import carried_out, judged
from kit.plants import NEEDS_BULLET
from servobench.harness.cli.terminal import ending_alike


def test_a_run_leaves_tables_a_manifest_and_figures(output_of, tmp_path):
    out = tmp_path / "out"
    arguments = [
        "run",
        "--plant",
        "kinematic",
        "--controller",
        "calibrated",
        "--task",
        "exp2",
        "--seed",
        "3",
    ]
    assert "calibrated" in output_of(*arguments, "--set", "exp2.duration=3", "--out", out)
    runs, steps = pd.read_parquet(out / "runs.parquet"), pd.read_parquet(out / "steps.parquet")
    assert runs[["status", "seed", "mismatch"]].values.tolist() == [["completed", 3, "moderate"]]
    assert len(steps) == 60
    assert steps["time_s"].tolist() == [k * 0.05 for k in range(60)]
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["configuration"]["exp2"]["duration"] == 3
    assert manifest["seeds"] == "3"
    assert manifest["packages"]["numpy"]
    assert manifest["blas"][0]["name"]
    figures = {path.stem for path in (out / "figures").glob("*.png")}
    assert len(figures) == len(list((out / "figures").iterdir())) == 5
    assert not (out / "report.html").exists()
    assert json.loads(runs["mismatch_values"][0])["camera_angle"] != 0.0


@pytest.mark.parametrize("plant", ["kinematic", pytest.param("bullet", marks=NEEDS_BULLET)])
def test_the_same_seeds_give_the_same_tables_bit_for_bit_in_one_and_in_two_workers(
    output_of, tmp_path, plant
):
    tables = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        asked = [
            "--plants",
            plant,
            "--controllers",
            "ukf_mfac,constant",
            "--tasks",
            "exp2,random",
            "--seeds",
            "5:6",
        ]
        asked += [
            "--set",
            "exp2.duration=0.5",
            "--set",
            "random.duration=0.5",
            "--no-figures",
            "--no-report",
        ]
        output_of("compare", *asked, "--workers", workers, "--out", out)
        tables.append(
            [judged(pd.read_parquet(out / name)) for name in ("runs.parquet", "steps.parquet")]
        )
    for single, double in zip(*tables, strict=True):
        assert len(single) >= 4
        pd.testing.assert_frame_equal(single, double, check_exact=True)


def test_a_run_without_figures_leaves_its_tables_only(output_of, tmp_path):
    out = tmp_path / "out"
    arguments = (
        "run",
        "constant",
        "--plant",
        "kinematic",
        "--set",
        "exp2.duration=0.5",
        "--no-figures",
    )
    assert f"tables in {out}" in " ".join(output_of(*arguments, "--out", out).split())
    assert sorted(path.name for path in out.iterdir()) == [
        "SHA256SUMS", "manifest.json", "runs.parquet", "steps.parquet",
    ]  # fmt: skip


def test_a_command_that_is_started_with_interrupts_ignored_can_be_interrupted():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with ending_alike(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_tests_that_are_started_with_interrupts_ignored_can_interrupt_nevertheless(tmp_path):
    (tmp_path / "test_handler.py").write_text(
        "import signal\n\n\ndef test_it():\n    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
    )
    tests = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "conftest",
        "-p",
        "no:cacheprovider",
        "test_handler.py",
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    done = carried_out(
        "sh", "-c", 'trap "" INT; exec "$@"', "sh", *tests, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stdout
