"""Signals at random instants to the processes of a sweep, which goes on with --resume; its tables stay bit-equal.

    PYTHONPATH=tests:benchmarks python -m night.kills --kills 100

A victim is the command, a process right below it (a guard or the tracker of resources) or one below these (a runner).
The command goes on after a signal to the others; where it ends, or is stopped and then killed, everything that it
started must be gone 5 s later. A table has six signals on its way; each second batch is of this package's code only.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pandas as pd
import psutil

from kit.command import judged, left_behind
from measuring import options
from night import hostile_controllers
from servobench.harness.batch.processes import descendants

VICTIMS: Final = ("command", "below it", "runner")
SIGNALS: Final = ("KILL", "TERM", "INT", "HUP", "QUIT", "STOP")
MARK: Final = "SERVOBENCH_KILLS"  # an environment variable that everything started here inherits
SOON: Final = 5.0  # [s] until nothing is left of a command that has ended
LONG: Final = 15.0  # [s] until what is left then is ended here
PATIENCE: Final = 600.0  # [s] for a call to end by itself
LATEST: Final = (
    4.0  # [s] from the start of a victim, or the last signal, to the next one at the latest
)
BATCHES: Final = (f"{hostile_controllers.__file__}:Quiet,constant", "constant,calibrated")


@dataclass
class Outcome:
    """What came of the signals."""

    signals: Counter[tuple[str, str]] = field(default_factory=Counter)  # by victim and signal
    lived: dict[tuple[str, str], float] = field(
        default_factory=dict
    )  # [s] after the end of the command, the longest
    tables: int = 0
    faults: list[str] = field(default_factory=list)


class Sweep:
    """A sweep that is ended by force and goes on."""

    def __init__(
        self, folder: Path, controllers: str, seeds: str, *further: str, **environment: str
    ) -> None:
        self.folder = folder
        self._call = [
            "sweep",
            "--controllers",
            controllers,
            "--seeds",
            seeds,
            *further,
            "--out",
            str(folder),
        ]
        self._known = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(sys.path),
            MARK: str(folder),
            **environment,
        }

    def start(self) -> subprocess.Popen[bytes]:
        """Start it, or go on."""
        call = [
            sys.executable,
            "-m",
            "servobench",
            *self._call,
            *["--resume"] * self.folder.exists(),
        ]
        with self.folder.with_suffix(".txt").open("wb") as said:
            return subprocess.Popen(call, env=self._known, stdout=subprocess.DEVNULL, stderr=said)

    def said(self) -> str:
        """Return what the last call wrote to standard error."""
        return self.folder.with_suffix(".txt").read_text(errors="replace")

    def outlived(self, most: float) -> tuple[float, list[str]]:
        """Wait until nothing is left of an ended call, so long at most; return how long it took [s] and the rest."""
        ended = time.monotonic()
        while (left := left_behind(MARK, str(self.folder))) and time.monotonic() - ended < most:
            time.sleep(0.02)
        return time.monotonic() - ended, left

    def table(self) -> pd.DataFrame:
        """Return the table of runs without the times of the clock."""
        return judged(pd.read_parquet(self.folder / "runs.parquet"))

    def complain(self, code: int) -> str:
        """Return the fault of a call that has ended: a trace, or an end that it should not have."""
        said = self.said()
        told = (
            code in (0, 1, 129, 130, 143, -1, -2, -3, -9, -15)
            or "was ended while it started: SIG" in said
        )
        return "" if told and "Traceback" not in said else said[-1500:]


def signalled(
    sweep: Sweep, process: subprocess.Popen[bytes], source: random.Random, found: Outcome
) -> bool:
    """Send a signal at a random instant; return whether there was one before the sweep was over."""
    kind, pause = source.choice(VICTIMS), source.uniform(0.0, LATEST)
    while process.poll() is None and not _victims(process.pid)[kind]:
        time.sleep(0.01)
    time.sleep(pause)
    if process.poll() is not None:
        return False
    victims = _victims(process.pid)
    kind = kind if victims[kind] else "command"
    name = source.choice(SIGNALS)
    os.kill(source.choice(victims[kind]), getattr(signal, f"SIG{name}"))
    found.signals[kind, name] += 1
    if kind == "command":
        if name == "STOP":
            time.sleep(source.uniform(0.0, 3.0))
            process.kill()
        end(sweep, process, (kind, name), found)
    return True


def _victims(command: int) -> dict[str, list[int]]:
    near = []
    with suppress(psutil.NoSuchProcess):
        near = [each.pid for each in psutil.Process(command).children()]
    below = [each for each in descendants(command) if each not in near]
    return dict(zip(VICTIMS, ([command], near, below), strict=True))


def end(
    sweep: Sweep, process: subprocess.Popen[bytes], last: tuple[str, str], found: Outcome
) -> int | None:
    """Wait for a call to end, and for everything that it started; note the faults."""
    try:
        code = process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        found.faults.append(f"{last}: the command still runs after {PATIENCE:g} s")
        process.kill()
        code = process.wait()
    lived, left = sweep.outlived(LONG)
    found.lived[last] = max(found.lived.get(last, 0.0), lived)
    if lived > SOON:
        found.faults.append(f"{last}: {lived:.1f} s after the end there was {left}")
    if complaint := sweep.complain(code):
        found.faults.append(f"{last}: exit code {code}: {complaint}")
    return code


def main() -> None:
    """Carry everything out and print a table; exit code 1 if something was amiss."""
    given = options(__doc__, kills=100, runs=600, seed=101)
    how = (f"0:{given.runs // 2}", "--workers", "2")
    source, found = random.Random(given.seed), Outcome()
    with tempfile.TemporaryDirectory(prefix="servobench-kills-") as scratch:
        quiet = [
            Sweep(Path(scratch, f"quiet{k}"), names, *how, PEACE="1")
            for k, names in enumerate(BATCHES)
        ]
        for each in quiet:
            assert end(each, each.start(), ("none", ""), found) == 0, found.faults
        while found.signals.total() < given.kills:
            batch, goal = found.tables % 2, min(given.kills, found.signals.total() + len(SIGNALS))
            sweep = Sweep(Path(scratch, f"table{found.tables}"), BATCHES[batch], *how, PEACE="1")
            process = sweep.start()
            while found.signals.total() < goal and signalled(sweep, process, source, found):
                process = process if process.poll() is None else sweep.start()
            if end(sweep, process, ("last", ""), found) != 0:
                end(sweep, sweep.start(), ("last", ""), found)
            found.tables += 1
            try:
                pd.testing.assert_frame_equal(sweep.table(), quiet[batch].table(), check_exact=True)
            except (AssertionError, OSError) as error:
                found.faults.append(f"table {found.tables}: {error}")
    for key, count in sorted(found.signals.items()):
        print(
            f"{key[0]:10} {key[1]:5} {count:3}, lived {found.lived.get(key, 0.0):.2f} s after the end"
        )
    print(
        f"{found.signals.total()} signals, {found.tables} tables, {len(found.faults)} faults",
        *found.faults,
        sep="\n",
    )
    sys.exit(bool(found.faults))


if __name__ == "__main__":
    main()
