"""A sweep on a real Dask cluster of two worker processes on this machine."""

import os
import re
import signal
import subprocess
import sys

import pandas as pd
import pytest

from kit.command import PACKAGE, finish, judged, part_count, start, wait_for
from kit.own import CONFIGURED, CONFIGURED_CELL, write
from servobench.harness.batch import results
from servobench.harness.batch.blocks import open_workers
from servobench.harness.batch.processes import Bounds
from servobench.plant.contract.faults import ConfigurationError

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

SWEEP = ("sweep", "--controllers", "broyden,rls", "--seeds", "300", "--set", "random.duration=4")
RUNS = 600  # six blocks: the first is there long before the last


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """The address of a scheduler and its two workers."""
    tmp_path, started = tmp_path_factory.mktemp("cluster"), []

    def launch(name, *arguments):
        with (tmp_path / f"{name}.log").open("wb") as log:
            started.append(
                subprocess.Popen(
                    [sys.executable, "-m", "dask", *arguments], stdout=log, stderr=log, start_new_session=True,
                    env={**os.environ, "PYTHONPATH": str(PACKAGE)}, cwd=tmp_path,
                )
            )  # fmt: skip

    def address():
        return re.search(r"Scheduler at:\s+(tcp://127.0.0.1:\d+)", (tmp_path / "scheduler.log").read_text())

    try:
        launch("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", ":0")
        wait_for(lambda: address() is not None)
        for name in ("first", "second"):
            launch(name, "worker", address()[1], "--nthreads", "1", "--no-dashboard")
        yield address()[1], started[1:]
    finally:
        for process in started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_a_cluster_carries_out_a_controller_and_a_plant_from_files(cluster, tmp_path):
    cell, mine = write(tmp_path, CONFIGURED_CELL, "a/cell.py"), write(tmp_path, CONFIGURED, "b/mine.py")
    named = f"--plants {cell}:Cell --controllers {mine},constant --tasks exp1 --seeds 2 --no-report"
    asked = ["compare", *named.split(), "--set", "exp1.duration=1", "--set", "Mine.gain=3", "--set", "Cell.speed=0.5"]
    places = {"local": ("--workers", "1"), "remote": ("--scheduler", cluster[0])}
    started = [start(*asked, "--out", str(tmp_path / name), *where) for name, where in places.items()]
    for process in started:
        code, output = finish(process)
        assert code == 0, output
    tables = [judged(results.load_runs(tmp_path / name)) for name in places]
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert len(tables[0]) == 4
    assert set(tables[0]["plant"]) == {"Cell"}
    assert set(tables[0]["controller"]) == {"Mine", "constant"}
    assert not set(tables[0]["outcome"]) & {"crashed"}, tables[1]["reason"].tolist()


def test_a_worker_that_is_killed_in_mid_sweep_loses_no_run(cluster, tmp_path):
    scheduler, workers = cluster
    local = start(*SWEEP, "--out", str(tmp_path / "local"), "--workers", "1")
    remote = start(*SWEEP, "--out", str(tmp_path / "remote"), "--scheduler", scheduler)
    wait_for(lambda: part_count(tmp_path / "remote") > 0)
    os.killpg(workers[0].pid, signal.SIGKILL)
    finished_before = len(results.load_runs(tmp_path / "remote"))
    for process in (local, remote):
        code, output = finish(process)
        assert code == 0, output
    assert 0 < finished_before < RUNS
    tables = [judged(results.load_runs(tmp_path / name)) for name in ("remote", "local")]
    pd.testing.assert_frame_equal(*tables, check_exact=True)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Bounds(), r"scheduler tcp://127\.0\.0\.1:9 does not answer; start one with"),
        (Bounds(5.0), "--run-timeout works with processes of this machine only"),
        (Bounds(run_memory=1e9), "--run-memory works with processes of this machine only"),
    ],
)
def test_a_cluster_that_cannot_be_used_is_refused(limits, message):
    with pytest.raises(ConfigurationError, match=message):
        open_workers(None, "tcp://127.0.0.1:9", limits).__enter__()
