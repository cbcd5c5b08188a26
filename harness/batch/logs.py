"""A logged run as another controller can see it: a run of a results folder, or a table of one's own."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from servobench.harness.batch.results import Manifest, ResultsFolder
from servobench.harness.config.description import plain, restored
from servobench.harness.config.registry import FILES
from servobench.harness.config.settings import Settings, flatten, nest
from servobench.harness.run.request import OWN_ROBOT, RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun, resolve, resolve_sections
from servobench.harness.run.variations import Row, varied_in_row
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import TIME, numbers_of, read_table, user_path
from servobench.plant.contract.settings import remark, suggest
from servobench.plant.robot.mismatch import Mismatch

TABLES = (".csv", ".parquet")  # suffixes
MAX_PERIOD = 2.0  # [s] between rows of a log
USUAL_PERIODS = (9e-4, 0.9)  # [s] likewise
FIT_MARGIN = 1.5  # [1] times the tolerance, as the fitted steps of a short log are off themselves
PER_SECOND = {"ms": 1e3, "µs": 1e6, "ns": 1e9}  # counts of a clock
TIME_TOLERANCE = 1e-3  # [s] by which logged instants may be off, as of stamps in whole ms
PLANT = "kinematic"  # for sizes and units of a log whose plant is not known
# In names of plants, controllers and set-ups
CODE = re.compile(rf"^({'|'.join(FILES)})|\.(?i:py)(:|$)")
TASK = "circle"  # likewise, without effect
RENAMED = {  # counts of control periods up to 0.2.0 -> times
    f"initial.{word}_periods": f"initial.{word}_time" for word in ("probe", "settle", "average")
}

# Settings up to 0.2.0 without which runs are as with these values
RETIRED = {
    "solver": "daqp",
    "law.solver": "daqp",
    "estimator.form": "split",
    "training.jacobian.placement": "halton",
    "training.controller.placement": "halton",
}


class UnevenRows(ConfigurationError):
    """Rows of a log that are missing, doubled or out of order."""


def find_run(folder: ResultsFolder, run_id: str | None) -> dict[str, Any]:
    """Return the row of a run of a results folder; without a name the only one.

    Raises:
        ConfigurationError: not a results folder with steps, no such run, or several without a name.
    """
    runs = folder.runs()
    folder.check_steps()
    names = runs["run_id"].tolist()
    if run_id is None and len(names) > 1:
        raise ConfigurationError(
            f"{folder.path} holds {len(names)} runs; name one with --run, such as {names[0]}"
        )
    chosen = run_id or names[0]
    if chosen not in names:
        raise ConfigurationError(
            f"{folder.path} has no run {chosen!r}: {suggest(chosen, names[:20])}"
        )
    return {str(name): value for name, value in runs[runs["run_id"] == chosen].iloc[0].items()}


def logged_in_folder(
    folder: ResultsFolder, run_id: str | None, controller: str | None, sensing: str = ""
) -> tuple[ResolvedRun, pd.DataFrame]:
    """Return a run of a results folder and its steps.

    Args:
        folder: of results, with steps.
        run_id: of the run; None for the only one.
        controller: that is to see it, with its default settings; None for the one of the run, with those of the run.
        sensing: set-up that the user names, which may be a file of code.

    Raises:
        ConfigurationError: no such run, one without steps, one whose row names code that the user did not name, or one
            that cannot be made ready here.
    """
    row = find_run(folder, run_id)
    if row["task"] in folder.manifest.get("own_tasks", {}) or _place_of_files(folder):
        row["task"] = TASK  # as the reference is logged, no code and no file is needed for it
    run = run_in_folder(folder, row, controller, {"sensing": sensing})
    steps = folder.steps([row["run_id"]])
    if steps.empty:
        raise ConfigurationError(
            f"run {row['run_id']} has no steps: it ended before its first period"
        )
    return run, steps


def run_in_folder(
    folder: ResultsFolder, row: Row, controller: str | None, named: Mapping[str, str] | None = None
) -> ResolvedRun:
    """Return a run of a results folder.

    Args:
        folder: of results.
        row: of the run in the table of runs.
        controller: as above.
        named: names that the user gives, by `controller` or `sensing`, which may be those of code.

    Raises:
        ConfigurationError: its row names code that the user did not name, or it cannot be made ready here.
    """
    manifest = folder.manifest
    known = named or {}
    for word in ("plant", "task", "sensing", *([] if controller else ["controller"])):
        name = str(row.get(word, ""))
        # Code of users may have any name.
        place = manifest.get(f"own_{word}s", {}).get(name, {}).get("place")
        if name != known.get(word) and (place or CODE.search(name)):
            remedy = (
                "nothing that a folder names is run"
                if word in ("plant", "task")
                else f"name it by --{word} if you trust it"
            )
            raise ConfigurationError(
                f"{folder.path} names code that would be run, {word} {place or name}; {remedy}"
            )
    names = ("plant", "task", "mismatch", "robot", "sensing")
    own = row.get("robot") == OWN_ROBOT  # which comes with the plant
    asked = {name: row[name] for name in names if name in row and not (own and name == "robot")}
    with configuration_errors(f"{folder.path} has a varied setting that is no value: "):
        varied = varied_in_row(row)
    if controller:
        varied = tuple((key, value) for key, value in varied if not key.startswith("controller."))
    request = RunRequest(
        controller=controller or row["controller"], seed=int(row["seed"]), varied=varied, **asked
    )
    with configuration_errors(_place_of_files(folder)):
        return resolve(request, _settings_of(request, manifest, own=not controller))


def _place_of_files(folder: ResultsFolder) -> str:
    """Return the beginning of an error where a folder names a file from elsewhere; empty where all are there."""
    for name in folder.manifest.get("files", {}):
        if not user_path(name).is_file():
            return f"{folder.path} was made where {name} is; run this there: "
    return ""


def _settings_of(request: RunRequest, manifest: Manifest, *, own: bool) -> Settings:
    """Return the settings with which a run was made, of its controller if that is its `own`.

    Those of the plant are the ones that the run did not have by default or by its mismatch.
    """
    told, changed, name = (
        manifest.get("configuration", {}),
        manifest.get("changed") or {},
        request.plant,
    )
    read = ["run", name, request.task, *([request.controller] if own else [])]
    common = told.get("run", {}).get("period", RunSettings.period)
    period = dict(request.varied).get("run.period", common)
    flat = {each: restored(told.get(each, {})) for each in read}
    for values in flat.values():
        for old in [name for name, usual in RETIRED.items() if values.get(name) == usual]:
            del values[old]
        for old in RENAMED.keys() & values.keys():
            values[RENAMED[old]] = period * values.pop(old)
    usual = plain(flatten(resolve_sections([request], Settings({"run": {"period": common}}))[name]))
    flat[name] = {
        key: value
        for key, value in flat[name].items()
        if (told[name][key] != usual.get(key) or f"{name}.{key}" in changed)
        and key not in request.mismatch.plant_settings
    }
    return Settings({each: nest(values) for each, values in flat.items()})


def logged_in_file(
    path: Path, controller: str, robot: str, sensing: str
) -> tuple[ResolvedRun, pd.DataFrame]:
    """Return a log of one's own, of which robot and sensing are known, and a run of a controller on them.

    Args:
        path: CSV or Parquet, a row a control period, with columns as `steps.parquet` has them.
        controller: that is to see it.
        robot: by name or file.
        sensing: set-up or file.

    Raises:
        ConfigurationError: a file that cannot be read, or a name that cannot be used.
    """
    if path.suffix.lower() not in TABLES:
        raise ConfigurationError(
            f"{path} must be a results folder, or a table in {' or '.join(TABLES)}"
        )
    table = read_table("log", path)
    request = RunRequest(PLANT, controller, TASK, Mismatch(), 0, robot=robot, sensing=sensing)
    # Which any period divides
    settings = {"run": {"period": _period(path, table)}, PLANT: {"command_delay": 0.0}}
    return resolve(request, Settings(settings)), table


def _period(path: Path, table: pd.DataFrame) -> float:
    """Return the control period [s] of a log, the mean distance of its rows; refuse rows at other distances."""
    times = numbers_of(f"log {path}", table, [TIME])[:, 0]
    steps = np.diff(times)
    gaps = np.diff(np.sort(times))
    usual = float(np.median(gaps[gaps > 0.0])) if gaps.any() else 0.0
    if not 0.0 < usual <= MAX_PERIOD:
        units = [
            f"{unit}: divide it by {count:g}"
            for unit, count in PER_SECOND.items()
            if 1e-3 <= usual / count < 1.0
        ]
        raise ConfigurationError(
            f"log {path} has {len(times)} rows, {usual:g} s apart; it needs two or more, and time_s in s, not in "
            f"{next(iter(units), 'ms')}"
        )
    if not USUAL_PERIODS[0] < usual < USUAL_PERIODS[1]:
        remark(
            f"rows of {path.name} are {usual:.3g} s apart: time_s is in s, no count of rows or minutes"
        )
    mean = float(np.mean(steps))
    tolerance = min(TIME_TOLERANCE, usual / 8.0)
    late = np.abs(times - times[0] - mean * np.arange(len(times))) > tolerance
    rounding = 0.1 * tolerance
    if late.any() or (np.abs(steps - usual) > 2.0 * tolerance).any():
        mean = _fitted_period(path, times, tolerance)
        rounding = tolerance
    digits = (round(mean, count) for count in range(3, 12))
    return next((each for each in digits if abs(each - mean) * len(steps) < rounding), mean)


def _fitted_period(path: Path, times: FloatArray, tolerance: float) -> float:
    """Return the period [s] of a clock whose stamps are off by a `tolerance` [s] at most; else say how."""
    steps, rows = np.diff(times), np.arange(len(times))
    usual = float(np.median(times[2:] - times[:-2])) / 2.0
    period, begin = np.polyfit(rows, times - times[0], 1).tolist()
    off = np.abs(times - times[0] - begin - period * rows)
    if steps.min() > 0.0 and off.max() <= FIT_MARGIN * tolerance:
        return float(period)
    row = int(np.argmax(off))
    found = f"and stamps are up to {1e3 * off.max():.2g} ms off equal steps of {period:.4g} s"
    remedy = f"if the rows are equally spaced, write {period:.4g} s times the row as time_s, else resample the log"
    if steps.min() <= 0.0:
        row = int(np.argmax(steps <= 0.0)) + 1
        found = f"and rows must be the control period of {usual:.4g} s apart"
        remedy = "sort them, or leave out doubled ones"
    elif steps.max() > 1.5 * usual:
        row = int(np.argmax(steps > 1.5 * usual)) + 1
        periods = round(steps[row - 1] / usual)
        found = f"which is {periods} control periods of {usual:.4g} s, so that rows are lost"
        remedy = "add them with feature_valid = 0 and joints in between, or resample the log at equal steps"
    raise UnevenRows(
        f"log {path}: row {row} is {steps[max(row, 1) - 1]:.4g} s after the row before, {found}: {remedy}"
    )
