"""Whatever a controller does, each of its runs is a row, no other run notices, and nothing of it stays behind."""

import os
import re
import signal
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from kit.command import finish, judged, left_behind, part_count, servobench, start, wait_for
from night import hostile_controllers
from servobench.harness.batch import results

HOSTILE = Path(hostile_controllers.__file__)
MARK = "SERVOBENCH_TEST_MARK"  # an environment variable that all processes of a command inherit
SOON = 5.0  # [s] until nothing is left of a command that was ended
SHORT = ("--set", "random.duration=0.5", "--seeds", "1")
LIMITS = ("--run-timeout", "8", "--run-memory", "600MB")
KILLED = "the run killed the process that carried it out"
IN_LINE = r" \(hostile_controllers.py:\d+ in \w+\.strike\)"
WANTED = {  # by controller: status and reason of its runs
    "ExitsWhileBuilt": ("crashed", f"{KILLED}: exit code 3, before its first period"),
    "Raises": ("crashed", f"KeyError: 'gain'{IN_LINE}"),
    "RaisesUnspeakable": ("crashed", f"Unspeakable: its text cannot be had, which raises RuntimeError{IN_LINE}"),
    "Leaves": ("crashed", f"SystemExit: 4{IN_LINE}"),
    "Interrupts": ("crashed", f"KeyboardInterrupt{IN_LINE}"),
    "InterruptsItself": ("completed", ""),
    "Exits": ("crashed", f"{KILLED}: exit code 9, in the period from .* s on"),
    "Segfaults": ("crashed", f"{KILLED}: SIGSEGV, in the period from .* s on"),
    "EndsItsParent": ("crashed", KILLED),
    "StopsItsParent": ("timed_out", "the run took longer than 8 s"),
    "Forges": ("crashed", "the answer of the run cannot be read: it is not the result of a run"),
    "ClosesFiles": ("crashed", f"{KILLED}.*"),
    "Hangs": ("timed_out", "the run took longer than 8 s"),
    "LeaksInChild": ("out_of_memory", "the run held more than 600 MB of memory"),
    "Leaks": ("out_of_memory", r"(the run held more than 600 MB of memory|MemoryError: .*)"),
    "AsksForTooMuch": ("out_of_memory", "MemoryError: Unable to allocate 2.00 TiB .*"),
    "Forks": ("completed", ""),
    "LeavesChildren": ("completed", ""),
    "Prints": ("completed", ""),
    "WaitsForKeys": ("crashed", f"EOFError: EOF when reading a line{IN_LINE}"),
    "Quiet": ("completed", ""),
}  # fmt: skip
FALSE_WORLD = "Lies"


def places(*names: str) -> str:
    return ",".join(f"{HOSTILE}:{name}" for name in names)


def assert_nothing_stays(mark: str) -> None:
    wait_for(lambda: not left_behind(MARK, mark), SOON)


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> pd.DataFrame:
    """The table of one sweep with all hostile controllers, and one that is quiet at the end."""
    out, mark = tmp_path_factory.mktemp("hostile") / "out", f"swept by {os.getpid()}"
    names = (FALSE_WORLD, *WANTED)
    arguments = ("--controllers", places(*names), "--workers", "1", *SHORT, *LIMITS)
    forged = out.with_name("forged")
    code, output = finish(
        start("sweep", *arguments, "--out", str(out), **{MARK: mark, "FORGED": str(forged)})
    )
    assert code == 0, output
    assert not forged.exists()
    assert "Traceback" not in output
    assert_nothing_stays(mark)
    return results.load_runs(out).assign(log=(out / results.FAILURES).read_text())


def test_every_run_is_a_row(swept):
    assert len(swept) == len(WANTED) + 1
    assert swept["run_id"].is_unique


@pytest.mark.skipif(sys.platform != "linux", reason="memory and exit codes are those of Linux")
@pytest.mark.parametrize("name", WANTED)
def test_a_row_says_what_its_controller_did(swept, name):
    status, reason = WANTED[name]
    (row,) = swept[swept["controller"] == name].to_dict("records")
    assert row["status"] == status, row["reason"]
    assert re.fullmatch(reason, row["reason"])


def test_the_log_shows_where_a_run_hangs_or_strikes(swept):
    entries = swept["log"].iloc[0].split("\n\n")
    for name in ("Hangs", "Segfaults"):
        entry = next(each for each in entries if f"-{name}-" in each)
        assert f'File "{HOSTILE}"' in entry
        assert "in strike" in entry


def test_the_undisturbed_run_is_that_of_a_quiet_sweep(swept, tmp_path, monkeypatch):
    """It comes after a controller that falsified numpy, the clock and the working directory."""
    out = tmp_path / "quiet"
    arguments = ("--controllers", places("Quiet"), "--workers", "1", "--no-isolate", *SHORT)
    assert servobench(monkeypatch, "sweep", *arguments, "--out", str(out)) == 0
    ours = swept[swept["controller"] == "Quiet"].drop(columns="log").reset_index(drop=True)
    pd.testing.assert_frame_equal(judged(ours), judged(results.load_runs(out)), check_exact=True)


def test_a_single_run_ends_with_its_row(output_of, tmp_path):
    out = tmp_path / "out"
    single = (
        "run",
        places("Segfaults"),
        "--plant",
        "kinematic",
        "--no-figures",
        "--set",
        "exp2.duration=0.5",
    )
    assert "1 of 1 run failed" in output_of(*single, "--out", out, code=1)
    assert results.load_runs(out)["status"].tolist() == ["crashed"]


def test_nothing_outlives_a_killed_batch_and_resumed_it_goes_past_a_run_that_hangs(
    tmp_path, monkeypatch
):
    out, mark = tmp_path / "out", "resumed"
    names = places("Quiet", "HangsWithChildren")
    arguments = (
        "sweep",
        "--controllers",
        names,
        "--workers",
        "1",
        *SHORT,
        "--run-timeout",
        "3",
        "--out",
        str(out),
    )
    process = start(*arguments, **{MARK: mark})
    wait_for(
        lambda: (
            part_count(out) > 0
            and any("time.sleep(300)" in line for line in left_behind(MARK, mark))
        )
    )
    os.kill(process.pid, signal.SIGKILL)
    finish(process)
    assert_nothing_stays(mark)
    assert servobench(monkeypatch, *arguments, "--resume") == 0
    assert results.load_runs(out)["status"].tolist() == ["completed", "timed_out"]


def test_ctrl_c_ends_a_comparison_at_once(tmp_path):
    out, mark = tmp_path / "out", "interrupted"
    comparing = (
        "compare",
        "--controllers",
        f"constant,{places('Hangs')}",
        "--tasks",
        "exp2",
        "--workers",
        "2",
    )
    process = start(*comparing, "--set", "exp2.duration=0.5", "--out", str(out), **{MARK: mark})
    wait_for(lambda: part_count(out) > 0)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    code, output = finish(process)
    assert time.monotonic() - began < SOON
    assert code == 130
    assert "Traceback" not in output
    assert "interrupted: 1 of 2 runs are finished and kept" in " ".join(output.split())
    assert "--resume" in output
    assert_nothing_stays(mark)
    assert len(results.load_runs(out)) == 1
