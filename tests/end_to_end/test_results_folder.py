"""A results folder under attack: by a second process, a full disk, a kill at any operation, and hands."""

import fcntl
import json
import os
import random
import shutil
import signal
import threading
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import pandas as pd
import pytest

from kit.command import finish, judged, part_count, servobench, start, wait_for
from night import file_faults
from servobench.harness.apps.tuning.objective import Ledger
from servobench.harness.batch import campaign, lock, results
from servobench.harness.batch.campaign import Execution, carry_out
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import ResultsFolder
from servobench.plant.contract.faults import ConfigurationError

SWEEP = (
    "sweep", "--controllers", "constant,rls", "--seeds", "200", "--workers", "1", "--set", "random.duration=6",
)  # fmt: skip
RESUMERS = 12

linux = pytest.mark.skipif(
    not Path("/proc/self/fd").exists(), reason="the library that breaks files is for Linux"
)


def in_child(work) -> int:
    child = os.fork()
    if child:
        return child
    try:
        work()
    except BaseException as error:  # noqa: BLE001 - the parent judges by the exit code
        os._exit(
            2
            if isinstance(error, ConfigurationError) and "is being written by process" in str(error)
            else 3
        )
    os._exit(0)


def test_a_sweep_that_is_resumed_while_it_runs_is_refused_by_name_and_not_disturbed(
    refusal_of, output_of, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    first = start(*SWEEP, "--out", str(out))
    wait_for(lambda: part_count(out) > 0)
    os.kill(first.pid, signal.SIGSTOP)  # it holds the folder, however fast the machine is
    for _ in range(3):
        error = refusal_of(*SWEEP, "--out", out, "--resume")
        assert error.startswith(
            f"servobench: results folder {out} is being written by process {first.pid} of "
        )
    assert servobench(monkeypatch, "collect", str(out)) == 2
    os.killpg(first.pid, signal.SIGKILL)
    finish(first)
    assert f"was left by process {first.pid} of" in " ".join(
        output_of(*SWEEP, "--out", out, "--resume").split()
    )
    runs = results.load_runs(out)
    assert len(runs) == 400
    assert runs["run_id"].is_unique


def test_of_many_processes_that_resume_at_once_one_works_and_the_others_are_refused(tmp_path):
    out, chance = tmp_path / "out", random.Random(1)
    how = Execution(workers=1, block=4, resume=True, bounds=Bounds(isolate=False))
    batch = file_faults.campaign(False, ("constant",), 40)
    carry_out(
        batch, tmp_path / "alone", Execution(workers=1, block=4, bounds=Bounds(isolate=False))
    )
    out.mkdir()

    def resume(wait: float) -> None:
        time.sleep(wait)
        carry_out(batch, out, how)

    children = [in_child(partial(resume, chance.uniform(0.0, 0.6))) for _ in range(RESUMERS)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    assert set(codes) <= {0, 2}, codes
    assert 0 in codes
    tables = (judged(results.load_runs(folder)) for folder in (out, tmp_path / "alone"))
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert examine(ResultsFolder(out)).findings == []


def test_a_refused_process_waits_for_the_name_of_one_that_has_just_taken_the_lock(tmp_path):
    file = tmp_path / lock.LOCK
    with file.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        name = json.dumps(asdict(lock.Holder.this_process()))
        late = threading.Timer(0.2, file.write_text, (name,))
        late.start()
        with (
            pytest.raises(
                ConfigurationError, match=f"is being written by process {os.getpid()} of"
            ),
            lock.locked(tmp_path),
        ):
            pass
        late.join()


def test_a_lock_that_is_given_back_while_its_name_is_awaited_is_taken(tmp_path):
    file = tmp_path / lock.LOCK
    with file.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        end = threading.Timer(0.2, lambda: (file.unlink(), held.close()))
        end.start()
        with lock.locked(tmp_path):
            assert lock.Holder.read(file) is not None
        end.join()


def test_a_batch_that_another_process_began_before_the_lock_was_taken_is_resumed(
    tmp_path, monkeypatch
):
    out, how = (
        tmp_path / "out",
        Execution(workers=1, block=4, resume=True, bounds=Bounds(isolate=False)),
    )
    batch, locked = file_faults.campaign(False, ("constant",), 4), campaign.locked
    out.mkdir()

    def late(folder: Path, **options: bool):
        monkeypatch.setattr(campaign, "locked", locked)
        carry_out(batch, out, how)
        return locked(folder, **options)

    monkeypatch.setattr(campaign, "locked", late)
    carry_out(batch, out, how)
    assert len(results.load_runs(out)) == 4
    assert examine(ResultsFolder(out)).findings == []


@linux
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize("arguments", [
    ("--runs", "12", "--controllers", "constant", "--block", "4", "--every", "45"),
    ("--steps", "--runs", "4", "--every", "65"),
    ("--caches", "--every", "31"),
])  # fmt: skip
def test_a_batch_and_caches_broken_at_any_file_operation_can_be_resumed_bit_for_bit(
    tmp_path, arguments
):
    figures = file_faults.start(tmp_path, *arguments, timeout=550)
    assert figures["failed"] == [], figures
    assert figures["points"] >= 10


def test_a_folder_that_is_removed_while_it_is_written_is_one_line(tmp_path):
    out = tmp_path / "out"
    process = start(*SWEEP, "--out", str(out))
    wait_for(lambda: part_count(out) > 0)
    shutil.rmtree(out, ignore_errors=True)
    shutil.rmtree(out, ignore_errors=True)
    code, output = finish(process)
    assert code == 1, output
    assert "Traceback" not in output
    assert f"servobench: results folder {out} cannot be written: it was removed" in output


def test_what_verify_says_can_be_done(refusal_of, output_of, tmp_path, monkeypatch):
    out = tmp_path / "out"
    sweep = (
        "sweep",
        "--controllers",
        "constant",
        "--seeds",
        "3",
        "--workers",
        "1",
        "--set",
        "random.duration=1",
    )
    assert servobench(monkeypatch, *sweep, "--out", str(out)) == 0
    assert "2 files are as they were written, 3 runs" in output_of("verify", out)
    (out / results.RUNS).write_bytes((out / results.RUNS).read_bytes()[:-100])
    printed = output_of("verify", out, code=1)
    assert (
        "runs.parquet is cut off: repeat the command that made the folder with --resume" in printed
    )
    for command in ("statistics", "report", "collect"):
        assert f"{out / results.RUNS} is cut off; repeat" in refusal_of(command, out)
    assert servobench(monkeypatch, *sweep, "--out", str(out), "--resume") == 0
    assert servobench(monkeypatch, "verify", str(out)) == 0
    assert servobench(monkeypatch, "verify", str(tmp_path / "none")) == 2


def test_a_study_that_is_killed_while_it_writes_goes_on_without_waiting(tmp_path):
    path = tmp_path / "study.jsonl"
    Ledger(path, {"runs": 1}).add({"gain": 0.5}, [1.0])
    whole = path.read_bytes()
    line = b'{"settings": {"gain": 1.5}, "costs": [2.0]}\n'
    for end in range(len(line)):  # killed after each byte
        path.write_bytes(whole + line[:end])
        ledger = Ledger(path, {"runs": 1})
        assert (ledger.costs({"gain": 0.5}), ledger.costs({"gain": 1.5})) == ([1.0], None)
        ledger.add({"gain": 1.5}, [2.0])
        assert path.read_bytes() == whole + line
