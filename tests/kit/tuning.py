"""Tuning in small: few runs, and runs whose cost is a formula."""

import tomllib
from dataclasses import fields

import numpy as np

from servobench.harness.apps.tuning import objective as scoring
from servobench.harness.apps.tuning.campaign import (
    TunedValues,
    TuningPlan,
    advance,
    open_methods,
)
from servobench.harness.apps.tuning.objective import TuningSet
from servobench.harness.apps.tuning.spaces import StudyRecord
from servobench.harness.batch.blocks import open_workers
from servobench.harness.config.settings import flatten

SMALL = TuningSet(robots=2)


def plan_of(*names, trials=1, studies=1, **further):
    """Return a plan on the smallest set of runs."""
    return TuningPlan(names, trials, SMALL, studies, **further)


def carried_out(folder, plan, workers=1):
    """Carry a plan out and return its methods."""
    folder.mkdir(parents=True, exist_ok=True)
    methods = open_methods(folder, plan)
    with open_workers(workers) as place:
        for _ in advance(methods, plan, place):
            pass
    return methods


def outcomes(folder, plan, workers=1):
    """Carry a plan out and return what each study of each method found."""
    return [
        [each.outcome for each in method.studies] for method in carried_out(folder, plan, workers)
    ]


def cost_by_formula(monkeypatch):
    """Let runs cost nothing: their cost is a smooth function of settings and seed. Return what will be scored."""
    scored = []

    def cost(trial, run):
        numbers = [value for value in flatten(trial.config).values() if isinstance(value, float)]
        return float(np.sum(np.square(np.tanh(numbers[:2]) - 0.1)) + 1e-3 * (run.seed % 7))

    def costs(trials, runs, _workers):
        for t, trial in enumerate(trials):
            scored.append((trial.controller, len(runs), str(trial.config)))
            for r, run in enumerate(runs):
                yield t, r, cost(trial, run)

    monkeypatch.setattr(scoring, "evaluate", costs)
    return scored


def read_tuned(path):
    """Return the contents of a file of tuned values."""
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    names = [field.name for field in fields(StudyRecord)]  # files of before 0.4.0 have further ones
    studies = tuple(
        StudyRecord(**{name: record[name] for name in names}) for record in data["studies"]
    )
    lists = {key: tuple(data[key]) for key in ("plants", "edges", "seeds") if key in data}
    return TunedValues(**{**data, **lists, "studies": studies})
