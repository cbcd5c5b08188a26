"""A sweep on a real Dask cluster of two worker processes on this machine."""

import os
import re
import signal
import subprocess
import sys
from importlib.util import find_spec

import pandas as pd
import pytest

from kit.command import PACKAGE, finish, judged, part_count, servobench, start, wait_for
from kit.own import CONFIGURED, CONFIGURED_CELL, write
from servobench.harness.batch import results
from servobench.harness.batch.blocks import open_workers
from servobench.harness.batch.processes import Bounds
from servobench.plant.contract.faults import ConfigurationError

pytestmark = pytest.mark.skipif(
    find_spec("distributed") is None, reason="the extra 'cluster' is not installed"
)

SEEDS = ("--seeds", "20", "--set", "random.duration=1.5")
RUNS = 80  # the first block is there long before the last


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler and its two workers."""
    folder, started = tmp_path / "cluster", []
    folder.mkdir()

    def launch(name, *arguments):
        with (folder / f"{name}.log").open("wb") as log:
            started.append(
                subprocess.Popen(
                    [sys.executable, "-m", "dask", *arguments], stdout=log, stderr=log, start_new_session=True,
                    env={**os.environ, "PYTHONPATH": str(PACKAGE)}, cwd=folder,
                )
            )  # fmt: skip

    def address():
        return re.search(
            r"Scheduler at:\s+(tcp://127.0.0.1:\d+)", (folder / "scheduler.log").read_text()
        )

    try:
        launch(
            "scheduler",
            "scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--dashboard-address",
            ":0",
        )
        wait_for(lambda: address() is not None)
        for name in ("first", "second"):
            launch(name, "worker", address()[1], "--nthreads", "1", "--no-dashboard")
        yield address()[1], started[1:]
    finally:
        for process in started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_a_cluster_runs_what_is_in_files_and_a_worker_killed_in_a_sweep_loses_no_run(
    cluster, tmp_path, monkeypatch
):
    scheduler, workers = cluster
    cell, mine = (
        write(tmp_path, CONFIGURED_CELL, "a/cell.py"),
        write(tmp_path, CONFIGURED, "b/sent.py"),
    )
    named = ("--plants", f"{cell}:Cell,kinematic", "--controllers", f"{mine},broyden")
    asked = ("sweep", *named, *SEEDS, "--set", "Mine.gain=3", "--set", "Cell.speed=0.5", "--out")
    remote = start(*asked, str(tmp_path / "remote"), "--scheduler", scheduler)
    wait_for(lambda: part_count(tmp_path / "remote") > 0)
    os.killpg(workers[0].pid, signal.SIGKILL)
    finished_before = len(results.load_runs(tmp_path / "remote"))
    code, output = finish(remote)
    assert code == 0, output
    assert (
        servobench(monkeypatch, *asked, str(tmp_path / "local"), "--workers", "1", "--no-isolate")
        == 0
    )
    assert 0 < finished_before < RUNS
    tables = [judged(results.load_runs(tmp_path / name)) for name in ("remote", "local")]
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert len(tables[0]) == RUNS
    assert set(tables[0]["plant"]) == {"Cell", "kinematic"}
    assert set(tables[0]["controller"]) == {"Mine", "broyden"}
    assert not set(tables[0]["outcome"]) & {"crashed"}, tables[0]["reason"].tolist()


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Bounds(), r"scheduler tcp://127\.0\.0\.1:9 does not answer; start one with"),
        (Bounds(5.0), "limits of time and memory are for processes of this machine"),
        (Bounds(run_memory=1e9), "limits of time and memory are for processes of this machine"),
    ],
)
def test_a_cluster_that_cannot_be_used_is_refused(limits, message):
    with pytest.raises(ConfigurationError, match=message):
        open_workers(None, "tcp://127.0.0.1:9", limits).__enter__()
