"""The command line as a user meets it, within the process of the test and in processes of its own."""

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import psutil
import pytest

from servobench.harness.batch import results
from servobench.harness.cli.main import main

PACKAGE = Path(__file__).parents[2] / ".package"


def servobench(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run `servobench` with arguments and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["servobench", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0)


def start(*arguments: str, path: Path = PACKAGE, **environment: str) -> subprocess.Popen[str]:
    """Start `servobench` with arguments in a process group of its own; `path` is searched for packages, too."""
    return subprocess.Popen(
        [sys.executable, "-m", "servobench", *arguments], text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": f"{PACKAGE}{os.pathsep}{path}", **environment},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def carried_out(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Return how a command ended, with what it wrote to standard output and error."""
    return subprocess.run(
        [*map(str, words)], capture_output=True, text=True, check=False, **options
    )


def python(
    *words: object, path: Path = PACKAGE, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Return how Python ended with arguments in the folder `path`, which is searched for packages, too."""
    own = {**os.environ, "PYTHONPATH": f"{PACKAGE}{os.pathsep}{path}", **environment}
    return carried_out(sys.executable, *words, cwd=path, env=own, timeout=900)


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Wait for a process and return its exit code and what it wrote to standard output and error."""
    output, errors = process.communicate(timeout=300)
    return process.returncode, output + errors


def left_behind(mark: str, value: str) -> list[str]:
    """Return the command lines of the processes whose environment has a value for a mark."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(mark) == value and process.status() != psutil.STATUS_ZOMBIE:
                found.append(" ".join(process.cmdline()))
        except psutil.Error:
            continue
    return found


def wait_for(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def part_count(folder: Path) -> int:
    """Return how many parts a batch has finished so far."""
    return len(list((folder / results.PARTS).glob(f"[0-9]*.{results.RUNS}")))


@contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """Let each write beyond a size [bytes] of a file fail, as beyond a quota or on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with (
        pytest.MonkeyPatch.context() as patch
    ):  # Python before 3.13.1 keeps a compiled module that was cut short
        patch.setattr(sys, "dont_write_bytecode", True)
        patch.setenv("PYTHONDONTWRITEBYTECODE", "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


def judged(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table without the wall-clock times, which differ between two runs of the same seed."""
    return table[
        [name for name in table.columns if not name.startswith(("controller_time", "plant_time"))]
    ]
