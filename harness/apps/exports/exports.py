"""Export of the steps of runs: as CSV, and as bags of ROS 2 for Foxglove, rerun and other readers of MCAP."""

import shutil
from functools import partial
from pathlib import Path

import pandas as pd

from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.installation import check_installed
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, write_atomically, write_csv, writing_together

CSV, MCAP = "csv", "mcap"
FORMATS = (CSV, MCAP)
LAYOUT = "foxglove_layout.json"


def export_folder(
    folder: ResultsFolder, out: Path, kind: str, runs: pd.DataFrame | None = None
) -> list[Path]:
    """Write the steps of runs of a results folder into a file each.

    Args:
        folder: a results folder.
        out: new folder for the files; CSV also has the table of runs, `runs.csv`, and bags a layout of Foxglove.
        kind: of `FORMATS`.
        runs: rows of the table of runs; None for all.

    Returns:
        The files.

    Raises:
        ConfigurationError: an unknown format, no steps, a folder that exists already, or the extra `bag` is missing.
    """
    if kind not in FORMATS:
        raise ConfigurationError(f"format must be one of {', '.join(FORMATS)}, got {kind!r}")
    if kind == MCAP:
        check_installed(("rosbags", "mcap_ros2"), "the format mcap")
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
    """Write the steps of `runs`, and what goes with them, into a new folder and return the files."""
    if kind == CSV:
        files = [out / "runs.csv"]
        write_csv(runs, files[0])
    else:
        from servobench.harness.apps.exports import bag  # noqa: PLC0415 - of the extra bag

        files = [out / LAYOUT]
        shutil.copy(Path(__file__).with_name(LAYOUT), out)
    for row in runs.to_dict("records"):
        if row.get("periods", 1) > 0:
            steps = folder.steps([row["run_id"]])
            files.append(out / f"{row['run_id']}.{kind}")
            if kind == CSV:
                write_csv(steps, files[-1])
            else:
                write_atomically(files[-1], partial(bag.write_bag, steps=steps, run=row))
    return files
