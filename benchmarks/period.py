"""What a control period costs in a whole run: processor time of a run, its building included, over its periods.

    python benchmarks/period.py                         # this checkout: us per period, with and without building
    python benchmarks/period.py --against /path/to/old  # both in turn, and the ratio of their medians

To compare two checkouts, give each an environment of its own (`make` does) and run this file with the interpreter of
the new one; the old one is run by its `.venv/bin/python`. Both carry out the same runs in turn, so that other load on
the machine falls on both. The old checkout may be version 0.1.0, whose packages have other names.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
from pathlib import Path

PLANTS = ("kinematic", "fmu")
CONTROLLER = "ukf_mfac"
TASK, MISMATCH = "random", "moderate"

CHILD = """
import sys, time
try:
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.episode import run_experiment
    from servobench.harness.run.experiment import build_experiment
    from servobench.harness.run.request import RunRequest
except ImportError:
    from harness.configuration import Settings
    from harness.experiment import RunRequest, build_experiment
    from harness.run import run_experiment
plant, controller, task, mismatch, runs = *sys.argv[1:5], int(sys.argv[5])
def carry_out(seed):
    return run_experiment(RunRequest(plant, controller, task, mismatch, seed), Settings()).row["periods"]
carry_out(0)
began = time.process_time()
periods = sum(carry_out(seed) for seed in range(1, runs + 1))
whole = time.process_time() - began
began = time.process_time()
for seed in range(1, runs + 1):
    build_experiment(RunRequest(plant, controller, task, mismatch, seed), Settings()).plant.close()
building = time.process_time() - began
print(1e6 * whole / periods, 1e6 * (whole - building) / periods)
"""


def measure(python: Path, checkout: Path, plant: str, runs: int) -> tuple[float, float]:
    """Return processor time a period of whole runs and of runs without their building [us]."""
    packages = checkout / ".package" if (checkout / ".package").is_dir() else checkout
    command = [str(python), "-c", CHILD, plant, CONTROLLER, TASK, MISMATCH, str(runs)]
    environment = {**os.environ, "PYTHONPATH": str(packages), "OMP_NUM_THREADS": "1"}
    printed = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True, check=True).stdout
    whole, stepping = map(float, printed.split()[-2:])
    return whole, stepping


def main() -> None:
    """Print medians and, with `--against`, ratios new over old."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="an older checkout with its environment in .venv")
    parser.add_argument("--rounds", type=int, default=5, help="processes of each checkout and plant")
    parser.add_argument("--runs", type=int, default=10, help="runs in a process, after one that is not counted")
    options = parser.parse_args()
    here = (Path(sys.executable), Path(__file__).resolve().parents[1])
    sides = {"this": here}
    if options.against is not None:
        old = options.against.resolve()
        sides["other"] = (old / ".venv" / "bin" / "python", old)
    for plant in PLANTS:
        found: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
        for _ in range(options.rounds):
            for side, (python, checkout) in sides.items():
                found[side].append(measure(python, checkout, plant, options.runs))
        medians = {side: [statistics.median(column) for column in zip(*values, strict=True)]
                   for side, values in found.items()}  # fmt: skip
        for side, (whole, stepping) in medians.items():
            print(f"{plant:10} {side:6} {whole:7.1f} us a period, {stepping:7.1f} without building")
        if "other" in medians:
            ratios = [new / old for new, old in zip(medians["this"], medians["other"], strict=True)]
            print(f"{plant:10} ratio  {ratios[0]:7.2f}             , {ratios[1]:7.2f}")


if __name__ == "__main__":
    main()
