"""What was asked for and would not be had: assignments without effect on a batch, and other runs on resuming."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from servobench.harness.config.settings import Assignment, ConfigurationError, Settings
from servobench.harness.run.request import RunRequest

NAMES: Final = ("plants", "controllers", "tasks", "mismatches", "seeds")  # entries of a manifest that say what runs
SOURCES: Final = ("own_controllers", "own_plants", "plugins")  # entries that have the hash of code by its name
REST: Final = "noise, latencies, periods, axes that are varied, or the command"  # of which a manifest has a digest only


def check_effects(settings: Settings, examples: Sequence[RunRequest], *, steps: bool) -> None:
    """Refuse assignments to settings that are read but change nothing here.

    Args:
        settings: overrides of the defaults.
        examples: runs with every plant in every condition.
        steps: the table of steps is kept.

    Raises:
        ConfigurationError: names the first of them and says why.
    """
    for assignment in settings.assigned:
        why = _without_effect(assignment, examples, steps)
        if why:
            raise ConfigurationError(f"--set {assignment.text} has no effect: {why}")


def _without_effect(assignment: Assignment, examples: Iterable[RunRequest], steps: bool) -> str:
    match assignment.section, assignment.key:
        case "run", "full_jacobian" if not steps:
            return "this command keeps no steps, which hold the Jacobians"
        case "run", "camera_moves_at" if not any(run.mismatch.size("camera_move") for run in examples):
            return "no mismatch moves the camera, as camera_move=90deg does"
        case "run", "period" if all(run.period is not None for run in examples):
            return "--period gives the control period of every run"
        case plant, "sensing.latency" if all(run.latency is not None for run in examples if run.plant == plant):
            return "--latency gives the latency of every run"
    return ""


def difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Return in which names or settings two batches differ that are not the same.

    Args:
        there: manifest of the folder.
        here: manifest of what is asked for.
    """
    here = json.loads(json.dumps(here, default=str))
    for key in NAMES:
        if there.get(key) != here[key]:
            return f"{key} {_short(there.get(key))} there, {_short(here[key])} here"
    old, new = _flat(there.get("configuration", {})), _flat(here["configuration"])
    for key in dict.fromkeys([*old, *new]):
        if old.get(key) != new.get(key):
            return f"{key} {_short(old.get(key, 'unknown'))} there, {_short(new.get(key, 'unknown'))} here"
    return REST


def changed_source(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Return which file of users is no longer what two batches have in common; empty if none.

    Args:
        there: manifest of the folder; what it does not tell counts as unchanged.
        here: manifest of what is asked for.
    """
    for name, digest in here["files"].items():
        if there.get("files", {}).get(name, digest) != digest:
            return str(name)
    for key in SOURCES:
        for name, record in here[key].items():
            if record.get("sha256") != there.get(key, {}).get(name, record).get("sha256"):
                return str(record["place"])
    return ""


def _flat(configuration: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return settings by section and key; JSON has no infinity, so a manifest has its name."""
    every = ((f"{section}.{key}", value) for section, values in configuration.items() for key, value in values.items())
    return {name: str(value) if value in (float("inf"), float("-inf")) else value for name, value in every}


def _short(value: object) -> str:
    """Return a value in one line, or the begin of it."""
    text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 60 else f"{text[:59]}…"
