"""One run carried out: a row of results and a table of steps."""

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from servobench.controllers.controller import Controller
from servobench.controllers.servo import ServoController
from servobench.harness.config.registry import engine_of
from servobench.harness.config.settings import Settings
from servobench.harness.config.source import same_folder
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.experiment import Experiment, build, build_together, naming_the_lack
from servobench.harness.run.knowledge import keep_networks
from servobench.harness.run.lanes import AllEnded, Ends, ManyBenches, ManyLogs, ManyServos
from servobench.harness.run.log import StepLog, Steps
from servobench.harness.run.loop import careful, run_loop
from servobench.harness.run.metrics import final_rows, judge_run
from servobench.harness.run.outcome import find_outcome, pose_errors
from servobench.harness.run.own_metrics import OwnMetric, values_of
from servobench.harness.run.request import OWN_ROBOT, RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun, resolve
from servobench.harness.run.result import COMPLETED, INSTANT, Ending, RunResult, ends_batch
from servobench.harness.run.sampling import Drawn, draw_once
from servobench.harness.run.variations import Row
from servobench.plant.bench.bench import Bench
from servobench.plant.contract.checks import NamedArrays
from servobench.plant.contract.faults import RunFault

ROWS_AT_ONCE = 2**18  # rows in the logs of runs side by side, half a kilobyte each


def run_experiment(request: RunRequest, settings: Settings, *, steps: bool = True) -> RunResult:
    """Carry one run out, with overrides of the defaults; see `carry_out`."""
    return carry_out(resolve(request, settings), steps=steps)


