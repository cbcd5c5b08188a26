"""Metrics of users, computed of the steps of a finished folder in an isolated process."""

import math

from servobench.harness.batch import trials
from servobench.harness.batch.isolation import Tell
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import offered
from servobench.harness.run.own_metrics import METRIC_REGISTRY, values_of
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark

LIMIT = 60.0  # [s] for the metric of a run
CODE = ("sha256", "function")  # entries of a record by which code is the same


def add_metric(folder: ResultsFolder, place: str) -> str:
    """Add a metric of a user's to the runs of a folder as it is read, nothing is written; return its name.

    A folder that has the metric by the same code has its numbers.

    Raises:
        ConfigurationError: no such metric, one that fails in every run, or a folder without steps.
    """
    name = trials.choose("metric", place)
    (own,) = offered([name])
    record = {**own.entry.record(), **own.record()}
    there = folder.manifest.setdefault("own_metrics", {}).get(name)
    if there is not None:
        if all(there.get(key) == record[key] for key in CODE):
            return name
        other = f"{folder.path} has {name} by other code of {there.get('place')}"
        if not folder.has_steps():
            raise ConfigurationError(f"{other}, and no steps of which it could be computed anew")
        remark(f"{other}: it is computed anew")
    folder.check_steps()
    values = {}
    faults = []

    def hear(told: object) -> None:
        match told:
            case [str(run_id), float(value), str(fault)]:
                values[run_id] = value
                if fault:
                    faults.append(f"{run_id}: {fault}")

    _, failure = trials.attempt(_measure, name, folder, limit=LIMIT, hear=hear)
    if all(map(math.isnan, values.values())):
        failure = failure or next(iter(faults), f"{name} is NaN in every run")
    if failure:
        raise ConfigurationError(f"--metric {place}: {failure}")
    if faults:
        remark(f"{len(faults)} of {len(values)} runs lack {name}; the first is {faults[0]}")
    folder.added[name] = values
    folder.manifest["own_metrics"][name] = record
    return name


def _measure(tell: Tell, name: str, folder: ResultsFolder) -> None:
    """Tell the identifier of each run with its value and why there is none."""
    metric = METRIC_REGISTRY.find(name)
    for run_id, steps in folder.steps().groupby("run_id", sort=False):
        values, fault = values_of([metric], steps.reset_index(drop=True))
        tell([run_id, values[name], fault])
