"""Time of a step of exported controllers against their originals, over the same recorded periods in one process."""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from measuring import asked_to_be_quick, microseconds, processor_time, table
from servobench.controllers.controller import Controller
from servobench.controllers.servo import ServoController
from servobench.fmus.compiler import this_platform
from servobench.harness.apps.fmu.products import controller_model
from servobench.harness.config.entries import NoSettings
from servobench.harness.config.fmu_controller import mapped_controller
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.signals import Command
from servobench.plant.robot.mismatch import Mismatch

METHODS = (
    "ukf_mfac:published", "rbf_pid:published", "rbfnn_mfac:published", "regression_mfac", "ukf_mfac",
    "rbf_pid", "rbfnn_mfac"
)  # fmt: skip
PERIODS, LIMIT = 200, 1e-9


def measured(name: str, folder: Path) -> tuple[list[float], float, int]:
    """Return times of a step of original and FMU [s], their largest difference [rad/s], and the size of the state."""
    request = RunRequest("kinematic", name, "target", Mismatch.parse("moderate"), 3)
    model = controller_model(request, Settings())
    path = model.product(2).write(folder / f"{model.identifier}.fmu", (this_platform(),))
    experiment = build(resolve(request, Settings()))
    plant, original = experiment.plant, cast(ServoController, experiment.controller)
    plugged = mapped_controller(path, name).build(NoSettings(), original.servo.knowledge)
    rows = 1 + experiment.run.preview_rows
    desired = experiment.scenario.reference.sampled(plant.spec.period, PERIODS + rows)
    references = [desired[k : k + rows] for k in range(PERIODS)]
    observations = [plant.reset(0)]
    original.reset(observations[0], 0)
    for reference in references:
        observations.append(plant.step(original.step(observations[-1], reference)))

    def go(controller: Controller) -> list[Command]:
        controller.reset(observations[0], 0)
        return [controller.step(*each) for each in zip(observations, references, strict=False)]

    pairs = zip(go(original), go(plugged), strict=True)
    worst = max(
        float(np.abs(one.joint_velocity - other.joint_velocity).max()) for one, other in pairs
    )
    times = [processor_time(partial(go, each), 1) / PERIODS for each in (original, plugged)]
    plant.close()
    return times, worst, model.recorded.states


def main() -> None:
    """Compare times and answers; exit with 1 where the answers differ."""
    methods = METHODS[:1] if asked_to_be_quick(__doc__) else METHODS
    rows, differences = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name in methods:
            (python, fmu), worst, size = measured(name, Path(folder))
            differences.append(worst)
            words = (
                microseconds(python),
                microseconds(fmu),
                f"{python / fmu:.1f}",
                f"{worst:.1e}",
                size,
            )
            rows.append([f"`{name}`", *words])
    header = [
        "controller",
        "original [µs]",
        "FMU [µs]",
        "original / FMU",
        "difference [rad/s]",
        "numbers remembered",
    ]
    print(table(header, rows))
    if max(differences) > LIMIT:
        sys.exit("controller_fmu: missed")


if __name__ == "__main__":
    main()
