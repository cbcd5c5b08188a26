"""A controller beside a logged run: its commands for the observations of each instant, and its one-step predictions.

The loop is open. Joint positions and features are those of the log, independent of the commands, so nothing here
predicts a run under these commands; only the answers to the same observations are compared.
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from servobench.harness.apps.twin.drive import command_mistake
from servobench.harness.apps.twin.log_units import check_units
from servobench.harness.apps.twin.logged_plant import LoggedPlant
from servobench.harness.apps.twin.predictions import PREDICTED, check_delay, predicted
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.experiment import build
from servobench.harness.run.log import StepLog
from servobench.harness.run.loop import careful, run_loop
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.contract.faults import ConfigurationError, RunFault
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import COMMAND, column_names

LOGGED = "logged_"  # before the name of a column of commands in the log


def shadow(resolved: ResolvedRun, table: pd.DataFrame) -> pd.DataFrame:
    """Step a controller through a logged run.

    Args:
        resolved: the run that was logged, with the controller that is to see it. After the last row the reference goes
            on as its task has it; it stays where it is if the log's reference is another one.
        table: a row a control period; see `LoggedPlant`. Where commands were logged, they are kept for comparison.

    Returns:
        The table of steps with the controller's commands, those of the log under names that begin with `LOGGED`, and
        the features that its Jacobian predicts under names that begin with `PREDICTED`.

    Raises:
        ConfigurationError: settings or a log that cannot be used, or the controller failed.
    """
    experiment = build(resolved)
    request = resolved.request
    spec = experiment.plant.spec
    try:
        plant = LoggedPlant(spec, table)
        check_units(plant.log, plant.reference, experiment.drawn.true)
        log = StepLog(spec, len(table))
        loop = replace(
            experiment.loop,
            periods=len(table),
            lost_after_periods=len(table) + 1,
            camera_move=None,  # whose images are logged
        )
        desired = experiment.desired(loop.periods)
        logged = plant.reference
        if not np.array_equal(desired[: len(logged)], logged):
            desired = np.concatenate([logged, np.repeat(logged[-1:], loop.preview, axis=0)])
        with careful():
            pair = held_to_contract(plant, experiment.controller)
            run_loop(*pair, desired, loop, request.seed, log)
    except RunFault as fault:
        row = len(log.steps())
        raise ConfigurationError(
            f"controller {request.controller} fails in row {row} of the log: {fault}"
        ) from fault
    finally:
        experiment.plant.close()
    rows = log.steps()
    steps = rows.table(request.run_id)
    ahead = predicted(rows)
    if not np.isnan(ahead).all():
        features = column_names(spec)["feature"]
        steps[[PREDICTED + name for name in features]] = ahead
        check_delay(rows, ahead)
    commands = plant.log.commands
    if commands is not None:
        steps[[LOGGED + name for name in column_names(spec)[COMMAND]]] = commands
        mistake = command_mistake(plant.log)
        if mistake:
            remark(mistake)
    return steps


def differences(steps: pd.DataFrame) -> pd.DataFrame:
    """Return how far the commands of a table of `shadow` are from those of its log.

    Returns:
        A row a command: RMS of the logged one, RMS and largest of the difference, in the unit that its name ends with.
        Empty where no commands were logged.
    """
    logged = [name for name in map(str, steps) if name.startswith(LOGGED)]
    if not logged:
        return pd.DataFrame()
    names = [name.removeprefix(LOGGED) for name in logged]
    u_logged = steps[logged].to_numpy()
    difference = steps[names].to_numpy() - u_logged
    return pd.DataFrame(
        {
            "command": [name.removeprefix(f"{COMMAND}_") for name in names],
            "logged, RMS": np.sqrt(np.mean(u_logged**2, axis=0)),
            "difference, RMS": np.sqrt(np.mean(difference**2, axis=0)),
            "difference, largest": np.abs(difference).max(axis=0),
        }
    )
