"""Breaks every file operation of a batch, one after the other and in every way, and resumes each time.

To be run by `start`, which builds the library of `break_files.c` and preloads it. Each point is a child of this
process, which has all modules in memory, so that it takes a fraction of a second. The child is killed, or its operation
fails; what was finished must still be readable; a second child resumes, and its tables must be those of an undisturbed
batch, wall-clock columns aside, bit for bit.

`python -m kit.breaking`, with the tests and the package on the path, breaks all operations: a part of `make nightly`.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from kit.command import PACKAGE, judged
from servobench.harness.batch import results
from servobench.harness.batch.campaign import Campaign, Execution, carry_out
from servobench.harness.batch.checksums import UnwritableFolder
from servobench.harness.batch.compare import Batch
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.lock import is_unused
from servobench.harness.batch.sweep import SweepPlan
from servobench.harness.batch.workers import Bounds
from servobench.harness.config.settings import ConfigurationError, Settings

SOURCE = Path(__file__).with_name("break_files.c")
MODES = {"KILL": 1, "TORN": 2, "POWER": 3, "EIO": 4, "ENOSPC": 5}
SETTINGS = {
    "random": {"duration": 0.2},
    "run": {"lost_after": 0.05},
    "kinematic": {"sensing": {"drop_probability": 0.05}},
}
REFUSAL = "results folder"  # how a line begins that says what cannot be written


def build(folder: Path) -> Path:
    """Compile the library and return its path."""
    library = folder / "break_files.so"
    command = ["gcc", "-O1", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl"]
    subprocess.run(command, check=True, timeout=60)
    return library


def start(folder: Path, *arguments: str, timeout: float | None = None) -> dict[str, object]:
    """Break a batch in a process of its own and return its figures."""
    library = build(folder)
    environment = {
        **os.environ,
        "LD_PRELOAD": str(library),
        "BREAK_LIBRARY": str(library),
        "BREAK_BELOW": str(folder / "point"),
        "PYTHONPATH": os.pathsep.join([str(PACKAGE), str(Path(__file__).parents[1])]),
    }
    command = [sys.executable, "-m", "kit.breaking", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = dict(json.loads(done.stdout.splitlines()[-1]))
    return figures | ({"why": done.stderr[-3000:]} if figures["failed"] else {})


def campaign(steps: bool, controllers: tuple[str, ...], runs: int) -> Campaign:
    """Return a batch of short runs, some of which lose the feature."""
    batch = Batch(("kinematic",), controllers, ("random",), ("moderate",), range(runs // len(controllers)))
    return Campaign(SweepPlan(batch).cells(), Settings(SETTINGS), steps)


class Breaker:
    """A batch whose operations are broken.

    Attributes:
        points: number of operations that were broken so far.
        failed: what went wrong, a line each.
    """

    def __init__(self, folder: Path, batch: Campaign) -> None:
        """Carry the batch out once, undisturbed."""
        self._folder, self._batch = folder, batch
        self._library = ctypes.CDLL(os.environ["BREAK_LIBRARY"])
        self.points, self.failed = 0, list[str]()
        self._clear()
        self._carry_out()
        self._wanted = self._tables()

    @property
    def _point(self) -> Path:
        return self._folder / "point"

    def operations(self) -> int:
        """Return how many operations an undisturbed batch has."""
        self._clear()
        read, write = os.pipe()

        def count() -> None:
            self._library.break_at(-1, MODES["EIO"])
            self._carry_out()
            self._library.broken_count.restype = ctypes.c_long
            os.write(write, str(self._library.broken_count()).encode())

        assert self._in_child(count) == 0
        os.close(write)
        with os.fdopen(read) as pipe:
            return int(pipe.read())

    def break_at(self, number: int, mode: str) -> None:
        """Break one operation, and resume."""
        self._clear()
        where = f"operation {number}, {mode}"
        status = self._in_child(lambda: self._broken(number, mode))
        if status not in (0, -signal.SIGKILL):
            self.failed.append(f"{where}: the process ended with {status}")
        elif self._in_child(self._resumed) != 0:
            self.failed.append(f"{where}: it could not be resumed")
        self.points += 1

    def _broken(self, number: int, mode: str) -> None:
        self._library.break_at(ctypes.c_long(number), MODES[mode])
        try:
            self._carry_out()
        except (UnwritableFolder, ConfigurationError) as error:
            line = str(error.strerror if isinstance(error, UnwritableFolder) else error)
            assert "\n" not in line
            assert line.startswith(REFUSAL), line

    def _resumed(self) -> None:
        if not is_unused(self._point) and results.part_indices(self._point):
            results.load_runs(self._point)  # what is finished can be read
        self._carry_out(resume=True)
        for table, wanted in zip(self._tables(), self._wanted, strict=True):
            pd.testing.assert_frame_equal(table, wanted, check_exact=True)
        found = examine(self._point)
        assert not found.findings, found.findings
        left = {path.name for path in self._point.iterdir()} - {results.STEPS, results.RUNS, results.FAILURES}
        assert left == {results.MANIFEST, "SHA256SUMS"}, left

    def _carry_out(self, *, resume: bool = False) -> None:
        how = Execution(workers=1, block=16, resume=resume, bounds=Bounds(isolate=False))
        carry_out(self._batch, self._point, how)

    def _tables(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        steps = results.load_steps(self._point) if self._batch.steps else pd.DataFrame()
        return judged(results.load_runs(self._point)), judged(steps)

    def _clear(self) -> None:
        shutil.rmtree(self._point, ignore_errors=True)
        self._point.mkdir()

    @staticmethod
    def _in_child(work: Callable[[], None]) -> int:
        """Do something in a child of this process and return its exit code, or the negative number of a signal."""
        child = os.fork()
        if child:
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        try:
            work()
        except BaseException:  # noqa: BLE001 - whatever it is, the parent must learn it
            traceback.print_exc()
            os._exit(3)
        os._exit(0)


def main() -> None:
    """Break a batch as the arguments say, and print figures as JSON; exit code 1 if a point failed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--controllers", default="constant,broyden")
    parser.add_argument("--steps", action="store_true", help="keep the table of steps, as compare does")
    parser.add_argument("--every", type=int, default=1, help="break each so many-th operation only")
    parser.add_argument("--modes", default=",".join(MODES))
    chosen = parser.parse_args()
    if "BREAK_LIBRARY" not in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            figures = start(Path(folder), *sys.argv[1:])
        sys.stdout.write(json.dumps(figures, indent=1) + "\n")
        sys.exit(bool(figures["failed"]))
    begin = time.monotonic()
    folder = Path(os.environ["BREAK_LIBRARY"]).parent
    breaker = Breaker(folder, campaign(chosen.steps, tuple(chosen.controllers.split(",")), chosen.runs))
    total = breaker.operations()
    for place, mode in enumerate(chosen.modes.split(",")):
        for number in range(1 + 7 * place % chosen.every, total + 1, chosen.every):
            breaker.break_at(number, mode)
    minutes = round((time.monotonic() - begin) / 60.0, 2)
    figures = {"operations": total, "points": breaker.points, "failed": breaker.failed, "minutes": minutes}
    sys.stdout.write(json.dumps(figures) + "\n")


if __name__ == "__main__":
    main()
