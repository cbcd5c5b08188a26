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
from servobench.plant.files import write_atomically

HEADING = "# Tuned values, made by `servobench tune`: the table [settings] replaces defaults. Scores: less is better.\n"


@dataclass(frozen=True)
class TunedValues:
    """The outcome of a study, all of it in the file."""

    controller: str
    study_seed: int  # seed of the sampler
    trials: int  # number of trials of which these values are the best
    best_trial: int  # its number; 0 is that of the defaults
    runs_a_trial: int
    plants: tuple[str, ...]  # on which the runs took place
    moves: int  # on each plant (`--seeds`)
    offset: int  # of the seeds in the tuning range (`--offset`)
    seeds: tuple[int, ...]  # first and last seed, for the reader
    date: str  # day on which the last trial ended, UTC
    version: str  # of servobench
    score: float  # of these values
    score_of_defaults: float  # of the defaults of the controller's class
    checked_score: float  # of these values on the subset `TuningSet.checked`
    checked_score_of_defaults: float
    settings: Mapping[str, Any]  # nested values

    def tuning_set(self) -> TuningSet:
        """Return the runs on which the values were found."""
        return TuningSet(self.plants, self.moves, self.offset)


def write_tuned(path: Path, tuned: TunedValues) -> None:
    """Write the file atomically."""
    header = {item.name: getattr(tuned, item.name) for item in fields(tuned) if item.name != "settings"}
    text = HEADING + _table("", header) + _table("settings", tuned.settings)
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"))


def read_tuned(path: Path | Traversable) -> TunedValues:
    """Return what a file of tuned values holds.

    Raises:
        ConfigurationError: it cannot be read, or a key is missing or unknown.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        tuples = {key: tuple(data[key]) for key in ("plants", "seeds")}
        return TunedValues(**{**data, **tuples})
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
