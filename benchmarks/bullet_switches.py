"""What each part of the dynamics and of the noise of `bullet` does to two methods: differences paired by seed.

    python benchmarks/bullet_switches.py                     # 8 robots, moves and circles: about half an hour
    python benchmarks/bullet_switches.py --tasks exp2        # the moves alone

Every robot with moderate mismatch is run with the default settings and with each switch turned; printed are the median
by default, the mean difference of the switch with its 95 % interval over seeds (Student's t), and the share of ends
that are no `completed`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import t

from measuring import table
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.drives import DriveConfig
from servobench.plant.robot.mismatch import Mismatch

METHODS = ("ukf_mfac", "rbf_pid")
FIRST_SEED = 41_000
METRICS = {"exp2": ("settling_time_s", 1.0, "s"), "circle": ("rms_error_evaluated", 1000.0, "mm")}
DURATIONS: dict[str, dict[str, Any]] = {"exp2": {"duration": 6.0}, "circle": {}}
DRIVES = DriveConfig()
SWITCHES: dict[str, dict[str, Any]] = {
    "default": {},
    "no dynamics": {"drives": {"dynamics": False}},
    "payload doubled": {"drives": {"payload": 2 * DRIVES.payload}},
    "payload known": {"drives": {"assumed_payload": DRIVES.payload}},
    "torque limits halved": {"drives": {"torque_limit": [limit / 2 for limit in DRIVES.torque_limit]}},
    "no friction": {"drives": {"coulomb_friction": [0.0], "viscous_friction": [0.0]}},
    "friction not compensated": {"drives": {"friction_compensation": 0.0}},
    "white depth noise": {"depth_patch": 0.0},
    "exact encoders": {"encoder_resolution": 0.0},
}


def measure(method: str, task: str, switch: str, seeds: Sequence[int]) -> FloatArray:
    """Return the metric of a task for each seed, (seeds,), NaN where there is none."""
    settings = Settings({"bullet": {"scenery": False, **SWITCHES[switch]}, task: DURATIONS[task]})
    requests = [RunRequest("bullet", method, task, Mismatch.parse("moderate"), seed) for seed in seeds]
    name, factor, _ = METRICS[task]
    return np.array([factor * run_experiment(request, settings, steps=False).row[name] for request in requests])


def compare(default: FloatArray, other: FloatArray) -> str:
    """Return the mean paired difference (seeds,) with its interval, and how many runs have no metric."""
    difference = (other - default)[np.isfinite(other - default)]
    missing = int(np.sum(~np.isfinite(other)))
    if len(difference) < 2:
        return f"none of {len(other)} comparable"
    half = t.ppf(0.975, len(difference) - 1) * difference.std(ddof=1) / np.sqrt(len(difference))
    interval = f"{difference.mean():+.2f} [{difference.mean() - half:+.2f}, {difference.mean() + half:+.2f}]"
    return interval + (f", {missing} of {len(other)} without" if missing else "")


def main() -> None:
    """Print a table with a row for each switch, task by task and method by method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--tasks", nargs="+", choices=sorted(METRICS), default=sorted(METRICS))
    parser.add_argument("--switches", nargs="+", choices=list(SWITCHES)[1:], default=list(SWITCHES)[1:])
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.robots)
    for task in options.tasks:
        default = {method: measure(method, task, "default", seeds) for method in METHODS}
        middle = [f"{np.nanmedian(default[method]):.2f}" for method in METHODS]
        rows = [["default, median", *middle]]
        for switch in options.switches:
            print(f"{task}: {switch}", flush=True)
            rows.append([switch, *(compare(default[m], measure(m, task, switch, seeds)) for m in METHODS)])
        print(table([f"`{task}`, {METRICS[task][0]} in {METRICS[task][2]}", *METHODS], rows), flush=True)


if __name__ == "__main__":
    main()
