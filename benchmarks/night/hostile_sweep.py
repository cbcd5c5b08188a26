"""A night with bad company: a sweep whose controllers crash, hang, leak, fork, exit, print and lie.

On its way it is killed twice, meets a full disk once and a second process once; each time it goes on with --resume. At
the end every run is a row, and those that nothing was done to equal those of a quiet sweep bit for bit.

    PYTHONPATH=tests:benchmarks python -m night.hostile_sweep --runs 10000

A quarter of the runs each: the controller `Sometimes`, of which every fourth run does harm, `Falsifies`, which leaves a
false numpy and a false clock behind, `Quiet`, and `constant` of this package.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from kit.command import judged, left_behind
from night import hostile_controllers
from servobench.plant.contract.seeds import named_seed

HOSTILE: Final = Path(hostile_controllers.__file__)
CONTROLLERS: Final = (*(f"{HOSTILE}:{name}" for name in ("Falsifies", "Sometimes", "Quiet")), "constant")
FIRST_SEED: Final = 100_000
MARK: Final = "SERVOBENCH_HOSTILE_SWEEP"  # an environment variable that everything started here inherits
SOON: Final = 5.0  # [s] until nothing is left of a command that was killed
SMALL_FILE: Final = 4000  # [bytes] less than a part of the results: a disk that is full
HARMLESS: Final = ("Forks", "InterruptsItself", "LeavesChildren", "Prints")  # runs that complete all the same
KILLED_AT: Final = (0.25, 0.6)  # share of the runs


class Night:
    """The calls of one sweep."""

    def __init__(self, folder: Path, runs: int, workers: int, timeout: float) -> None:
        self.folder, self.runs = folder, runs
        seeds = runs // len(CONTROLLERS)
        self.arguments = [
            *("sweep", "--controllers", ",".join(CONTROLLERS), "--seeds", f"{FIRST_SEED}:{FIRST_SEED + seeds}"),
            *("--set", "random.duration=0.5", "--workers", str(workers)),
            *("--run-timeout", str(timeout), "--run-memory", "800MB"),
        ]

    def start(self, name: str, *further: str, **environment: str) -> subprocess.Popen[str]:
        """Start the sweep into the folder `name`."""
        call = [sys.executable, "-m", "servobench", *self.arguments, "--out", str(self.folder / name), *further]
        known = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), MARK: str(self.folder), **environment}
        return subprocess.Popen(call, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=known)

    def finish(self, process: subprocess.Popen[str], code: int) -> str:
        """Wait for a sweep, whose exit code is known, and return what it wrote to standard error."""
        errors = process.communicate()[1]
        if process.returncode != code or "Traceback" in errors:
            sys.exit(f"exit code {process.returncode} instead of {code}:\n{errors}")
        return errors

    def kill_at(self, share: float, process: subprocess.Popen[str]) -> float:
        """Kill a sweep when a share of its runs is there; return how long something of it lived on [s]."""
        self.wait(process, lambda: self.count("hard") >= share * self.runs)
        process.kill()
        killed = time.monotonic()
        while process.poll() is None or self.left():
            if time.monotonic() - killed > SOON:
                sys.exit(f"{SOON:g} s after the sweep was killed, these live on: {self.left()}")
            time.sleep(0.02)
        lived = time.monotonic() - killed
        process.communicate()
        return lived

    def wait(self, process: subprocess.Popen[str], condition: Callable[[], bool]) -> None:
        """Wait until a condition holds while a sweep runs."""
        while not condition():
            if process.poll() is not None:
                sys.exit(f"the sweep ended early with exit code {process.returncode}:\n{process.communicate()[1]}")
            time.sleep(0.2)

    def count(self, name: str) -> int:
        """Return how many runs of a sweep are surely finished: the index of its last part."""
        parts = sorted((self.folder / name / "parts").glob("[0-9]*.runs.parquet"))
        return int(parts[-1].name.split(".")[0]) if parts else 0

    def left(self) -> list[str]:
        """Return the processes of sweeps that still run."""
        return left_behind(MARK, str(self.folder))


def carry_out(night: Night) -> tuple[float, float, list[float]]:
    """Carry out the quiet and the hard sweep; return what they took [s], and how long killed ones lived on [s]."""
    began = time.monotonic()
    night.finish(night.start("quiet", PEACE="1"), 0)
    quiet = time.monotonic() - began
    began = time.monotonic()
    lived = [night.kill_at(KILLED_AT[0], night.start("hard"))]
    process = night.start("hard", "--resume")
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (SMALL_FILE, SMALL_FILE))
    full = night.finish(process, 1)
    if "File too large" not in full:
        sys.exit(f"a full disk was not told:\n{full}")
    process = night.start("hard", "--resume")
    known = night.count("hard")
    night.wait(process, lambda: night.count("hard") > known)
    process.send_signal(signal.SIGSTOP)  # so that it is not over before the second one has begun
    second = night.finish(night.start("hard", "--resume"), 2)
    process.send_signal(signal.SIGCONT)
    if "another process" not in second and "is being written" not in second:
        sys.exit(f"a second process was not refused:\n{second}")
    lived.append(night.kill_at(KILLED_AT[1], process))
    night.finish(night.start("hard", "--resume"), 0)
    hard = time.monotonic() - began
    if night.left():
        sys.exit(f"the sweep is over and these live on: {night.left()}")
    return quiet, hard, lived


def judge(night: Night) -> pd.DataFrame:
    """Hold the two tables against each other; return how many runs ended how, by what was done to them."""
    quiet, hard = (pd.read_parquet(night.folder / name / "runs.parquet") for name in ("quiet", "hard"))
    if len(hard) != night.runs or list(hard["run_id"]) != list(quiet["run_id"]):
        sys.exit(f"{len(hard)} rows instead of {night.runs}, or other ones")
    hard["harm"] = [_harm(*each) for each in zip(hard["controller"], hard["seed"], strict=True)]
    spared = hard["harm"].isin(["", *HARMLESS])
    found, wanted = judged(hard)[spared].drop(columns="harm"), judged(quiet)[spared]
    pd.testing.assert_frame_equal(found, wanted, check_exact=True)
    if (hard[~spared]["status"] == "completed").any():
        sys.exit(f"runs to which harm was done completed:\n{hard[~spared & (hard['status'] == 'completed')]}")
    return hard.groupby(["harm", "status"]).size().rename("runs").reset_index()


def _harm(controller: str, seed: int) -> str:
    if controller == "Falsifies":
        return "Lies"
    found = hostile_controllers.harm_of(named_seed(seed, "controller")) if controller == "Sometimes" else None
    return "" if found is None else found.__name__


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry everything out and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--timeout", type=float, default=10.0, help="[s] of a run")
    parser.add_argument("--folder", type=Path, help="keeps both sweeps; default: a temporary one")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="servobench-night-") as scratch:
        runs = len(CONTROLLERS) * (given.runs // len(CONTROLLERS))
        night = Night(given.folder or Path(scratch), runs, given.workers, given.timeout)
        quiet, hard, lived = carry_out(night)
        print(judge(night).to_string(index=False))
        print(f"{night.runs} rows; all runs that nothing was done to equal those of the quiet sweep bit for bit")
        print(f"quiet {quiet:.0f} s, hard {hard:.0f} s: {hard / quiet:.1f} times as long")
        print(f"after each kill of the parent everything was gone within {max(lived):.2f} s")


if __name__ == "__main__":
    main()
