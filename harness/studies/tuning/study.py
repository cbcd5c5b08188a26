"""The studies: for each method an Optuna study in a journal file of its own, all advanced in step.

In a round every method with trials left asks its sampler for one, all runs of these trials are carried out by the
workers, and the scores are stored. Sampling happens in this process only, and each trial's sampler is seeded by the
study's seed and the number of finished trials. So the outcome is the same for any number of workers, and for a study
that was interrupted and continued. The first trial is the default of the controller's class. There is no pruning: each
trial of each method has the same runs.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
import optuna
from optuna.distributions import distribution_to_json
from optuna.exceptions import UpdateFinishedTrialError
from optuna.samplers import TPESampler
from optuna.storages.journal import JournalFileBackend, JournalStorage
from optuna.trial import FrozenTrial, TrialState

from servobench.harness.batch.lock import LOCK
from servobench.harness.batch.workers import Workers
from servobench.harness.config.defaults import apply_settings
from servobench.harness.config.settings import ConfigurationError, flatten
from servobench.harness.run.experiment import build_once
from servobench.harness.run.request import RunSettings
from servobench.harness.studies.tuning import objective
from servobench.harness.studies.tuning.files import TunedValues, write_tuned
from servobench.harness.studies.tuning.objective import Trial, TuningSet, evaluate, score
from servobench.harness.studies.tuning.spaces import SPACES, default_values, find_tunable, nested_settings
from servobench.plant.seeds import named_seed
from servobench.plant.settings import Count, Periods, settings

JOURNAL: Final = ".journal"
FINGERPRINT: Final = "fingerprint"
COSTS: Final = "costs"


@settings
class TuningPlan:
    """What is asked for."""

    controllers: tuple[str, ...]
    """names with a search space"""
    trials: Count
    """for each of them, that of the defaults included"""
    runs: TuningSet
    """on which a trial is scored"""
    study_seed: Periods = 0
    """seed of the samplers"""

    def __post_init__(self) -> None:
        """Refuse an unknown controller and one without a search space."""
        for name in self.controllers:
            find_tunable(name)


class MethodStudy:
    """The study of one method on disk."""

    def __init__(self, folder: Path, controller: str, plan: TuningPlan) -> None:
        """Open the study, or make it where there is none.

        Raises:
            ConfigurationError: the file is no study, or that of another search space, objective, set of runs or seed.
        """
        self.controller = controller
        self._entry = find_tunable(controller)
        self._plan = plan
        self._path = folder / f"{controller}{JOURNAL}"
        self._asked: optuna.Trial | None = None
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        mend_journal(self._path)
        try:
            storage = JournalStorage(JournalFileBackend(str(self._path)))
            self._study = optuna.create_study(
                storage=storage, study_name=controller, direction="minimize", load_if_exists=True
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigurationError(f"study {self._path} cannot be opened: {error}") from error
        self._check_fingerprint()
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            # It belongs to a call that was killed; the sampler will ask for the same values again.
            self._study.tell(trial.number, state=TrialState.FAIL)
        if not self.finished() and not self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
            self._study.enqueue_trial(default_values(self._entry))

    def finished(self) -> list[FrozenTrial]:
        """Return the finished trials, at most as many as are asked for, in their order."""
        return self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))[: self._plan.trials]

    def best(self) -> float | None:
        """Return the least score, or None while there is none."""
        return min((trial_score(trial) for trial in self.finished()), default=None)

    def ask(self) -> Trial:
        """Return the next trial to carry out."""
        name = f"{self.controller}, trial {len(self.finished())}"
        self._study.sampler = TPESampler(
            seed=named_seed(self._plan.study_seed, name), multivariate=True, constant_liar=False
        )
        with np.errstate(all="ignore"):  # the sampler's densities may underflow
            self._asked = self._study.ask(dict(SPACES[self.controller]))
        return Trial(self.controller, apply_settings(self._entry, nested_settings(self._asked.params)))

    def tell(self, costs: Sequence[float]) -> None:
        """Finish the trial that was asked for with the costs of its runs."""
        if self._asked is None:
            raise ValueError("a trial must be asked for before its costs are told")
        try:
            self._asked.set_user_attr(COSTS, list(costs))
            self._study.tell(self._asked, score(self._plan.runs.runs(), costs))
        except (ValueError, UpdateFinishedTrialError) as error:
            raise ConfigurationError(f"study {self._path} is in use by another call of tune: {error}") from error
        self._asked = None

    def outcome(self) -> TunedValues:
        """Return the best values so far; at least one trial must be finished."""
        trials, plan = self.finished(), self._plan
        best = min(trials, key=lambda trial: (trial_score(trial), trial.number))
        runs, checked = plan.runs.runs(), plan.runs.checked()
        ended = [trial.datetime_complete for trial in trials if trial.datetime_complete is not None]

        def checked_score(trial: FrozenTrial) -> float:
            return score([runs[i] for i in checked], [trial.user_attrs[COSTS][i] for i in checked])

        return TunedValues(
            controller=self.controller,
            study_seed=plan.study_seed,
            trials=len(trials),
            best_trial=trials.index(best),
            runs_a_trial=len(runs),
            plants=plan.runs.plants,
            moves=plan.runs.seeds,
            offset=plan.runs.offset,
            seeds=(min(run.seed for run in runs), max(run.seed for run in runs)),
            date=max(ended).astimezone(UTC).date().isoformat(),
            version=version("servobench"),
            score=trial_score(best),
            score_of_defaults=trial_score(trials[0]),
            checked_score=checked_score(best),
            checked_score_of_defaults=checked_score(trials[0]),
            settings=nested_settings(best.params),
        )

    def _check_fingerprint(self) -> None:
        mine = fingerprint(self.controller, self._plan)
        theirs = self._study.user_attrs.get(FINGERPRINT)
        if theirs is None and not self._study.get_trials(deepcopy=False):
            self._study.set_user_attr(FINGERPRINT, mine)
        elif theirs != mine:
            parts = [key for key in mine if (theirs or {}).get(key) != mine[key]]
            raise ConfigurationError(
                f"study {self._path} was made with other {', '.join(parts)}; name another folder with --out"
            )


def trial_score(trial: FrozenTrial) -> float:
    """Return the score of a finished trial."""
    return float(trial.values[0])


def fingerprint(controller: str, plan: TuningPlan) -> dict[str, Any]:
    """Return all that a study's scores depend on, as JSON has it; the number of trials may grow and is not in it."""
    entry = find_tunable(controller)
    constants = ("MOVE", "CURVE", "MISMATCH", "LATENCIES", "RMS_SATURATION", "FAULT_PENALTY")
    return {
        "search space": {key: distribution_to_json(value) for key, value in SPACES[controller].items()},
        "defaults": {key: repr(value) for key, value in flatten(entry.config()).items()},
        "objective": {name: repr(getattr(objective, name)) for name in constants},
        "run settings": {key: repr(value) for key, value in asdict(RunSettings()).items()},
        "plants": list(plan.runs.plants),
        "seeds": [plan.runs.seeds, plan.runs.offset],
        "study seed": plan.study_seed,
    }


