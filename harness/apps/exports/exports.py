"""Export of the steps of runs: as CSV, and as MCAP for Foxglove and other readers."""

import json
import math
from collections.abc import Hashable, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.installation import check_installed
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, write_atomically, write_csv, writing_together

CSV, MCAP = "csv", "mcap"
FORMATS: Final = (CSV, MCAP)
NANOSECONDS: Final = 1e9  # in a second
TOPICS: Final = (
    "reference",
    "feature",
    "true_feature",
    "joint_position",
    "joint_velocity_command",
    "diagnostic",
)
KEYS: Final = ("run_id", "step", "time_s")  # columns that say where a row belongs


def export_folder(
    folder: ResultsFolder, out: Path, kind: str, runs: pd.DataFrame | None = None
) -> list[Path]:
    """Write the steps of runs of a results folder into a file each.

    Args:
        folder: a results folder.
        out: new folder for the files; CSV also has the table of runs, `runs.csv`.
        kind: of `FORMATS`.
        runs: rows of the table of runs; None for all.

    Returns:
        The files.

    Raises:
        ConfigurationError: an unknown format, no steps, a folder that exists already, or the extra `mcap` is missing.
    """
    if kind not in FORMATS:
        raise ConfigurationError(f"format must be one of {', '.join(FORMATS)}, got {kind!r}")
    if kind == MCAP:
        check_installed((MCAP,), "the format mcap")
    if runs is None:
        runs = folder.runs()
    folder.check_steps()
    with accessing(out):
        if out.exists():
            raise ConfigurationError(f"{out} exists already; name a new folder")
        with writing_together(out) as partial:
            files = _write_runs(folder, runs, partial, kind)
    return [out / path.name for path in files]


def _write_runs(folder: ResultsFolder, runs: pd.DataFrame, out: Path, kind: str) -> list[Path]:
    """Write the steps of `runs`, and for CSV their table, into a new folder and return the files."""
    files = [out / "runs.csv"] if kind == CSV else []
    if kind == CSV:
        write_csv(runs, files[0])
    for row in runs.to_dict("records"):
        if row.get("periods", 1) > 0:
            steps = folder.steps([row["run_id"]])
            files.append(out / f"{row['run_id']}.{kind}")
            if kind == CSV:
                write_csv(steps, files[-1])
            else:
                write_atomically(files[-1], partial(write_mcap, steps=steps, run=row))
    return files


def write_mcap(path: Path, steps: pd.DataFrame, run: Mapping[Hashable, Any]) -> None:
    """Write one run as an MCAP file: a topic for each group of columns, a JSON message a period, time from 0.

    Its messages are none of ROS, so that a reader of bags of ROS 2, such as rosbags, refuses the file.

    Args:
        path: the file.
        steps: the run's table of steps.
        run: its row in the table of runs, which becomes the metadata `run`.
    """
    from mcap.writer import Writer  # noqa: PLC0415 - of the extra mcap

    topics = _topics(steps)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library=f"servobench {version('servobench')}")
        writer.add_metadata("run", {str(name): str(value) for name, value in run.items()})
        channels = {}
        for topic, columns in topics.items():
            kinds = {name: {"type": ["number", "boolean", "null"]} for name in columns.values()}
            properties = {"time_s": {"type": "number"}} | kinds
            data = json.dumps({"title": topic, "type": "object", "properties": properties}).encode()
            schema = writer.register_schema(f"servobench.{topic}", "jsonschema", data)
            channels[topic] = writer.register_channel(f"/{topic}", "json", schema)
        for k, row in enumerate(steps.to_dict("records")):
            time = round(row["time_s"] * NANOSECONDS)
            for topic, columns in topics.items():
                message = {"time_s": row["time_s"]} | {
                    name: _plain(row[column]) for column, name in columns.items()
                }
                data = json.dumps(message, allow_nan=False).encode()
                writer.add_message(
                    channels[topic], log_time=time, data=data, publish_time=time, sequence=k
                )
        writer.finish()  # type: ignore[no-untyped-call]


def _topics(steps: pd.DataFrame) -> dict[str, dict[str, str]]:
    """Return the columns of each topic with their names there; those that begin with no topic are in `run`."""
    grouped: dict[str, dict[str, str]] = {topic: {} for topic in (*TOPICS, "run")}
    for column in map(str, steps.columns):
        if column not in KEYS:
            begun = (
                topic
                for topic in TOPICS
                if column.startswith(f"{topic}_") and column != "feature_valid"
            )
            topic = next(begun, "run")
            grouped[topic][column] = column.removeprefix(f"{topic}_")
    return {topic: names for topic, names in grouped.items() if names}


def _plain(value: Any) -> Any:  # noqa: ANN401 - a cell of a table
    """Return a cell for JSON; None where it is not finite."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    number = math.nan if value is None else float(value)
    if math.isfinite(number):
        return number
    return None
