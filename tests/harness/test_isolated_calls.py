"""Isolated processes: calls with their answers, guards that do not start or are ended meanwhile or are stopped."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from kit.command import left_behind, python, start, wait_for
from kit.forked import say_modules
from kit.nightly import some
from servobench.harness.batch import isolation, shares
from servobench.harness.batch.blocks import open_workers
from servobench.harness.batch.isolation import Pool, Task
from servobench.harness.batch.processes import Bounds, Limits
from servobench.harness.batch.shares import in_shares
from servobench.plant.contract.faults import ConfigurationError


@contextmanager
def importing(text, name, folder, monkeypatch):
    """Yield a pool of one worker, whose guard first imports a module with this text and name."""
    (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    workers = Pool(1, Limits(), (name,))
    try:
        yield workers
    finally:
        workers.stop()


@pytest.mark.slow
def test_no_worker_that_starts_too_late_is_left_for_this_process_to_wait_for(tmp_path, monkeypatch):
    monkeypatch.setattr(isolation, "GUARD_START", 0.5)
    before = set(multiprocessing.active_children())
    with importing(
        "import time\n\ntime.sleep(60.0)\n", "slow_import", tmp_path, monkeypatch
    ) as workers:
        for _ in range(2):
            with pytest.raises(
                ConfigurationError, match=r"^a worker process has not started within 0\.5 s$"
            ):
                workers.submit(Task(print, b"")).result(60.0)
    assert set(multiprocessing.active_children()) == before


def test_a_daemonic_process_is_told_that_it_can_start_no_workers(monkeypatch):
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)
    workers = Pool(1, Limits(), ())
    with pytest.raises(
        ConfigurationError,
        match=r"^a daemonic process, such as one of multiprocessing\.Pool, can start",
    ):
        workers.submit(Task(print, b"")).result(60.0)
    workers.stop()


ONCE = """
import os, pathlib, signal

first = pathlib.Path(__file__).with_name("first")
if not first.exists() or {always}:
    first.touch()
    os.kill(os.getpid(), signal.{name})
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", some(("SIGKILL", "SIGTERM", "SIGHUP", "SIGSTOP"), "SIGTERM", "SIGSTOP")
)
def test_a_guard_that_is_ended_or_stopped_while_it_starts_is_started_once_more(
    name, tmp_path, monkeypatch
):
    with importing(
        ONCE.format(name=name, always=False), "ends_once", tmp_path, monkeypatch
    ) as workers:
        assert workers.submit(Task(harm, pickle.dumps("return"))).result(300.0).items == [
            ["begins", "return"]
        ]


@pytest.mark.slow
def test_of_a_guard_that_is_ended_whenever_it_starts_the_signal_is_named(tmp_path, monkeypatch):
    with (
        importing(
            ONCE.format(name="SIGKILL", always=True), "ends_always", tmp_path, monkeypatch
        ) as workers,
        pytest.raises(
            ConfigurationError, match="^a worker process was ended while it started: SIGKILL$"
        ),
    ):
        workers.submit(Task(harm, pickle.dumps("return"))).result(300.0)


UNTOUCHED = """
import os, pickle, signal
from servobench.harness.batch.processes import Limits
from servobench.harness.batch.isolation import Pool, Task

def blocked(_, tell):
    tell([int(line.split()[1], 16) for line in open(f"/proc/{os.getppid()}/status") if line.startswith("SigBlk")])

if __name__ == "__main__":
    pool = Pool(1, Limits(), ())
    ((mask,),) = pool.submit(Task(blocked, pickle.dumps(None))).result(300.0).items
    pool.stop()
    print(bool(mask & 1 << signal.SIGINT - 1))
"""


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux", reason="the signals that a process blocks are read from /proc"
)
def test_ctrl_c_does_not_reach_the_first_guard_while_it_starts(tmp_path):
    (tmp_path / "starts.py").write_text(UNTOUCHED)
    done = python("starts.py", path=tmp_path)
    assert done.stdout == "True\n", done.stderr


def has_ended(process):
    return not psutil.pid_exists(process) or psutil.Process(process).status() == "zombie"


