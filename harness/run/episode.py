"""One run carried out: a row of results and a table of steps."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.log import StepLog
from servobench.harness.run.loop import run_loop
from servobench.harness.run.metrics import SETTLING_BAND, judge_run
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolved import ResolvedRun, resolve
from servobench.harness.run.threads import one_thread
from servobench.plant.faults import RunFault
from servobench.plant.plant import ImageArray

COMPLETED = "completed"
NUMERICAL_ERROR = "numerical_error"
CRASHED = "crashed"
TIMED_OUT = "timed_out"  # given by the driver of a batch, which has the time limit
STATUSES = (COMPLETED, NUMERICAL_ERROR, CRASHED, TIMED_OUT)  # besides those of the kinds of `RunFault`


@dataclass(frozen=True)
class RunResult:
    """What a run gives back.

    Attributes:
        row: the run's row in the table of runs.
        steps: one row a period; None where it was not asked for.
        picture: what the camera saw last; None without a camera or where it was not asked for.
    """

    row: dict[str, Any]
    steps: pd.DataFrame | None
    picture: ImageArray | None = field(default=None, repr=False)


def run_experiment(
    request: RunRequest, settings: Settings, *, steps: bool = True, picture: bool = False, keep: Path | None = None
) -> RunResult:
    """Carry one run out; the row's `status` and `reason` name a fault on the way.

    Args:
        request: what to run.
        settings: overrides of the defaults.
        steps: also return one row a period.
        picture: also return what the camera saw last, where there is one.
        keep: results folder in which trained networks are kept beside the runs.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    return carry_out(resolve(request, settings), steps=steps, picture=picture, keep=keep)


def carry_out(
    resolved: ResolvedRun, *, steps: bool = True, picture: bool = False, keep: Path | None = None
) -> RunResult:
    """Carry out a run whose settings are resolved; arguments and errors as in `run_experiment`."""
    request, experiment = resolved.request, build(resolved, keep=keep)
    plant, scenario = experiment.plant, experiment.scenario
    log = StepLog(plant.spec, experiment.periods)
    status, reason = COMPLETED, ""
    try:
        with one_thread(), np.errstate(divide="raise", over="raise", invalid="raise"):
            run_loop(plant, experiment.controller, scenario.reference, experiment.loop, request.seed, log)
    except RunFault as fault:
        status, reason = fault.status, _one_line(fault)
    except FloatingPointError as error:
        status, reason = NUMERICAL_ERROR, _one_line(error)
    except Exception as error:  # noqa: BLE001 - a plug-in may raise anything; the batch goes on and the row says what
        status, reason = CRASHED, describe_error(error)
    finally:
        logged = log.steps()
        image = plant.picture() if picture and len(logged) else None
        plant.close()
    metrics = {}
    if len(logged):
        metrics = judge_run(logged, scenario.kind, scenario.evaluate_from)
    row: dict[str, Any] = {
        **request.as_row(),
        "task_kind": scenario.kind,
        "feature_unit": plant.spec.feature_unit,
        "settling_band": SETTLING_BAND * plant.spec.feature.scale,
        "status": status,
        **metrics,
        "periods": len(logged),
        "reason": reason,
        "mismatch_values": json.dumps(experiment.sample.as_record() if experiment.sample else {}),
    }
    table = logged.table(request.run_id, full_jacobian=experiment.run.full_jacobian) if steps else None
    return RunResult(row, table, image)


def failed_row(request: RunRequest, status: str, reason: str) -> dict[str, Any]:
    """Return the row of a run of which nothing is left but why it failed."""
    return {**request.as_row(), "status": status, "periods": 0, "reason": reason, "mismatch_values": "{}"}


def describe_error(error: BaseException) -> str:
    """Return the kind and the message of an error as one line."""
    return f"{type(error).__name__}: {_one_line(error)}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
