"""How a sweep grows on a Dask cluster: measured on one and two workers of this machine, estimated beyond.

The estimate has one bottleneck: the parent hands out blocks and writes rows on one processor, whose time a run is
measured here, as is that of the scheduler beyond its idle seconds, in which it looks after workers only. Workers are
taken to be as fast as here and to have full blocks.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any, NamedTuple

from measuring import METHODS, PERIODS, asked_to_be_quick, seeds, sweep_times, table

CORES = (16, 1000)
IDLE = 5.0  # [s] over which the share of an idle scheduler is measured
# Dask has its workers return freed memory at once; arrays of a block would be mapped anew in every period.
MEMORY = {"MALLOC_TRIM_THRESHOLD_": "1000000000", "MALLOC_MMAP_THRESHOLD_": "1000000000"}


class Cost(NamedTuple):
    """What a sweep took [s]."""

    wall: float
    parent: float
    scheduler: float  # without that of an idle one


def sweep(cluster: Any, robots: int, idle: float = 0.0) -> Cost:  # noqa: ANN401 - of Dask
    """Return what a sweep over all methods takes; the scheduler lives in this process, whose idle share is given."""
    names = "sweep", "--controllers", ",".join(METHODS), "--scheduler", cluster.scheduler_address
    used = time.process_time()
    parent, wall = sweep_times(
        [sys.executable, "-m", "servobench", *names, "--seeds", seeds(robots)]
    )
    return Cost(wall, parent, time.process_time() - used - idle * wall)


def idle_share(seconds: float) -> float:
    """Return the share of a processor [1] that this process takes while nothing is done."""
    used = time.process_time()
    time.sleep(seconds)
    return (time.process_time() - used) / seconds


def measure(workers: int, few: int, many: int) -> tuple[Cost, Cost]:
    """Return what start-up takes, of a sweep with warm workers, and what each further run takes."""
    from distributed import LocalCluster

    os.environ.update(MEMORY)
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
        sweep(cluster, 2 * workers)  # imports
        idle = idle_share(IDLE)
        small, large = (sweep(cluster, count, idle) for count in (few, many))
    runs = (many - few) * len(METHODS)
    each = Cost(*((a - b) / runs for a, b in zip(large, small, strict=True)))
    start = Cost(*(a - few * len(METHODS) * b for a, b in zip(small, each, strict=True)))
    return start, each


def main() -> None:
    """Print what was measured and the estimate."""
    few, many = (2, 4) if asked_to_be_quick(__doc__) else (256, 768)
    measured = {workers: measure(workers, few, many) for workers in (1, 2)}
    rows = [
        [workers, f"{start.wall:.1f} s", *(f"{1e3 * value:.2f} ms" for value in each)]
        for workers, (start, each) in measured.items()
    ]
    print(
        table(
            [
                "workers",
                "start-up",
                "wall-clock time a run",
                "parent's processor time a run",
                "scheduler's, beyond idle",
            ],
            rows,
        )
    )
    start, one = measured[1]
    serial = max(max(each.parent, each.scheduler) for _, each in measured.values())
    print(
        f"The busiest single process beside the workers needs {1e3 * serial:.2f} ms a run, {serial / one.wall:.1%} of "
        f"the run itself: by that alone more than about {one.wall / serial:.0f} workers gain nothing.\n"
    )
    runs, rows = 200_000 * len(METHODS), []
    for cores in CORES:
        seconds = start.wall + runs * max(one.wall / cores, serial)
        rows.append([cores, f"{seconds:.0f} s", f"{runs * PERIODS / seconds / 1e6:.2f}"])
    print(
        f"Estimate for {runs:,} runs, {runs * PERIODS / 1e6:,.0f} million periods over the {len(METHODS)} methods:\n"
    )
    print(table(["cores", "estimate", "million periods a second"], rows))


if __name__ == "__main__":
    main()
