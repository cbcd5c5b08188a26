"""What a sweep costs: processor time of the whole command a control period, start-up apart, against older checkouts.

    python benchmarks/throughput.py                                   # this checkout
    python benchmarks/throughput.py --against /path/to/0.1.0 /path/to/commit-before

Every checkout carries out the same sweep in turn, in an environment of its own where it has one in `.venv`, so that
other load on the machine falls on all. A sweep of `--few` robots is subtracted from one of `--robots`: what is left is
the cost of a run, its building, judging and writing included. Version 0.1.0 works, too.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

METHODS = ("ukf_mfac", "ukf_mpc", "rbf_pid", "rbfnn_mfac", "rbfnn_mfac_plus")
PERIODS = 200  # of a run of the task random
FIRST_SEED = 40_000


def processor_time(checkout: Path, plant: str, method: str, robots: int) -> float:
    """Return the processor time [s] of one sweep with all its processes."""
    own = checkout / ".venv" / "bin" / "python"
    packages = checkout / ".package"
    module = "servobench" if packages.is_dir() else "harness.command_line"
    environment = {**os.environ, "PYTHONPATH": str(packages if packages.is_dir() else checkout), "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as scratch:
        command = [
            *(str(own if own.exists() else sys.executable), "-m", module, "sweep", "--plants", plant),
            *("--controllers", method, "--seeds", f"{FIRST_SEED}:{FIRST_SEED + robots}", "--out", f"{scratch}/sweep"),
        ]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, env=environment, cwd=checkout, capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print a table: microseconds a period and ratios of the other checkouts to this one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, nargs="*", default=[], help="older checkouts")
    parser.add_argument("--plants", nargs="*", default=["kinematic", "fmu"])
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--robots", type=int, default=400, help="of this checkout; older ones get a tenth")
    parser.add_argument("--few", type=int, default=8)
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    checkouts = [here, *(path.resolve() for path in options.against)]
    print("| plant | method | this [µs a period] |" + "".join(f" {path.name} [µs] | ratio |" for path in checkouts[1:]))
    print("|---|---|---|" + "---|---|" * len(checkouts[1:]))
    for plant in options.plants:
        for method in options.methods:
            costs = [[] for _ in checkouts]
            for _ in range(options.rounds):
                for own, checkout in zip(costs, checkouts, strict=True):
                    robots = options.robots if checkout == here else max(options.few + 10, options.robots // 10)
                    many, few = (processor_time(checkout, plant, method, count) for count in (robots, options.few))
                    own.append(1e6 * (many - few) / (robots - options.few) / PERIODS)
            first, *others = map(statistics.median, costs)
            cells = "".join(f" {other:.0f} | {other / first:.1f} |" for other in others)
            print(f"| {plant} | `{method}` | {first:.1f} |{cells}", flush=True)


if __name__ == "__main__":
    main()
