"""Breaks every file operation of a batch, or of caches, one after the other and in every way, and goes on each time.

To be run by `start`, which builds the library of `file_faults.c` and preloads it; the command does so for each way, on
all processors. Each point is a child of a process that has all modules in memory, so that it takes a fraction of a
second. The child is killed, or its operation fails; what was finished must still be readable; a second child resumes,
and its tables must be those of an undisturbed batch, wall-clock columns aside, bit for bit.

`python -m night.file_faults`, with `tests` and `benchmarks` on the path, breaks all operations, as `make nightly` does.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from kit.command import PACKAGE, carried_out, judged
from kit.foreign_fmu import packed
from kit.toy import TRAINING, plant_spec
from measuring import options
from night.children import answered, ended
from servobench.harness.batch import results
from servobench.harness.batch.campaign import Campaign, Execution, carry_out
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.lock import is_unused
from servobench.harness.batch.plan import Batch, SweepPlan
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.batch.tables import UnwritableFolder
from servobench.harness.config.settings import Settings
from servobench.harness.run import knowledge as network_cache
from servobench.harness.run.knowledge import NETWORKS, NetworkSource
from servobench.plant.contract import cache
from servobench.plant.fmu.archive import extract_fmu

SOURCE = Path(__file__).with_name("file_faults.c")
MODES = {"KILL": 1, "TORN": 2, "POWER": 3, "EIO": 4, "ENOSPC": 5}
SENSING = {"drop_probability": 0.05}
SETTINGS = {
    "random": {"duration": 0.2},
    "run": {"lost_after": 0.05},
    "kinematic": {"sensing": SENSING},
}


def build(folder: Path) -> Path:
    """Compile the library and return its path."""
    folder.mkdir(exist_ok=True)
    library = folder / "file_faults.so"
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
        "PYTHONPATH": os.pathsep.join(
            str(PACKAGE.parent / name) for name in (".package", "tests", "benchmarks")
        ),
    }
    done = carried_out(
        sys.executable, "-m", "night.file_faults", *arguments, env=environment, timeout=timeout
    )
    assert done.returncode == 0, done.stdout + done.stderr
    figures = dict(json.loads(done.stdout.splitlines()[-1]))
    return figures | ({"why": done.stderr[-3000:]} if figures["failed"] else {})


def start_each(modes: list[str], arguments: list[str]) -> dict[str, object]:
    """Break in each way in a process of its own, as many at a time as there are processors; return all figures."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(
            pool.map(lambda mode: start(Path(folder, mode), *arguments, "--modes", mode), modes)
        )
    added = {
        name: sum((each[name] for each in found[1:]), found[0][name])
        for name in ("points", "failed")
    }
    why = "\n".join(str(each["why"]) for each in found if each["failed"])
    minutes = round((time.monotonic() - begin) / 60.0, 2)
    return {**found[0], **added, "minutes": minutes, **({"why": why} if why else {})}


