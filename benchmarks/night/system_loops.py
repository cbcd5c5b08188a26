"""Closed loops as systems (SSP) in FMPy's hands, against the harness.

PYTHONPATH=benchmarks python -m night.system_loops
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fmpy.ssp.simulation import simulate_ssp

from servobench.fmus.compiler import this_platform
from servobench.fmus.controllers.ssp import write_loop
from servobench.harness.apps.fmu.products import loop_products
from servobench.harness.batch.api import run
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.faults import ConfigurationError

PERIOD, ROWS = 0.05, 100
EXACT = {"command_delay": PERIOD, "sensing": {"feature_noise": 0.0, "latency": 0.0}}
MISMATCH, SEED = "moderate", 2
UNEXPORTED = ("plate",)  # sensing without an exported form, which a line says


class Loop(NamedTuple):
    """A controller with an arm and its cameras."""

    controller: str
    robot: str = "ur5"
    sensing: str = "position"


LOOPS = (
    *(
        Loop(name + how)
        for name in ("ukf_mfac", "rbf_pid", "rbfnn_mfac")
        for how in ("", ":published")
    ),
    Loop("regression_mfac"),
    *(Loop("ukf_mfac:published", robot) for robot in ("ur10e", "panda")),
    Loop("regression_mfac", "ur10e"),
    *(
        Loop("ukf_mfac:published", sensing=sensing)
        for sensing in ("pixel", "pixel:hand", "stereo", "plate")
    ),
)


def write(loop: Loop, folder: Path) -> Path:
    """Write the system of a loop, of one robot of moderate mismatch, into a folder."""
    request = RunRequest(
        "kinematic",
        loop.controller,
        "target",
        MISMATCH,
        SEED,
        robot=loop.robot,
        sensing=loop.sensing,
    )
    plant, controller, stop = loop_products(request, Settings())
    return write_loop(folder / "loop.ssp", plant, controller, (this_platform(),), stop)


def both(loop: Loop, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return joints and features, (periods, k), as FMPy and as the harness makes them.

    FMPy passes what a component put out to the others after the step: each command acts a period later.
    """
    steps = run(
        loop.controller, task="target", mismatch=MISMATCH, seed=SEED, robot=loop.robot, sensing=loop.sensing,
        settings={"kinematic": EXACT},
    ).steps  # fmt: skip
    rows = min(ROWS, len(steps))
    came = simulate_ssp(str(path), stop_time=(rows + 0.5) * PERIOD, step_size=PERIOD)
    feature = "plant.ball_position" if loop.sensing == "position" else "plant.feature"
    found, wanted = [], []
    for name, prefix in (("plant.encoder_position", "joint_position_"), (feature, "true_feature_")):
        columns = [column for column in steps if column.startswith(prefix)]
        wanted.append(steps[columns].to_numpy()[:rows])
        found.append(
            np.column_stack([came[f"{name}[{i + 1}]"] for i in range(len(columns))])[:rows]
        )
    return np.hstack(found), np.hstack(wanted)


def agree(loop: Loop, found: np.ndarray, wanted: np.ndarray) -> bool:
    """Return whether both went the same way, but for rounding, and went anywhere."""
    near = np.allclose(found, wanted, rtol=0.0 if loop.sensing == "position" else 1e-9, atol=1e-9)
    return near and np.ptp(wanted, axis=0).max() > 0.1


def main() -> int:
    """Print for each loop how far FMPy and the harness are apart; exit code 1 if one differs or cannot be exported."""
    wrong = 0
    for loop in LOOPS:
        try:
            with tempfile.TemporaryDirectory(prefix="servobench-loops-") as folder:
                found, wanted = both(loop, write(loop, Path(folder)))
        except ConfigurationError as error:
            print(f"{' '.join(loop)}: {error}")
            wrong += loop.sensing not in UNEXPORTED
            continue
        wrong += not agree(loop, found, wanted)
        apart, moved = np.abs(found - wanted).max(), np.ptp(wanted, axis=0).max()
        print(
            f"{' '.join(loop)}: {len(wanted)} periods, {apart:.1e} apart, moved by {moved:.2f}",
            flush=True,
        )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
