"""Golden runs: the first periods of every method on every plant, and when it has settled; `python tests/kit/golden.py`.

One run of the task exp2 with seed 0 and the mismatch moderate is made for each method on each plant. Of each of its
first periods the table `golden_runs.csv` keeps Σ_i i u_i [rad/s], a sum in which a change of any joint's command
shows; a change of the plant shows in the commands of the next period. `spread` is how far rounding moves these sums:
the largest deviation among the kernels of OpenBLAS, numpy's AVX-512 and a start one unit in the last place away,
each with networks of its own, at least `MIN_SPREAD`. The table is renewed by this file, which prints the line that
CHANGELOG.md is then to have.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import servobench
from servobench.harness.config.registry import CONTROLLERS, RENDERED
from servobench.harness.run.tasks import find_task

PERIODS = 20  # that are compared
PERIOD = 0.05  # [s]
TASK = "exp2"
# [s], short where rendered
DURATIONS = {"kinematic": 4.0, "fmu": 4.0, **dict.fromkeys(RENDERED, PERIODS * PERIOD)}
ALL_RUNS = dict.fromkeys(DURATIONS, CONTROLLERS)  # methods by plant
RENDERER = "llvmpipe"  # that drew the images of `mujoco`; those of another one differ by more than rounding
MIN_SPREAD = 1e-13  # [rad/s], a thousand units in the last place of a slow command
TABLE = Path(__file__).parents[1] / "closed_loop" / "golden_runs.csv"
SUMS = [f"u{k:02d}" for k in range(PERIODS)]
SIMD = "NPY_DISABLE_CPU_FEATURES"  # loops of numpy that are not used, by the names in `numpy.show_config()`
AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
# of the table: AVX2, which x86-64 processors have since 2015
KERNEL = {"OPENBLAS_CORETYPE": "Haswell", SIMD: AVX512}
OTHER_KERNELS = ("Sandybridge", "Nehalem")
VARIANTS: tuple[Mapping[str, str], ...] = (
    *({"OPENBLAS_CORETYPE": kernel} for kernel in OTHER_KERNELS),
    {SIMD: ""},  # with AVX-512 where the processor has it, and so another exp
    {"GOLDEN_START": "next"},
)


def golden_runs(plant: str, controllers: Sequence[str]) -> pd.DataFrame:
    """Make the runs on a plant and return the rows of the table, without the spread."""
    settings: dict[str, dict[str, Any]] = {
        TASK: {"duration": DURATIONS[plant]},
        "run": {"period": PERIOD},
    }
    if plant in RENDERED:
        settings[plant] = {"scenery": False}  # which changes no bit of an observation
    if os.environ.get("GOLDEN_START") == "next":
        settings[TASK]["start"] = np.nextafter(find_task(TASK).default.start, np.inf).tolist()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        servobench.compare(controllers, [plant], [TASK], settings=settings, out=out)
        tables = servobench.load(out)
    assert tables.steps is not None
    rows = []
    for run in tables.runs.itertuples():
        steps = tables.steps[tables.steps["run_id"] == run.run_id]
        u = steps.filter(like="joint_velocity_command_").to_numpy()[:PERIODS]
        values = [float(f"{value:.15g}") for value in u @ np.arange(1.0, u.shape[1] + 1.0)]
        sums = dict(zip(SUMS, values, strict=True))
        rows.append(
            {"plant": plant, "controller": run.controller, "settled": run.settling_time_s, **sums}
        )
    return pd.DataFrame(rows)


def stored() -> pd.DataFrame:
    """Return the table as it is kept."""
    return pd.read_csv(TABLE)


def changelog_line() -> str:
    """Return the line of CHANGELOG.md that belongs to the table as it is kept."""
    return f"Golden runs: `{hashlib.sha256(TABLE.read_bytes()).hexdigest()[:16]}`."


def made_apart(
    folder: Path, controllers: Mapping[str, Iterable[str]] = ALL_RUNS, **environment: str
) -> pd.DataFrame:
    """Return the table as a process of its own makes it, by the plants; the first one in a folder trains networks."""
    folder.mkdir(exist_ok=True)
    path = folder / "made.csv"
    own = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), **KERNEL, **environment}
    runs = [f"{plant}={','.join(names)}" for plant, names in controllers.items()]
    subprocess.run([sys.executable, __file__, str(path), *runs], env=own, check=True)
    return pd.read_csv(path)


def renew() -> None:
    """Make the runs in all variants and write the table anew."""
    with tempfile.TemporaryDirectory() as folder:
        table = made_apart(Path(folder) / "own")
        spread = np.full(len(table), MIN_SPREAD)
        for k, environment in enumerate(VARIANTS):
            other = made_apart(Path(folder) / str(k), **environment)
            deviation = (other[SUMS] - table[SUMS]).abs().max(axis=1).to_numpy()
            late = (other["settled"] - table["settled"]).abs().max()
            print(
                f"{environment}: {np.median(deviation):.1e} to {deviation.max():.1e} rad/s, settled {late:.2g} s apart"
            )
            spread = np.maximum(spread, deviation)
    table.insert(3, "spread", [float(f"{value:.1e}") for value in spread])
    table.to_csv(TABLE, index=False)
    print(f"CHANGELOG.md is to have the line, where it says what changed:\n{changelog_line()}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        path, *runs = sys.argv[1:]
        wanted = [each.partition("=") for each in runs]
        pd.concat([golden_runs(plant, names.split(",")) for plant, _, names in wanted]).to_csv(
            path, index=False
        )
    else:
        renew()