def carry_out(
    resolved: ResolvedRun,
    *,
    steps: bool = True,
    picture: bool = False,
    keep: Path | None = None,
    debug: bool = False,
    metrics: Sequence[OwnMetric] = (),
) -> RunResult:
    """Carry one run out; the row's `status` and `reason` name a fault on the way.

    Args:
        resolved: the run.
        steps: also return one row a period.
        picture: also return the last picture of the camera, if there is one.
        keep: results folder in which trained networks are kept beside the runs.
        debug: raise an error that is no `RunFault` instead of noting it.
        metrics: of users, that are columns of the row, too; one that fails says so in its `reason`.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    INSTANT.value = -math.inf
    experiment = build(resolved)
    log = StepLog(experiment.plant.spec, experiment.periods)
    ending = Ending()
    with same_folder(), contextlib.closing(experiment.plant) as plant, careful():
        try:
            pair = held_to_contract(plant, chosen_controller(resolved, experiment))
            with naming_the_lack(plant, own_robot=experiment.drawn.true is None):
                run_loop(*pair, experiment.desired(), experiment.loop, resolved.request.seed, log)
        except BaseException as error:
            if ends_batch(error) or (debug and not isinstance(error, RunFault)):
                raise
            # A plug-in may raise anything; the batch goes on and the row names it
            ending = Ending.of(error)
        logged = log.steps()
        image = plant.picture() if picture and len(logged) else None
    if keep is not None:
        keep_networks(experiment.networks, keep)
    pose = pose_errors(experiment.drawn.true, experiment.scenario.reference, logged)
    row = _row(experiment.drawn, resolved, ending, _judge(logged, experiment), logged, pose)
    if steps or metrics:
        full = experiment.run.full_jacobian
        table = logged.table(row["run_id"], full_jacobian=full).assign(**pose)
        values, fault = values_of(metrics, table, debug=debug)
        row |= {**values, "reason": row["reason"] or fault}
    if not steps:
        return RunResult(row, None, image, ending.trace)
    return RunResult(row, table, image, ending.trace)


def chosen_controller(run: ResolvedRun, experiment: Experiment) -> Controller:
    """Return the controller of a run, or of runs side by side; it is in C where the run asks for it."""
    if not run.run.compiled:
        return experiment.controller
    from servobench.harness.run.compiled import chosen  # noqa: PLC0415 - numpy does without

    return chosen(run, experiment)


def carry_out_together(runs: Sequence[ResolvedRun], *, keep: Path | None = None) -> list[RunResult]:
    """Carry out runs of one `side_by_side_key` that advance together; the rows are those of `carry_out`, without times.

    Args:
        runs: at least one.
        keep: results folder in which trained networks are kept beside the runs.

    Raises:
        Exception: they cannot be built together, because something is wrong with one of them; each has to be carried
            out by itself, and its row names the error.
    """
    most = max(1, ROWS_AT_ONCE // runs[0].run.periods(draw_once(runs[0]).scenario.duration))
    parts = (runs[first : first + most] for first in range(0, len(runs), most))
    return [result for part in parts for result in _carry_out_part(part, keep)]


def _carry_out_part(runs: Sequence[ResolvedRun], keep: Path | None) -> list[RunResult]:
    """Carry out runs whose logs fit into memory side by side."""
    many, ends = build_together(runs), Ends(len(runs))
    bench, log = cast(Bench, many.plant), ManyLogs(many.plant.spec, many.periods, ends)
    try:
        with same_folder(), careful(), contextlib.suppress(AllEnded):
            controller = cast(ServoController, chosen_controller(runs[0], many))
            servo = ManyServos(controller.servo, ends)
            seeds = [each.request.seed for each in runs]
            run_loop(ManyBenches(bench, ends), servo, many.desired(), many.loop, seeds, log)
    finally:
        bench.close()
    if keep is not None:
        keep_networks(many.networks, keep)
    return _judge_together(runs, many, ends, log.steps())


def _judge_together(
    runs: Sequence[ResolvedRun], many: Experiment, ends: Ends, logged: Steps
) -> list[RunResult]:
    metrics = _judge(logged, many) if len(ends.running) else {}
    columns = {name: values.tolist() for name, values in metrics.items()}
    results = []
    for lane, (run, drawn) in enumerate(zip(runs, many.runs, strict=True)):
        own = logged.first(ends.rows.get(lane, len(logged)), lane)
        if lane in ends.faults:
            ending = Ending.of(ends.faults[lane])
            values = _judge(own, many)
        else:
            ending = Ending()
            values = {name: column[lane] for name, column in columns.items()}
        pose = pose_errors(drawn.true, drawn.scenario.reference, own)
        row = _row(drawn, run, ending, values, own, pose)
        results.append(RunResult(row, None, trace=ending.trace))
    return results


def _judge(logged: Steps, experiment: Experiment) -> NamedArrays:
    """Return the metrics of a run or of runs side by side; none without rows."""
    task = experiment.scenario
    if len(logged):
        return judge_run(logged, task.kind, task.evaluate_from, task.lap_time, task.moves)
    return {}


def _row(
    drawn: Drawn,
    run: ResolvedRun,
    ending: Ending,
    metrics: Mapping[str, npt.ArrayLike],
    logged: Steps,
    pose: NamedArrays,
) -> dict[str, Any]:
    """Return the row of a run in the table of runs."""
    spec = logged.spec
    outcome = ending.status
    numbers = {name: float(np.asarray(value)) for name, value in metrics.items()}
    if ending.status == COMPLETED:
        outcome = find_outcome(
            logged,
            drawn.scenario,
            numbers["settling_time_s"],
            numbers["rms_error_evaluated"],
            drawn.final,
        )
    final = final_rows(spec.period)
    final_pose = {name: float(values[final].mean()) for name, values in pose.items() if len(values)}
    return {
        **identity(run),
        "robot": OWN_ROBOT if drawn.true is None else run.request.robot,
        "task_kind": drawn.scenario.kind,
        "feature_unit": spec.feature_unit,
        "settling_band": spec.feature.band,
        "status": ending.status,
        "outcome": outcome,
        **numbers,
        **final_pose,
        "periods": len(logged),
        "reason": ending.reason,
        "mismatch_values": json.dumps(drawn.as_record()),
    }


def identity(run: ResolvedRun) -> Row:
    """Return the columns that are known of a run before it is carried out."""
    return {**wanted_columns(run), "engine": engine_of(run.request.plant)}


def wanted_columns(run: ResolvedRun) -> Row:
    """Return the columns by which a run is found, with an unusual period."""
    row = run.request.as_row()
    if run.run.period != RunSettings.period:
        row["period_s"] = run.run.period
    return row
