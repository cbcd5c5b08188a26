"""Describes a results folder in words."""

from pathlib import Path
from typing import Any, Final

import pandas as pd

from servobench.controllers.aids import describe_aids
from servobench.harness.batch import results
from servobench.harness.config.registry import MAPPED
from servobench.harness.run.request import SECTIONS
from servobench.harness.run.result import COMPLETED

DESCRIBED: Final = {name: name for name in ("plant", "sensing", "controller", "task", "mismatch")} | {
    "noise_factor": "noise factor",
    "latency_s": "latency [s]",
    "period_s": "period [s]",
}  # column -> heading; settings that are varied, too, have their key
MAX_LISTED: Final = 15  # values of a column


def describe_folder(folder: Path, runs: pd.DataFrame) -> dict[str, str]:
    """Return the facts of a folder: runs, controllers, plants, tasks, seeds and versions, as names and texts.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest = results.read_manifest(folder)
    completed = int((runs["status"] == COMPLETED).sum())
    facts = {"runs": f"{len(runs)}, of which {completed} reached the last period"}
    described = DESCRIBED | {name: name for name in runs.columns if name.startswith(SECTIONS)}
    facts |= {head: _listed(runs[name].unique().tolist()) for name, head in described.items() if name in runs}
    by = (manifest.get("packages") or {}).get("servobench") or "unknown"
    commit = f", commit {manifest['git_commit']}" if manifest.get("git_commit") else ""
    made = f"{manifest.get('created', 'at an unknown time')} by servobench {by}{commit}"
    return facts | {
        "seeds": _seeds(runs["seed"].tolist()),
        "made": f"{made}, Python {manifest.get('python', 'unknown')}",
    }


def describe_controllers(folder: Path) -> str:
    """Return one line that says which of several controllers have the aids, by their settings; empty for a single one.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest = results.read_manifest(folder)
    names, configuration = manifest.get("controllers", ()), manifest.get("configuration", {})
    found: dict[str, list[str]] = {}
    for name in names if len(names) > 1 else ():
        values = configuration.get(name)
        known = values is not None and not name.startswith(MAPPED)
        found.setdefault(describe_aids(values) if known else "aids unknown", []).append(name)
    return "; ".join(f"{words}: {', '.join(each)}" for words, each in found.items())


def describe_settings(folder: Path) -> dict[str, str]:
    """Return every setting of the runs by section and name; empty where the folder has none.

    Raises:
        ConfigurationError: not a results folder.
    """
    sections = results.read_manifest(folder).get("configuration", {}).items()
    return {f"{section}.{name}": _setting(value) for section, values in sections for name, value in values.items()}


def _setting(value: Any) -> str:  # noqa: ANN401 - a value of JSON
    if isinstance(value, list):
        return ", ".join(map(_setting, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return {"inf": "no limit", "None": "not set"}.get(str(value), str(value))


def _listed(values: list[Any]) -> str:
    words = ["as configured" if pd.isna(value) else str(value) for value in values[:MAX_LISTED]]
    return ", ".join(words) + (f" and {len(values) - MAX_LISTED} more" if len(values) > MAX_LISTED else "")


def _seeds(seeds: list[int]) -> str:
    unique = sorted(set(seeds))
    if len(unique) > 2 and unique[-1] - unique[0] == len(unique) - 1:
        return f"{unique[0]} to {unique[-1]} ({len(unique)})"
    return _listed(unique)
