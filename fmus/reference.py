"""The reference run inside every exported FMU: random commands, and the outputs that numpy computes for them."""

import csv
import io

import numpy as np

from servobench.fmus.variables import BALL, FEATURE, INPUT, SEEN, Layout
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray, NamedArrays
from servobench.plant.contract.seeds import named_generator
from servobench.plant.kinematic import KinematicConfig, KinematicWorld

STEPS = 200
INPUT_FILE = "extra/servobench/reference_input.csv"
OUTPUT_FILE = "extra/servobench/reference_output.csv"
COMMAND = "joint_velocity_command"


def tables(run: NamedArrays, layout: Layout) -> tuple[str, str]:
    """Return the inputs and all other variables of a run as CSV.

    Args:
        run: `time` in s, (k,), and variables by name, (k, size); each input is held over the step that begins then.
        layout: of the variables.
    """
    time = run["time"]
    inputs = {}
    others = {}
    for name, rows in run.items():
        if name == "time":
            continue
        if layout.by_name[name].role == INPUT:
            inputs[name] = rows
        else:
            others[name] = rows
    return table(time, inputs, layout), table(time, others, layout)


def reference_run(setup: PlantSetup, config: KinematicConfig) -> NamedArrays:
    """Return the reference run of the kinematic plant; some of its commands exceed the speed limit."""
    world = KinematicWorld(config, setup)
    limit = world.spec.command.upper
    generator = named_generator(0, "fmu_reference")
    wanted = generator.uniform(-1.2 * limit, 1.2 * limit, (STEPS + 1, world.spec.n))
    rows = []
    for command in np.clip(wanted, -limit, limit):
        state = world.save()
        feature = world.see()
        visible = world.visible()
        seen = np.ones_like(feature) if visible is None else visible.astype(np.float64)
        rows.append((state.q, state.v, feature, seen, state.q))
        world.advance(command)
    measured = FEATURE if isinstance(setup.model, SetupModel) else BALL
    names = ("joint_position", "joint_velocity", measured, SEEN, "encoder_position")
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    outputs = dict(zip(names, columns, strict=True))
    return {
        "time": np.arange(STEPS + 1, dtype=np.float64) * setup.period,
        COMMAND: wanted,
        **outputs,
    }


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


def table(time: FloatArray, columns: NamedArrays, layout: Layout) -> str:
    """Return values by name, (k, size), as CSV with one column for each scalar."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    header = ["time"]
    for name in columns:
        header += layout.by_name[name].scalar_names()
    writer.writerow(header)
    writer.writerows(np.column_stack([time, *columns.values()]).tolist())
    return text.getvalue()
