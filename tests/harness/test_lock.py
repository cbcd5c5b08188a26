"""One process at a time in a results folder, and who it is."""

import errno
import fcntl
import json
import os
import platform
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import asdict, replace

import pytest

from kit.command import PACKAGE
from servobench.harness.batch.lock import LOCK, Holder, is_unused, locked
from servobench.plant.contract.faults import ConfigurationError

HOLD = """
import sys
from pathlib import Path
from servobench.harness.batch.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def other_process(folder):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], env={**os.environ, "PYTHONPATH": str(PACKAGE)},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_another_process_learns_who_holds_a_folder_and_a_killed_one_holds_it_no_more(tmp_path):
    out = tmp_path / "out"
    with other_process(out) as process:
        with (
            pytest.raises(ConfigurationError, match="is being written by process") as refused,
            locked(out),
        ):
            pass
        words = str(refused.value)
        assert f"process {process.pid} of " in words
        assert f" on {platform.node()}, since 20" in words
        assert "\n" not in words
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        with locked(out) as lock:
            assert lock.stale.pid == process.pid
            assert json.loads((out / LOCK).read_text())["pid"] == os.getpid()
    assert list(out.iterdir()) == []


def test_a_lock_that_is_given_back_leaves_nothing_and_can_be_taken_again(tmp_path):
    for _ in range(3):
        with locked(tmp_path / "out") as lock:
            assert lock.stale is None
            with (
                pytest.raises(ConfigurationError, match=f"process {os.getpid()} of"),
                locked(tmp_path / "out"),
            ):
                pass
        assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    "names", [[], [LOCK], [".manifest.json-12-3"], ["parts/"], ["parts/.part-0.parquet-12-3"]]
)
def test_a_folder_of_a_batch_that_was_killed_before_its_first_run_is_unused(tmp_path, names):
    for name in names:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.mkdir() if name.endswith("/") else path.touch()
    assert is_unused(tmp_path)
    (tmp_path / "parts").mkdir(exist_ok=True)
    (tmp_path / "parts" / "part-0.parquet").touch()
    assert not is_unused(tmp_path)


def test_a_file_where_the_folder_of_parts_would_be_is_somebody_s(tmp_path):
    (tmp_path / "parts").touch()
    assert not is_unused(tmp_path)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"pid": "x"}', '{"pid": 1}', "\x00" * 50])
def test_a_lock_that_says_nothing_useful_holds_where_the_system_does(tmp_path, content):
    (tmp_path / LOCK).write_text(content)
    with locked(tmp_path) as lock:
        assert lock.stale is None


def holder(**changes) -> Holder:
    return replace(Holder.this_process(), **changes)


def test_a_process_with_the_number_of_one_that_ended_is_another_one():
    assert not holder().gone
    assert holder(started="1").gone
    assert holder(pid=2**22 + 1).gone
    assert holder(pid=-1).gone
    assert holder(pid=0).gone
    assert not holder(pid=2**22 + 1, host="elsewhere").gone


def test_a_lock_left_by_another_machine_is_free_as_system_locks_reach_all_machines(tmp_path):
    (tmp_path / LOCK).write_text(json.dumps(asdict(holder(host="elsewhere", pid=7))))
    with locked(tmp_path) as lock:
        assert lock.stale.host == "elsewhere"


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL])
def test_a_file_system_without_locks_is_refused_with_the_remedy(number, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    line = rf"out lies on a file system without locks \({os.strerror(number)}\), .*; name a local folder"
    with pytest.raises(ConfigurationError, match=line):
        locked(tmp_path / "out").__enter__()


def test_a_folder_that_was_removed_is_noticed(tmp_path):
    out = tmp_path / "out"
    with locked(out) as lock:
        lock.check()
        (out / LOCK).unlink()
        out.rmdir()
        with pytest.raises(FileNotFoundError):
            lock.check()
        with locked(out), pytest.raises(FileNotFoundError, match="removed by another process"):
            lock.check()
    assert out.is_dir()


def test_a_lock_that_is_a_second_name_of_a_file_elsewhere_changes_no_such_file(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "mine").write_text("precious")
    os.link(tmp_path / "mine", tmp_path / "out" / LOCK)
    with locked(tmp_path / "out") as taken:
        taken.check()
    assert (tmp_path / "mine").read_text() == "precious"
