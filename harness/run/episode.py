"""One run carried out: a row of results and a table of steps."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from servobench.harness.config.registry import engine_of
from servobench.harness.config.robots import OWN_ROBOT
from servobench.harness.config.settings import Settings
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.experiment import Drawn, Experiment, build, draw
from servobench.harness.run.lanes import AllEnded, Ends, ManyBenches, ManyLogs, ManyServos, Together, build_together
from servobench.harness.run.log import StepLog, Steps
from servobench.harness.run.loop import careful, run_loop
from servobench.harness.run.metrics import judge_run
from servobench.harness.run.outcome import final_pose_error, find_outcome, pose_errors
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import ResolvedRun, resolve
from servobench.harness.run.result import COMPLETED, Ending, RunResult, ends_batch, is_defect
from servobench.harness.run.scenario import Scenario
from servobench.plant.contract.checks import FloatArray

ROWS_AT_ONCE = 2**18  # of the logs of runs side by side, half a kilobyte each


def run_experiment(
    request: RunRequest, settings: Settings, *, steps: bool = True, picture: bool = False, keep: Path | None = None
) -> RunResult:
    """Carry one run out; the row's `status` and `reason` name a fault on the way.

    Args:
        request: the run.
        settings: overrides of the defaults.
        steps: also return one row a period.
        picture: also return the last picture of the camera, if there is one.
        keep: results folder in which trained networks are kept beside the runs.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    return carry_out(resolve(request, settings), steps=steps, picture=picture, keep=keep)


def carry_out(
    resolved: ResolvedRun,
    *,
    steps: bool = True,
    picture: bool = False,
    keep: Path | None = None,
    debug: bool = False,
) -> RunResult:
    """Carry out a run whose settings are resolved; arguments and errors as in `run_experiment`.

    With `debug`, an error that is no `RunFault` is raised instead of noted.
    """
    experiment = build(resolved, keep=keep)
    plant, scenario = experiment.plant, experiment.scenario
    log = StepLog(plant.spec, experiment.periods)
    ending = Ending()
    try:
        with careful():
            desired = scenario.reference.sampled(plant.spec.period, experiment.periods + experiment.run.preview_rows)
            pair = held_to_contract(plant, experiment.controller)
            run_loop(*pair, desired, experiment.loop, resolved.request.seed, log)
    except BaseException as error:
        if ends_batch(error) or (debug and is_defect(error)):
            raise
        ending = Ending.of(error)  # a plug-in may raise anything; the batch goes on and the row names it
    finally:
        logged = log.steps()
        image = plant.picture() if picture and len(logged) else None
        plant.close()
    row = _row(experiment.drawn, resolved.request, ending, _numbers(_judge(logged, scenario)), logged)
    table = _table(experiment, resolved.request, logged) if steps else None
    return RunResult(row, table, image, ending.trace)


def _table(experiment: Experiment, request: RunRequest, logged: Steps) -> pd.DataFrame:
    """Return the table of steps, with the true pose error where the sensing set-up is judged by it."""
    table = logged.table(request.run_id, full_jacobian=experiment.run.full_jacobian)
    errors = pose_errors(experiment.drawn.true, experiment.scenario.reference, logged)
    if errors is not None:
        table["pose_error_mm"], table["pose_error_deg"] = errors
    return table


def carry_out_together(runs: Sequence[ResolvedRun], *, keep: Path | None = None) -> list[RunResult]:
    """Carry out runs of one `side_by_side_key` that advance together; the rows are those of `carry_out`, without times.

    Args:
        runs: at least one.
        keep: results folder in which trained networks are kept beside the runs.

    Raises:
        Exception: they cannot be built together, because something is wrong with one of them; each has to be carried
            out by itself, and its row names the error.
    """
    most = max(1, ROWS_AT_ONCE // runs[0].run.periods(draw(runs[0]).scenario.duration))
    parts = (runs[first : first + most] for first in range(0, len(runs), most))
    return [result for part in parts for result in _carry_out_part(part, keep)]


def _carry_out_part(runs: Sequence[ResolvedRun], keep: Path | None) -> list[RunResult]:
    """Carry out runs whose logs fit into memory side by side."""
    many = build_together(runs, keep=keep)
    ends = Ends(len(runs))
    log = ManyLogs(many.bench.spec, many.loop.periods, ends)
    try:
        with careful(), contextlib.suppress(AllEnded):
            plant, controller = ManyBenches(many.bench, ends), ManyServos(many.servo, ends)
            run_loop(plant, controller, many.desired, many.loop, [run.request.seed for run in runs], log)
    finally:
        many.bench.close()
    return _judge_together(runs, many, ends, log.steps())


def _judge_together(runs: Sequence[ResolvedRun], many: Together, ends: Ends, logged: Steps) -> list[RunResult]:
    task = many.drawn[0].scenario
    metrics = _judge(logged, task) if len(ends.running) else {}
    columns = {name: values.tolist() for name, values in metrics.items()}
    results = []
    for lane, (run, drawn) in enumerate(zip(runs, many.drawn, strict=True)):
        if lane in ends.faults:
            own = logged.run(lane, ends.rows[lane])
            ending, values = Ending.of(ends.faults[lane]), _numbers(_judge(own, task))
        else:
            own = logged.run(lane, len(logged))
            ending, values = Ending(), {name: column[lane] for name, column in columns.items()}
        results.append(RunResult(_row(drawn, run.request, ending, values, own), None, trace=ending.trace))
    return results


def _judge(logged: Steps, task: Scenario) -> dict[str, FloatArray]:
    """Return the metrics of a run or of runs side by side; none without rows."""
    return judge_run(logged, task.kind, task.evaluate_from, task.lap_time) if len(logged) else {}


def _numbers(metrics: dict[str, FloatArray]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}


def _row(drawn: Drawn, request: RunRequest, ending: Ending, metrics: dict[str, float], logged: Steps) -> dict[str, Any]:
    spec, status = logged.spec, ending.status
    outcome = _outcome(drawn, metrics, logged) if status == COMPLETED else status
    return {
        **identity(request),
        "robot": OWN_ROBOT if drawn.true is None else request.robot,
        "task_kind": drawn.scenario.kind,
        "feature_unit": spec.feature_unit,
        "settling_band": spec.feature.band,
        "status": status,
        "outcome": outcome,
        **metrics,
        **_pose_metrics(drawn, logged),
        "periods": len(logged),
        "reason": ending.reason,
        "mismatch_values": json.dumps(drawn.as_record()),
    }


def identity(request: RunRequest) -> dict[str, Any]:
    """Return the columns that are known of a run before it is carried out."""
    return {**request.as_row(), "engine": engine_of(request.plant)}


def _pose_metrics(drawn: Drawn, logged: Steps) -> dict[str, float]:
    """Return the true pose error at the end of a run, where the sensing set-up is judged by it."""
    errors = pose_errors(drawn.true, drawn.scenario.reference, logged) if len(logged) else None
    return {} if errors is None else final_pose_error(*errors, logged.spec.period)


def _outcome(drawn: Drawn, metrics: dict[str, float], logged: Steps) -> str:
    times = metrics["settling_time_s"], metrics["rms_error_evaluated"]
    return find_outcome(logged, drawn.scenario, *times, drawn.final)
