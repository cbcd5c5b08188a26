"""A file of tuned values: how they were found, above a table `[settings]` in the nested form of the configuration."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from servobench.harness.config.settings import ConfigurationError
from servobench.harness.studies.tuning.objective import TuningSet
from servobench.plant.contract.files import write_atomically

HEADING = "# Tuned values, made by `servobench tune`: the table [settings] replaces defaults. Scores: less is better.\n"


@dataclass(frozen=True)
class StudyRecord:
    """One of the studies of a method."""

    seed: int  # of the sampler
    trials: int  # of the sampler, known settings included
    best_trial: int  # the number of the best one; 0 is that of the defaults
    best_trial_score: float
    search_points: int  # scored by the coordinate search that began there
    search_complete: bool  # whether no change of one value improves the score; False: its budget ended first
    score: float  # at its end
    second_score: float  # of the same settings on the second set
    settings: Mapping[str, Any]  # nested values


@dataclass(frozen=True)
class TunedValues:
    """What the studies of a method found, all of it in the file; the best one on the second set is in use."""

    controller: str
    plants: tuple[str, ...]  # on which the runs took place
    robots: int  # under each condition (`--robots`)
    offset: int  # of the seeds in the tuning range (`--offset`)
    runs_a_trial: int
    runs_of_second_set: int
    date: str  # day on which the file was written, UTC
    version: str  # of servobench
    score: float  # of these values
    score_of_defaults: float  # of the defaults of the controller's class
    second_score: float  # of these values on the second set of robots
    second_score_of_defaults: float
    checked_score: float  # of these values on the subset `TuningSet.checked`
    checked_score_of_defaults: float
    settings: Mapping[str, Any]  # nested values
    studies: tuple[StudyRecord, ...]  # empty for values that were found under another objective and only scored anew

    def tuning_set(self) -> TuningSet:
        """Return the runs on which the values were found."""
        return TuningSet(self.plants, self.robots, self.offset)


def write_tuned(path: Path, tuned: TunedValues) -> None:
    """Write the file atomically."""
    tables = ("settings", "studies")
    header = {item.name: getattr(tuned, item.name) for item in fields(tuned) if item.name not in tables}
    if not tuned.studies:
        header["studies"] = ()
    text = HEADING + _table("", header)
    text += _table("settings", tuned.settings)
    for record in tuned.studies:
        values = {item.name: getattr(record, item.name) for item in fields(record)}
        text += "\n[[studies]]\n" + _table("", {key: value for key, value in values.items() if key != "settings"})
        text += _table("studies.settings", record.settings)
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"))


def read_tuned(path: Path | Traversable) -> TunedValues:
    """Return what a file of tuned values holds.

    Raises:
        ConfigurationError: it cannot be read, or a key is missing or unknown.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        studies = tuple(StudyRecord(**record) for record in data["studies"])
        return TunedValues(**{**data, "plants": tuple(data["plants"]), "studies": studies})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(f"tuned values {path} cannot be read: {error}") from error


def _table(name: str, values: Mapping[str, Any]) -> str:
    plain = {key: value for key, value in values.items() if not isinstance(value, Mapping)}
    nested = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    heading = f"\n[{name}]\n" if name and (plain or not nested) else ""
    lines = "".join(f"{key} = {_value(value)}\n" for key, value in plain.items())
    return heading + lines + "".join(_table(f"{name}.{key}", value) for key, value in nested.items())


def _value(value: object) -> str:
    """Return a number, a switch, a text or a list of these as TOML; JSON writes them in the same way."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)
