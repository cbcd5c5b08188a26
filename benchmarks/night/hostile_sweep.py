"""A night with bad company: a sweep whose controllers crash, hang, leak, fork, exit, print and lie.

On its way it is killed twice, meets a full disk once and a second process once; each time it goes on with --resume. At
the end every run is a row, and those that nothing was done to equal those of a quiet sweep bit for bit.

    PYTHONPATH=tests:benchmarks python -m night.hostile_sweep --runs 10000

A quarter of the runs each: the controller `Sometimes`, of which every fourth run does harm, `Falsifies`, which leaves a
false numpy and a false clock behind, `Quiet`, and `constant` of this package.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import pandas as pd

from measuring import options
from night import hostile_controllers
from night.kills import SOON, Sweep
from servobench.plant.contract.seeds import named_seed

HOSTILE: Final = Path(hostile_controllers.__file__)
CONTROLLERS: Final = (
    *(f"{HOSTILE}:{name}" for name in ("Falsifies", "Sometimes", "Quiet")),
    "constant",
)
FIRST_SEED: Final = 100_000
SMALL_FILE: Final = 4000  # [bytes] less than a part of the results: a disk that is full
# Runs that complete all the same
HARMLESS: Final = ("Forks", "InterruptsItself", "LeavesChildren", "Prints")
KILLED_AT: Final = (0.25, 0.6)  # share of the runs


def finish(sweep: Sweep, process: subprocess.Popen[bytes], code: int) -> str:
    """Wait for a sweep, whose exit code is known, and return what it wrote to standard error."""
    found, errors = process.wait(), sweep.said()
    if found != code or "Traceback" in errors:
        sys.exit(f"exit code {found} instead of {code}:\n{errors}")
    return errors


def kill_at(count: float, sweep: Sweep, process: subprocess.Popen[bytes]) -> float:
    """Kill a sweep when so many of its runs are there; return how long something of it lived on [s]."""
    wait(sweep, process, count)
    process.kill()
    process.wait()
    lived, left = sweep.outlived(SOON)
    if left:
        sys.exit(f"{SOON:g} s after the sweep was killed, these live on: {left}")
    return lived


def wait(sweep: Sweep, process: subprocess.Popen[bytes], count: float) -> None:
    """Wait until so many runs are there while a sweep runs."""
    while finished(sweep) < count:
        if process.poll() is not None:
            sys.exit(f"the sweep ended early with exit code {process.returncode}:\n{sweep.said()}")
        time.sleep(0.2)


def finished(sweep: Sweep) -> int:
    """Return how many runs of a sweep are surely finished: the index of its last part."""
    parts = sorted((sweep.folder / "parts").glob("[0-9]*.runs.parquet"))
    return int(parts[-1].name.split(".")[0]) if parts else 0


def carry_out(quiet: Sweep, hard: Sweep, runs: int) -> tuple[float, float, list[float]]:
    """Carry out the quiet and the hard sweep; return what they took [s], and how long killed ones lived on [s]."""
    began = time.monotonic()
    finish(quiet, quiet.start(), 0)
    calm = time.monotonic() - began
    began = time.monotonic()
    lived = [kill_at(KILLED_AT[0] * runs, hard, hard.start())]
    process = hard.start()
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (SMALL_FILE, SMALL_FILE))
    full = finish(hard, process, 1)
    if "File too large" not in full:
        sys.exit(f"a full disk was not told:\n{full}")
    process = hard.start()
    wait(hard, process, finished(hard) + 1)
    process.send_signal(signal.SIGSTOP)  # so that it is not over before the second one has begun
    second = finish(hard, hard.start(), 2)
    process.send_signal(signal.SIGCONT)
    if "another process" not in second and "is being written" not in second:
        sys.exit(f"a second process was not refused:\n{second}")
    lived.append(kill_at(KILLED_AT[1] * runs, hard, process))
    finish(hard, hard.start(), 0)
    took = time.monotonic() - began
    if left := [each for sweep in (quiet, hard) for each in sweep.outlived(SOON)[1]]:
        sys.exit(f"{SOON:g} s after the sweep these live on: {left}")
    return calm, took, lived


def judge(quiet: pd.DataFrame, hard: pd.DataFrame, runs: int) -> pd.DataFrame:
    """Hold the two tables against each other; return how many runs ended how, by what was done to them."""
    if len(hard) != runs or list(hard["run_id"]) != list(quiet["run_id"]):
        sys.exit(f"{len(hard)} rows instead of {runs}, or other ones")
    harm = pd.Series(
        [_harm(*each) for each in zip(hard["controller"], hard["seed"], strict=True)], name="harm"
    )
    spared = harm.isin(["", *HARMLESS])
    pd.testing.assert_frame_equal(hard[spared], quiet[spared], check_exact=True)
    if (hard[~spared]["status"] == "completed").any():
        sys.exit(
            f"runs to which harm was done completed:\n{hard[~spared & (hard['status'] == 'completed')]}"
        )
    return hard.groupby([harm, "status"]).size().rename("runs").reset_index()


def _harm(controller: str, seed: int) -> str:
    if controller == "Falsifies":
        return "Lies"
    found = (
        hostile_controllers.harm_of(named_seed(seed, "controller"))
        if controller == "Sometimes"
        else None
    )
    return "" if found is None else found.__name__


def main() -> None:
    """Carry everything out and print what came of it."""
    given = options(
        __doc__,
        runs=10_000,
        workers=2,
        timeout=(10.0, "[s] of a run"),
        folder={"type": Path, "help": "keeps both sweeps; default: a temporary one"},
    )
    with tempfile.TemporaryDirectory(prefix="servobench-night-") as scratch:
        robots, folder = given.runs // len(CONTROLLERS), given.folder or Path(scratch)
        runs = robots * len(CONTROLLERS)
        how = (
            ",".join(CONTROLLERS), f"{FIRST_SEED}:{FIRST_SEED + robots}", "--set", "random.duration=0.5",
            "--workers", str(given.workers), "--run-timeout", str(given.timeout), "--run-memory", "800MB",
        )  # fmt: skip
        quiet, hard = Sweep(folder / "quiet", *how, PEACE="1"), Sweep(folder / "hard", *how)
        calm, took, lived = carry_out(quiet, hard, runs)
        print(judge(quiet.table(), hard.table(), runs).to_string(index=False))
        print(
            f"{runs} rows; all runs that nothing was done to equal those of the quiet sweep bit for bit"
        )
        print(f"quiet {calm:.0f} s, hard {took:.0f} s: {took / calm:.1f} times as long")
        print(f"after each kill of the parent everything was gone within {max(lived):.2f} s")


if __name__ == "__main__":
    main()