def campaign(steps: bool, controllers: tuple[str, ...], runs: int) -> Campaign:
    """Return a batch of short runs, some of which lose the feature."""
    batch = Batch(
        ("kinematic",), controllers, ("random",), ("moderate",), range(runs // len(controllers))
    )
    return Campaign(SweepPlan(batch).cells(), Settings(SETTINGS), steps)


@dataclass(frozen=True)
class Batches:
    """A batch into a results folder, which can be resumed after it was broken."""

    batch: Campaign
    block: int = 16  # runs that advance together at most

    def carry_out(self, point: Path, *, resume: bool = False) -> None:
        """Do it, or what is left of it."""
        bounds = Bounds(isolate=False)
        carry_out(
            self.batch, point, Execution(workers=1, block=self.block, resume=resume, bounds=bounds)
        )

    def outcome(self, point: Path) -> list[object]:
        """Return the tables; raise AssertionError where the folder is not as it should be."""
        found = examine(ResultsFolder(point))
        assert not found.findings, found.findings
        left = {path.name for path in point.iterdir()} - {
            results.STEPS,
            results.RUNS,
            results.FAILURES,
            NETWORKS,
        }
        assert left == {results.MANIFEST, "SHA256SUMS"}, left
        tables = [
            results.load_runs(point),
            *([results.load_steps(point)] if self.batch.steps else []),
        ]
        return [
            (list(table.columns), pd.util.hash_pandas_object(table).tolist())
            for table in map(judged, tables)
        ]

    def look(self, point: Path) -> None:
        """Read what an interrupted attempt has left."""
        if not is_unused(point) and ResultsFolder(point).part_indices():
            results.load_runs(point)

    def refusal(self, error: Exception) -> str:
        """Return the line that a user gets; empty for an error that none should end with."""
        line = str(error.strerror if isinstance(error, UnwritableFolder) else error)
        return line if line.startswith("results folder") else ""


class Caches:
    """As `Batches`: an FMU and networks, each into its cache; whoever comes next has both whole."""

    def carry_out(self, point: Path, *, resume: bool = False) -> None:
        os.environ["XDG_CACHE_HOME"] = str(point)
        cache._verified.clear()
        network_cache._KEPT.clear()
        archive_path = point.parent / "foreign.fmu"
        if not archive_path.exists():
            archive_path.write_bytes(packed(2, zipfile.ZIP_DEFLATED))
        extract_fmu(archive_path)
        NetworkSource(lambda q: np.broadcast_to(np.eye(2), (len(q), 2, 2)), plant_spec(2, 2))(
            TRAINING
        )

    def outcome(self, point: Path) -> dict[str, bytes]:
        entries = [
            entry
            for kind in ("extracted", NETWORKS)
            for entry in cache.cache_folder(kind).iterdir()
        ]
        whole = [
            entry for entry in entries if not entry.name.startswith((".lock", cache.UNFINISHED))
        ]
        assert len(whole) == 2, entries
        assert all(map(cache.is_whole, whole))
        files = [
            path for entry in whole for path in (entry / cache.FILES).rglob("*") if path.is_file()
        ]
        return {
            str(path.relative_to(point)): path.read_bytes()
            for path in files
            if path.suffix != ".npz"
        }

    def look(self, point: Path) -> None:
        """Nothing but the next use reads a cache."""

    def refusal(self, error: Exception) -> str:
        line = str(error)
        return line if line.startswith(("cache folder", "fmu file")) else ""


class Breaker:
    """Something whose operations on files are broken.

    Attributes:
        points: number of operations that were broken so far.
        failed: what went wrong, a line each.
    """

    def __init__(self, folder: Path, subject: Batches | Caches) -> None:
        """Carry it out once, undisturbed."""
        self._point, self._subject = folder / "point", subject
        self._library = ctypes.CDLL(os.environ["BREAK_LIBRARY"])
        self.points, self.failed = 0, list[str]()
        self._clear()
        subject.carry_out(self._point)
        self._wanted = subject.outcome(self._point)

    def operations(self) -> int:
        """Return how many operations an undisturbed attempt has."""
        self._clear()

        def count() -> int:
            self._library.break_at(-1, MODES["EIO"])
            self._subject.carry_out(self._point)
            self._library.broken_count.restype = ctypes.c_long
            return self._library.broken_count()

        found, code = answered(count)
        assert code == 0
        return found

    def break_at(self, number: int, mode: str) -> None:
        """Break one operation, and go on."""
        self._clear()
        where = f"operation {number}, {mode}"
        status = ended(lambda: self._broken(number, mode))
        if status not in (0, -signal.SIGKILL):
            self.failed.append(f"{where}: the process ended with {status}")
        elif ended(self._resumed) != 0:
            self.failed.append(f"{where}: it could not be resumed")
        self.points += 1

    def _broken(self, number: int, mode: str) -> None:
        self._library.break_at(ctypes.c_long(number), MODES[mode])
        try:
            self._subject.carry_out(self._point)
        except (OSError, ValueError) as error:
            line = self._subject.refusal(error)
            if not line or "\n" in line:
                raise

    def _resumed(self) -> None:
        self._subject.look(self._point)
        self._subject.carry_out(self._point, resume=True)
        assert self._subject.outcome(self._point) == self._wanted

    def _clear(self) -> None:
        shutil.rmtree(self._point, ignore_errors=True)
        self._point.mkdir()


def main() -> None:
    """Break a batch as the arguments say, and print figures as JSON; exit code 1 if a point failed."""
    chosen = options(
        __doc__,
        runs=50,
        controllers="constant,broyden",
        block=(16, "runs that advance together at most"),
        caches={
            "action": "store_true",
            "help": "break caches of an FMU and of networks, and no batch",
        },
        steps={"action": "store_true", "help": "keep the table of steps, as compare does"},
        every=(1, "break each so many-th operation only"),
        modes=",".join(MODES),
    )
    if "BREAK_LIBRARY" not in os.environ:
        figures = start_each(chosen.modes.split(","), sys.argv[1:])
        print(json.dumps(figures, indent=1))
        sys.exit(bool(figures["failed"]))
    folder = Path(os.environ["BREAK_LIBRARY"]).parent
    batch = Batches(
        campaign(chosen.steps, tuple(chosen.controllers.split(",")), chosen.runs), chosen.block
    )
    breaker = Breaker(folder, Caches() if chosen.caches else batch)
    total = breaker.operations()
    for mode in chosen.modes.split(","):
        for number in range(
            1 + 7 * list(MODES).index(mode) % chosen.every, total + 1, chosen.every
        ):
            breaker.break_at(number, mode)
    print(json.dumps({"operations": total, "points": breaker.points, "failed": breaker.failed}))


if __name__ == "__main__":
    main()
