"""The scores of points: a point that a ledger lacks is refused or carried out once, and written down.

Points whose settings cannot be built, or whose loop is too close to instability, have the worst cost without a run.

A ledger is a file that a killed process leaves readable. Each line is a JSON object: the first one holds everything
that scores depend on besides the settings, each other one the settings of a point and the cost of every run.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, TypeAlias, final

import numpy as np

from servobench.harness.analysis.loops.loop_analysis import delay_margin
from servobench.harness.batch.sandbox import Workers
from servobench.harness.config.settings import apply_settings, default_config, file_stem, flatten
from servobench.harness.run.experiment import build_once
from servobench.harness.run.request import RunSettings
from servobench.harness.studies.tuning import objective
from servobench.harness.studies.tuning.objective import WEIGHTS, WORST, Trial, TuningSet, evaluate
from servobench.harness.studies.tuning.spaces import find_tunable
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors

SECOND: Final = ".second"  # of the name of the ledger of the second set
Wanted: TypeAlias = tuple["Ledger", str, Mapping[str, Any]]
"""A point whose costs are wanted: the ledger that takes them, the controller, its nested settings."""
LEDGER: Final = ".jsonl"
SHOWN: Final = 60  # letters of wrong costs that a message holds


@final
class Ledger:
    """Costs by settings, each written down as soon as it is known."""

    def __init__(self, path: Path, fingerprint: Mapping[str, Any]) -> None:
        """Open a ledger, or prepare one where there is none; its file is made with the first point.

        Args:
            path: of the file.
            fingerprint: all that costs depend on besides the settings, as JSON has it.

        Raises:
            ConfigurationError: the file is no ledger, or that of something else.
        """
        self.path = path
        self._fingerprint = dict(fingerprint)
        self._costs: dict[str, list[float]] = {}
        self._size = 0  # [bytes] of its whole lines: a process that is killed or interrupted may leave half a line
        if path.is_file():
            self._read()

    def _read(self) -> None:
        wrong = OSError, KeyError, TypeError, OverflowError, RecursionError
        with configuration_errors(f"study {self.path} cannot be opened: ", *wrong):
            content = self.path.read_bytes()
            self._size = content.rfind(b"\n") + 1
            header, *records = [json.loads(line) for line in content[: self._size].splitlines()] or [self._fingerprint]
            self._costs = {_key(record["settings"]): _costs(record["costs"]) for record in records}
        parts = [key for key in self._fingerprint if not isinstance(header, dict)
                 or header.get(key) != self._fingerprint[key]]  # fmt: skip
        if parts:
            raise ConfigurationError(
                f"study {self.path} was made with other {', '.join(parts)}; name another folder with --out"
            )

    def __len__(self) -> int:
        """Return the number of scored points."""
        return len(self._costs)

    def best(self) -> float | None:
        """Return the least mean cost, or None while there is none."""
        return min((sum(costs) / len(costs) for costs in self._costs.values()), default=None)

    def costs(self, settings: Mapping[str, Any]) -> list[float] | None:
        """Return the costs of the runs under nested settings, or None if they are not known."""
        return self._costs.get(_key(settings))

    def add(self, settings: Mapping[str, Any], costs: Sequence[float]) -> None:
        """Write the costs of the runs under nested settings down."""
        lines = [self._fingerprint] * (not self._size) + [{"settings": settings, "costs": list(costs)}]
        try:
            with self.path.open("ab") as file:
                file.truncate(self._size)
                file.write("".join(f"{json.dumps(line)}\n" for line in lines).encode())
                file.flush()
                os.fsync(file.fileno())
                self._size = file.tell()
        except OSError as error:
            raise ConfigurationError(f"study {self.path} cannot be written: {error.strerror}") from error
        self._costs[_key(settings)] = list(costs)


def _costs(given: object) -> list[float]:
    """Return the costs of a record.

    Raises:
        ValueError: they are no numbers.
    """
    if not isinstance(given, list) or not given or not all(type(each) in (int, float) for each in given):
        raise ValueError(f"costs must be a list of numbers, got {str(given)[:SHOWN]}")
    return [float(each) for each in given]


def _key(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True)


def open_ledger(folder: Path, controller: str, runs: TuningSet, kind: str = "") -> Ledger:
    """Return the ledger of a controller on a set of runs.

    Raises:
        ConfigurationError: the file is no ledger, or one of other settings or runs.
    """
    return Ledger(folder / f"{file_stem(controller)}{kind}{LEDGER}", fingerprint(controller, runs))


def fingerprint(controller: str, runs: TuningSet) -> dict[str, Any]:
    """Return everything except the settings on which costs depend, as JSON."""
    constants = ("KINDS", "LEVELS", "MODELS", "TASKS", "FLOOR", "MIN_DELAY_MARGIN", "WORST")
    return {
        "defaults": {key: repr(value) for key, value in flatten(find_tunable(controller).config()).items()},
        "objective": {name: repr(getattr(objective, name)) for name in constants},
        "run settings": {key: repr(value) for key, value in asdict(RunSettings()).items()},
        "plants": list(runs.plants),
        "robots": [runs.robots, runs.offset],
    }


def refuse_broken_defaults(controller: str, runs: TuningSet) -> None:
    """Build the first run with the settings in use: an error that no setting can cure is reported before any run.

    Raises:
        ConfigurationError: a name or setting that cannot be used.
    """
    reason = refusal(Trial(controller, default_config(find_tunable(controller))), runs)
    if reason is not None:
        raise ConfigurationError(reason)


def fill(wanted: Sequence[Wanted], runs: TuningSet, workers: Workers) -> Iterator[str]:
    """Score the points that their ledgers lack, each once, and yield the controller of each as soon as it is written.

    Settings that cannot be built or whose loop bears no delay have the worst cost in every run, without a run.
    """
    requests = runs.runs()
    lacking: dict[str, tuple[Ledger, Trial, Mapping[str, Any]]] = {}
    for ledger, name, nested in wanted:
        if ledger.costs(nested) is not None or f"{name}{nested}" in lacking:
            continue
        try:
            trial = Trial(name, apply_settings(find_tunable(name), nested))
            refused = refusal(trial, runs) is not None or not bears_delay(trial)
        except ConfigurationError:
            refused = True
        if refused:
            ledger.add(nested, [WEIGHTS[run.task] * WORST for run in requests])
            yield name
        else:
            lacking[f"{name}{nested}"] = ledger, trial, nested
    points = list(lacking.values())
    costs = np.full((len(points), len(requests)), np.nan)
    for point_index, run_index, cost in evaluate([trial for _, trial, _ in points], requests, workers):
        costs[point_index, run_index] = cost
        if not np.isnan(costs[point_index]).any():
            ledger, trial, nested = points[point_index]
            ledger.add(nested, costs[point_index].tolist())
            yield trial.controller


def refusal(trial: Trial, runs: TuningSet) -> str | None:
    """Return why a run with these settings cannot be built, or None; networks are trained before workers need them.

    Any other failure is left to the runs, whose cost says so.
    """
    try:
        build_once(trial.resolved(runs.runs()[:1])[0])
    except ConfigurationError as error:
        return str(error)
    return None


def bears_delay(trial: Trial) -> bool:
    """Return whether the loop of a composed controller has the least delay margin, `objective.MIN_DELAY_MARGIN`.

    A controller that identifies the delay changes its loop with it and is left to the runs; so is one whose loop cannot
    be analysed.
    """
    if trial.config.aids.delay == "identified":
        return True
    try:
        return delay_margin(trial.config, trial.controller) >= objective.MIN_DELAY_MARGIN
    except (ArithmeticError, ValueError, RunFault):  # it fails in the runs, too, whose cost says so
        return True
