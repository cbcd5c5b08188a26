"""The reference run inside every exported FMU: random commands, and the outputs that numpy computes for them."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servobench.fmus.variables import FEATURE, SEEN, Actuation, Layout
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.kinematic import discretise_lag
from servobench.plant.robot.hand_eye import RobotModel

STEP = 0.05  # [s]
STEPS = 200
INPUT_FILE = "extra/servobench/reference_input.csv"
OUTPUT_FILE = "extra/servobench/reference_output.csv"
COMMAND = "joint_velocity_command"


@dataclass(frozen=True)
class ReferenceRun:
    """Inputs, each held over the step that begins at its time, and the outputs at those times."""

    time: FloatArray  # (k,), s
    inputs: Mapping[str, FloatArray]  # by name, (k, size)
    outputs: Mapping[str, FloatArray]  # by name, (k, size)

    def tables(self, layout: Layout) -> tuple[str, str]:
        """Return inputs and outputs as CSV."""
        return table(self.time, self.inputs, layout), table(self.time, self.outputs, layout)


def reference_run(model: RobotModel, actuation: Actuation) -> ReferenceRun:
    """Return the reference run of `model`; some of its commands exceed the speed limit."""
    n = model.arm.n
    stops = actuation.stops(n)
    limit = stops.speed
    wanted = named_generator(0, "fmu_reference").uniform(-1.2 * limit, 1.2 * limit, (STEPS + 1, n))
    lags = np.broadcast_to(actuation.lag, n).tolist()
    A, B = (np.stack(parts, axis=-1) for parts in zip(*(discretise_lag(lag, STEP) for lag in lags), strict=True))
    positions, velocities = np.empty((STEPS + 1, n)), np.empty((STEPS + 1, n))
    q, v = np.array(actuation.home, dtype=np.float64), np.zeros(n)
    for k in range(STEPS + 1):
        positions[k], velocities[k] = q, v
        u = np.clip(wanted[k], -limit, limit)
        free = q + A[0, 1] * v + B[0] * u
        q = np.clip(free, stops.lower, stops.upper)
        v = np.where(q == free, A[1, 1] * v + B[1] * u, 0.0)
    resolution = np.broadcast_to(actuation.encoder_resolution, n)
    steps = np.where(resolution > 0.0, resolution, 1.0)
    outputs = {
        "joint_position": positions,
        "joint_velocity": velocities,
        **_features(model, positions),
        "encoder_position": np.where(resolution > 0.0, np.round(positions / steps) * steps, positions),
    }
    return ReferenceRun(np.arange(STEPS + 1, dtype=np.float64) * STEP, {COMMAND: wanted}, outputs)


def _features(model: RobotModel, positions: FloatArray) -> dict[str, FloatArray]:
    """Return the features at joint positions (k, n), (k, size) by name."""
    if not isinstance(model, SetupModel):
        return {"ball_position": model.feature(positions), SEEN: np.ones((len(positions), 3))}
    feature, _, seen = model.observe(positions)
    return {FEATURE: feature, SEEN: seen.astype(np.float64)}


def read_table(text: str) -> tuple[list[str], FloatArray]:
    """Return the header and the numbers of a CSV table.

    Raises:
        ValueError: the text has no rows.
    """
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise ValueError(f"a reference table must be CSV: {error}") from error
    if len(rows) < 2:
        raise ValueError("a reference table needs a header and at least one row")
    return rows[0], np.array([[float(cell) for cell in row] for row in rows[1:]])


def table(time: FloatArray, columns: Mapping[str, FloatArray], layout: Layout) -> str:
    """Return values by name, (k, size), as CSV with one column for each scalar."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time", *(scalar for name in columns for scalar in layout.by_name[name].scalar_names())])
    writer.writerows(np.column_stack([time, *columns.values()]).tolist())
    return text.getvalue()