KILLED = """
import os, pickle, signal, subprocess, sys, time
from servobench.harness.batch import processes
from servobench.harness.batch.processes import Limits
from servobench.harness.batch.isolation import Pool, Task

def hold(seconds, tell):
    tell(None)
    if {stopper!r}:
        subprocess.Popen([sys.executable, "-S", "-c", {stopper!r}, str(os.getppid())], start_new_session=True)
    time.sleep(seconds)

if __name__ == "__main__":
    starts = {starts}
    pool = Pool(1, Limits(time=600.0), ["imported"] * starts)
    pool.submit(Task(hold, pickle.dumps(600)))
    wanted = 4 - starts + bool({stopper!r})  # resource tracker, guard with the process over it, runner and its child
    while len(below := processes.descendants(os.getpid())) < wanted:
        time.sleep(0.05)
    while wanted != 4 and not os.path.exists("begun"):
        time.sleep(0.05)
    print(*below, flush=True)
    for each in below:
        if wanted == 4:
            os.kill(each, signal.SIGSTOP)
    os.kill(os.getpid(), signal.SIGKILL)
"""
SLOW = "import time\nopen('begun', 'w').close()\ntime.sleep(600.0)\n"


STOPPER = """
import os, signal, sys, time
while True:
    os.kill(int(sys.argv[1]), signal.SIGSTOP)
    open("begun", "w").close()
    time.sleep(0.001)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("starts", "stopper"), [(False, ""), (True, ""), (False, STOPPER)])
def test_what_is_stopped_or_only_starting_ends_with_the_process_that_started_it(
    starts, stopper, tmp_path
):
    (tmp_path / "killed.py").write_text(KILLED.format(starts=starts, stopper=stopper))
    (tmp_path / "imported.py").write_text(SLOW)
    done = python("killed.py", path=tmp_path)
    assert done.returncode == -signal.SIGKILL, done.stderr
    wait_for(lambda: all(map(has_ended, map(int, done.stdout.split()))), 5.0)


STUCK = """
import pathlib, sys, time

class Stuck:
    def find_spec(self, name, path=None, target=None):
        if name in ("numpy", "typer") and "--multiprocessing-fork" in sys.orig_argv:
            pathlib.Path(__file__).with_name("begun").touch()
            time.sleep(600.0)

