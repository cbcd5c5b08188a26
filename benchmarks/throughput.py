"""What a control period costs in a sweep and in a run by itself, against older checkouts, and a large sweep as a whole.

    python benchmarks/throughput.py                                   # this checkout
    python benchmarks/throughput.py --against 0.1.0=/path/to/0.1.0 before=/path/to/commit-before

Every checkout does the same in turn, in an environment of its own where it has one in `.venv`. A small sweep is
subtracted from a large one: what is left is a run with its building, judging and writing. Version 0.1.0 works, too.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measuring import METHODS, PERIODS, QUICK, microseconds, options, seeds, sweep_times, table

COMPILED = "--compiled"
EQUIPPED = ("regression_mfac", "rbf_pid", "rbfnn_mfac", "ukf_mpc")
ON_FMU = ("ukf_mfac", "rbfnn_mfac")  # all methods add the same time of this plant
IN_C = ("regression_mfac", "ukf_mfac", "rbf_pid", "rbfnn_mfac", "ukf_mfac:published")
HERE = Path(__file__).resolve().parents[1]
ALONE = """
import sys, time
try:
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.episode import run_experiment
    from servobench.harness.run.request import RunRequest
except ImportError:
    from harness.configuration import Settings
    from harness.experiment import RunRequest
    from harness.run import run_experiment
for seed in range(int(sys.argv[3]) + 1):
    began = began if seed > 1 else time.process_time()
    in_c = {"run": {"compiled": True}} if "--compiled" in sys.argv else {}
    run_experiment(RunRequest(sys.argv[1], sys.argv[2], "random", "moderate", seed), Settings(in_c))
print(time.process_time() - began)
"""


def surroundings(checkout: Path) -> tuple[str, dict[str, Any]]:
    """Return the Python of a checkout, its own where it has one, and the environment and folder of its processes."""
    own, packages = checkout / ".venv" / "bin" / "python", checkout / ".package"
    environment = {
        **os.environ,
        "PYTHONPATH": str(packages if packages.is_dir() else checkout),
        "OMP_NUM_THREADS": "1",
    }
    return str(own if own.exists() and checkout != HERE else sys.executable), {
        "env": environment,
        "cwd": checkout,
    }


def sweep(
    checkout: Path, plant: str, methods: str, robots: int, *further: str, workers: int = 1
) -> tuple[float, float]:
    """Return the processor time with all processes, and the wall-clock time, of a sweep [s]."""
    python, around = surroundings(checkout)
    module = "servobench" if (checkout / ".package").is_dir() else "harness.command_line"
    names = (
        "-m",
        module,
        "sweep",
        "--plants",
        plant,
        "--controllers",
        methods,
        "--workers",
        str(workers),
    )
    return sweep_times([python, *names, "--seeds", seeds(robots), *further], **around)


def period_in_sweep(
    checkout: Path, plant: str, method: str, few: int, many: int, *further: str
) -> float:
    """Return the processor time of a period in a sweep [s]."""
    times = [sweep(checkout, plant, method, count, *further)[0] for count in (few, many)]
    return (times[1] - times[0]) / (many - few) / PERIODS


def period_alone(checkout: Path, plant: str, method: str, runs: int, *further: str) -> float:
    """Return the processor time of a period of a run by itself [s]."""
    python, around = surroundings(checkout)
    command = [python, "-c", ALONE, plant, method, str(runs), *further]
    printed = subprocess.run(command, **around, capture_output=True, text=True, check=True).stdout
    return float(printed.split()[-1]) / runs / PERIODS


def ratio(
    cost: Callable[..., float], now: float, checkout: Path, plant: str, method: str, *sizes: int
) -> str:
    """Return what a method cost in an older checkout over what it costs now; a dash where it did not exist.

    Before methods had aids, the one that is now called `ukf_mfac:published` was `ukf_mfac`.
    """
    for name in dict.fromkeys((method, method.partition(":")[0])):
        with contextlib.suppress(subprocess.CalledProcessError):
            return f"{cost(checkout, plant, name, *sizes) / now:.2f}"
    return "–"


def main() -> None:
    """Print a table of times and ratios, and the time of the whole."""
    against = {"nargs": "*", "default": [], "metavar": "NAME=PATH", "help": "older checkouts"}
    given = options(__doc__, quick=QUICK, against=against, rounds=(1, "of this checkout"))
    others = {
        name: Path(path).resolve()
        for name, _, path in (each.partition("=") for each in given.against)
    }
    cases = [("kinematic", method) for method in (*METHODS, *EQUIPPED)]
    cases += [("fmu", method) for method in ON_FMU]
    counts, alone, rounds = (256, 1280), 15, given.rounds
    if given.quick:
        cases, counts, alone, rounds = cases[:1], (2, 10), 1, 1
    rows = []
    for plant, method in cases:
        now = min(period_in_sweep(HERE, plant, method, *counts) for _ in range(rounds))
        single = min(period_alone(HERE, plant, method, alone) for _ in range(rounds))
        cells = [microseconds(now), microseconds(single), "–", "–"]
        if method in IN_C:
            in_c = min(
                period_in_sweep(HERE, plant, method, *counts, COMPILED) for _ in range(rounds)
            )
            one = min(period_alone(HERE, plant, method, alone, COMPILED) for _ in range(rounds))
            cells[2:] = microseconds(in_c), microseconds(one)
        for checkout in others.values():
            cells.append(f"**{ratio(period_in_sweep, now, checkout, plant, method, *counts)}**")
            cells.append(ratio(period_alone, single, checkout, plant, method, alone))
        rows.append([plant, f"`{method}`", *cells])
    older = [f"{name} / now, {kind}" for name in others for kind in ("in a sweep", "alone")]
    times = ("in a sweep [µs]", "alone", "in C, in a sweep", "in C, alone")
    print(table(["plant", "method", *times, *older], rows))


if __name__ == "__main__":
    main()