def mend_journal(path: Path) -> None:
    """Remove a last line that a killed process left unfinished."""
    if path.is_file():
        data = path.read_bytes()
        whole = data.rfind(b"\n") + 1
        if data.startswith(b"{") and whole < len(data):
            with path.open("r+b") as file:
                file.truncate(whole)


def check_study_folder(folder: Path) -> None:
    """Refuse a folder with other things than studies in it.

    Raises:
        ConfigurationError: names the folder.
    """
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else [folder.name] * folder.exists()
    if set(names) - {LOCK} and not any(name.endswith(JOURNAL) for name in names):
        raise ConfigurationError(f"{folder} exists already and holds no study; name another folder with --out")


def open_studies(folder: Path, plan: TuningPlan) -> list[MethodStudy]:
    """Open or make the studies of a plan.

    Raises:
        ConfigurationError: the folder has other things in it or cannot be made, or a study of it is another one.
    """
    check_study_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"study folder {folder} cannot be made: {error.strerror}") from error
    present_first = sorted(plan.controllers, key=lambda name: not (folder / f"{name}{JOURNAL}").exists())
    opened = {name: MethodStudy(folder, name, plan) for name in present_first}  # refused before another is made
    return [opened[name] for name in plan.controllers]


def advance(studies: Sequence[MethodStudy], plan: TuningPlan, workers: Workers) -> Iterator[tuple[str, float | None]]:
    """Carry out the trials that are left, a round at a time.

    Yields:
        After every run: its controller, and the least score of that one's trials; None while none is finished.
    """
    runs = plan.runs.runs()
    while active := [study for study in studies if len(study.finished()) < plan.trials]:
        with undisturbed():
            trials = [study.ask() for study in active]
        for trial in trials:
            build_once(trial.resolved(runs[:1])[0])  # networks are trained before workers need them
        costs = np.zeros((len(trials), len(runs)))
        best = [study.best() for study in active]
        for trial_index, run_index, cost in evaluate(trials, runs, workers):
            costs[trial_index, run_index] = cost
            yield active[trial_index].controller, best[trial_index]
        with undisturbed():
            for study, row in zip(active, costs, strict=True):
                study.tell(row.tolist())


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold Ctrl-C back until the end, so that it cannot interrupt a journal that is locked or written."""
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def write_outcomes(folder: Path, studies: Sequence[MethodStudy]) -> Mapping[str, TunedValues]:
    """Write `NAME.toml` for every study that has a finished trial, and return their contents by name."""
    outcomes = {study.controller: study.outcome() for study in studies if study.finished()}
    for name, tuned in outcomes.items():
        write_tuned(folder / f"{name}.toml", tuned)
    return outcomes