sys.meta_path.insert(0, Stuck())
"""


@pytest.mark.slow
def test_a_guard_that_has_not_yet_imported_anything_large_ends_with_a_killed_command(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(STUCK)
    words = ("compare", "--plants", "kinematic", "--controllers", "constant", "--workers", "2")
    with start(
        *words, "--out", str(tmp_path / "out"), path=tmp_path, STUCK=str(tmp_path)
    ) as process:
        wait_for((tmp_path / "begun").exists)
        process.kill()
    wait_for(lambda: not left_behind("STUCK", str(tmp_path)), 5.0)


def wait_for_file(path: Path, tell) -> None:
    tell(os.getpid())
    while not path.exists():
        time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGSTOP", "SIGINT"])
def test_a_runner_that_somebody_stops_or_interrupts_goes_on(name, tmp_path):
    def disturb(runner: object) -> None:
        os.kill(runner, signal.Signals[name])
        (tmp_path / "file").touch()

    assert isolation.call(wait_for_file, tmp_path / "file", Limits(time=30.0), disturb) is None


def harm(how: str, tell) -> None:
    tell(["begins", how])
    if how in ("SIGSTOP", "SIGTERM"):
        time.sleep(1.0)  # the guard passes the answer on first
        os.kill(os.getppid(), signal.Signals[how])
    while how not in ("return", "exit"):
        time.sleep(0.1)
    if how == "exit":
        os._exit(3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "end"),
    [
        ("return", None),
        ("exit", ("crashed", "the run killed the process that carried it out: exit code 3")),
        ("hang", ("timed_out", "the run took longer than 3 s")),
        ("SIGSTOP", ("timed_out", "the run took longer than 3 s")),
        ("SIGTERM", ("crashed", "the run killed the process that carried it out")),
    ],
)
def test_a_call_returns_how_its_function_ended(how, end):
    told: list[object] = []
    beyond_count = 1e20  # [bytes], more than the system can limit
    ended = isolation.call(harm, how, Limits(3.0, beyond_count, addresses=True), told.append)
    assert told == [["begins", how]]
    assert (ended and (ended.status, ended.reason)) == end
    assert multiprocessing.active_children() == []


def guard_that_ends_as_it_reads(link) -> None:
    read = link._recv

    def read_too_late(*arguments: object) -> object:
        os.kill(os.getpid(), signal.SIGTERM)
        return read(*arguments)

    link._recv = read_too_late
    isolation.keep_guard(link, Limits(), (), None)


def test_a_guard_that_is_ended_just_before_it_reads_ends_in_silence(capfd):
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    guard = context.Process(target=guard_that_ends_as_it_reads, args=(theirs,))
    guard.start()
    theirs.close()
    assert ours.recv_bytes() == isolation.ALIVE
    guard.join(30.0)
    assert guard.exitcode == 0
    assert "Traceback" not in capfd.readouterr().err
    with pytest.raises(EOFError):
        ours.recv_bytes()


def stop_for_ever(_, tell) -> None:
    tell(subprocess.Popen(["sleep", "60"], start_new_session=True).pid)
    time.sleep(0.5)  # the guard passes the answer on first
    while True:
        os.kill(os.getppid(), signal.SIGSTOP)


@pytest.mark.slow
def test_of_a_guard_that_is_stopped_again_and_again_nothing_stays(monkeypatch):
    monkeypatch.setattr(isolation, "START_TIME", 1.0)
    monkeypatch.setattr(isolation, "GRACE", 1.0)
    told: list[int] = []
    ended = isolation.call(stop_for_ever, None, Limits(time=1.0), told.append)
    assert ended is not None
    assert ended.status == "timed_out"
    wait_for(lambda: has_ended(told[0]), 5.0)


@pytest.mark.parametrize(
    ("name", "wanted"), [("constant", ["numpy.ma"]), ("fmu:pilot.fmu", ["pandas", "numpy.ma"])]
)
def test_pandas_is_imported_once_and_beyond_the_memory_limit_where_foreign_code_runs(name, wanted):
    with open_workers(2, bounds=Bounds(run_memory=150e6), controllers=[name]) as workers:
        assert workers.submit(Task(say_modules, pickle.dumps(None))).result().items == [wanted]


def squared(argument, share):
    """Yield squares by copies of this process, of which those of `ending` end and the others refuse 7."""
    count, own, ending = argument
    for number, piece in share.of(range(count)):
        if os.getpid() != own and piece in ending:
            os._exit(3)
        if piece == 7:
            raise ConfigurationError("7 is refused")
        yield number, piece**2, os.getpid()


@pytest.mark.parametrize(
    ("count", "processors", "ending"),
    [(5, 3, ()), (2, 3, ()), (0, 2, ()), (5, 2, (4,)), (5, 1, (0,))],
)
def test_a_work_in_shares_has_the_answers_of_one_process_in_its_order(
    count, processors, ending, monkeypatch
):
    monkeypatch.setattr(shares, "available_processors", lambda: processors)
    answers = in_shares(squared, (count, os.getpid(), ending))
    assert [tuple(each[:2]) for each in answers] == [(i, i**2) for i in range(count)]
    alone = processors == 1 or bool(ending)
    assert {each[2] for each in answers} & {os.getpid()} == ({os.getpid()} if alone else set())
    assert len({each[2] for each in answers}) == (1 if alone else min(count, processors))
    assert not multiprocessing.active_children()


def test_an_error_of_a_share_is_raised_in_this_process(monkeypatch):
    monkeypatch.setattr(shares, "available_processors", lambda: 2)
    with pytest.raises(ConfigurationError, match="^7 is refused$"):
        in_shares(squared, (9, os.getpid(), ()))


def test_a_daemonic_process_does_a_work_in_shares_alone(monkeypatch):
    monkeypatch.setattr(shares, "available_processors", lambda: 2)
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)
    assert [each[2] for each in in_shares(squared, (3, os.getpid(), ()))] == [os.getpid()] * 3


def test_where_no_process_can_be_started_this_one_does_a_work_in_shares(monkeypatch):
    def refused() -> int:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(shares, "available_processors", lambda: 2)
    monkeypatch.setattr(os, "fork", refused)
    assert [each[2] for each in in_shares(squared, (3, os.getpid(), ()))] == [os.getpid()] * 3
