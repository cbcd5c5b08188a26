"""A sweep on a real Dask cluster of two worker processes on this machine."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from servobench.harness.batch import results
from servobench.harness.batch.workers import open_workers
from servobench.harness.config.settings import ConfigurationError

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

PACKAGE = Path(__file__).parents[2] / ".package"
SWEEP = ("sweep", "--controllers", "constant,broyden", "--seeds", "40", "--set", "random.duration=2")


def start(folder: Path, name: str, *arguments: str) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE)}
    with (folder / f"{name}.log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            env=environment, cwd=folder, stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip


def address(folder: Path) -> str:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        found = re.search(r"Scheduler at:\s+(tcp://127.0.0.1:\d+)", (folder / "scheduler.log").read_text())
        if found:
            return found[1]
        time.sleep(0.1)
    raise AssertionError((folder / "scheduler.log").read_text())


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler and its two workers."""
    started = [
        start(tmp_path, "scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", ":0")
    ]
    try:
        scheduler = address(tmp_path)
        for name in ("first", "second"):
            started.append(start(tmp_path, name, "worker", scheduler, "--nthreads", "1", "--no-dashboard"))
        yield scheduler, started[1:]
    finally:
        for process in started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def sweep(out: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "servobench", *SWEEP, "--out", str(out), *arguments],
        env={**os.environ, "PYTHONPATH": str(PACKAGE)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def judged(folder: Path) -> pd.DataFrame:
    table = results.load_runs(folder)
    return table[[name for name in table.columns if not name.startswith(("controller_time", "plant_time"))]]


def test_a_worker_that_is_killed_in_mid_sweep_loses_no_run(cluster, tmp_path):
    scheduler, workers = cluster
    local = sweep(tmp_path / "local", "--workers", "1")
    remote = sweep(tmp_path / "remote", "--scheduler", scheduler)
    deadline = time.monotonic() + 120
    while not list((tmp_path / "remote" / results.PARTS).glob("[0-9]*")) and time.monotonic() < deadline:
        time.sleep(0.02)
    finished_before = len(results.load_runs(tmp_path / "remote"))
    os.killpg(workers[0].pid, signal.SIGKILL)
    for process in (local, remote):
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
    assert 0 < finished_before < 80
    pd.testing.assert_frame_equal(judged(tmp_path / "remote"), judged(tmp_path / "local"), check_exact=True)


def test_a_scheduler_that_does_not_answer_is_one_line():
    with (
        pytest.raises(ConfigurationError, match=r"scheduler tcp://127\.0\.0\.1:9 does not answer; start one with"),
        open_workers(1, "tcp://127.0.0.1:9"),
    ):
        pass


def test_a_time_limit_on_a_cluster_is_refused():
    with pytest.raises(ConfigurationError, match="--run-timeout works with processes of this machine only"):
        open_workers(1, "tcp://127.0.0.1:9", 5.0).__enter__()
