"""Describes a results folder in words: its runs, how they were made, controllers with their aids, settings."""

import contextlib
from collections.abc import Mapping
from typing import Any

import pandas as pd

from servobench.controllers.aids import describe_aids
from servobench.controllers.methods import METHODS
from servobench.harness.analysis.comparison import FROM_TWIN, knows_truth, shown_value
from servobench.harness.batch.results import Manifest, ResultsFolder
from servobench.harness.config.registry import CONTROLLERS, FILES
from servobench.harness.config.settings import tuned_settings
from servobench.harness.config.source import find_place
from servobench.harness.run.own_metrics import declare_metrics
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import varied_columns
from servobench.plant.contract.settings import listed
from servobench.plant.robot.mismatch import PROFILE_SETTINGS, Mismatch

# Columns, with settings that are varied
DESCRIBED = ("plant", "sensing", "controller", "task", "mismatch")
TUNED = "†"  # mark of a controller that a user tuned


def describe_folder(manifest: Manifest, runs: pd.DataFrame) -> dict[str, str]:
    """Return the facts of a folder: runs, controllers, plants, tasks, seeds and versions, as names and texts."""
    completed = int((runs["status"] == COMPLETED).sum())
    facts = {"runs": f"{len(runs)}, of which {completed} reached the last period"}
    described = {name: (name, 1.0) for name in DESCRIBED if name in runs}
    described |= varied_columns(runs.columns)
    for name, (heading, factor) in described.items():
        facts[heading] = listed([shown_value(value, factor) for value in runs[name].unique()])
    facts["seeds"] = _seeds(runs["seed"].tolist())
    facts["made"] = _made(manifest)
    return facts


def _made(manifest: Manifest) -> str:
    """Return when and with which versions the runs of a manifest were made."""
    packages = manifest.get("packages") or {}
    created = manifest.get("created", "at an unknown time")
    made = f"{created} by servobench {packages.get('servobench') or 'unknown'}"
    if manifest.get("git_commit"):
        made += f", commit {manifest['git_commit']}"
    return f"{made}, Python {manifest.get('python', 'unknown')}"


def titled_runs(folder: ResultsFolder) -> pd.DataFrame:
    """Return a folder's runs for titles: the mismatch none of robots drawn from a twin says so.

    Metrics of users that the folder has are known from now on.
    """
    declare_metrics(folder.manifest.get("own_metrics") or {})
    runs = folder.runs()
    robots = folder.manifest.get("robots") or ()
    twins = [each.get("name") for each in robots if str(each.get("title")).endswith(" twin")]
    names = runs.get("robot", runs["mismatch"])  # an old table has no column of robots
    drawn = (runs["mismatch"] == "none") & names.isin(twins)
    return runs.assign(mismatch=runs["mismatch"].mask(drawn, FROM_TWIN))


def describe_controllers(manifest: Manifest, names: Mapping[str, str] | None = None) -> str:
    """Return one line that says which of several controllers have the aids; empty for a single one.

    Args:
        manifest: of their folder.
        names: the controllers with the names by which they are shown; None for all of the folder with their own.
    """
    if names is None:
        names = {name: name for name in manifest.get("controllers", ())}
    if len(names) < 2:
        return ""
    configuration = manifest.get("configuration", {})
    own = manifest.get("own_controllers", {})
    found: dict[str, list[str]] = {}
    for name, label in names.items():
        values = configuration.get(name)
        place = own.get(name, {}).get("place", name)
        known = values is not None and not place.startswith(FILES)
        words = describe_aids(values) if known else "aids unknown"
        found.setdefault(words, []).append(label)
    return "; ".join(f"{words}: {', '.join(each)}" for words, each in found.items())


def describe_tuning(manifest: Manifest, *, command: bool = True) -> list[str]:
    """Return a line for each controller that its user tuned, with budget and robots, and one about those not tuned.

    The latter only where others are tuned. Bounds, which know the true robot, and FMUs, whose values nobody knows, are
    left out.

    Args:
        manifest: of a folder.
        command: also name the command that tunes a user's controllers.
    """
    tuned = manifest.get("tuned", {})
    own = manifest.get("own_controllers", {})
    names = manifest.get("controllers", ())
    changed = [key.split(".")[0] for key in manifest.get("changed") or ()]
    lines = []
    for name, facts in tuned.items():
        line = f"{TUNED} {name} was tuned: {facts.get('budget')}"
        if name in changed:
            line += ", and then given other settings"
        lines.append(line)
    known = tuned.keys() | METHODS.keys()
    known |= {name for name in names if name in CONTROLLERS and tuned_settings(name)}
    known &= set(names)
    untuned = []
    places = []
    for name in names:
        place = own.get(name, {}).get("place", name)
        if name in known or knows_truth(name) or place.startswith(FILES):
            continue
        untuned.append(name)
        if name in own and find_place(place):
            places.append(place)
    if not known or not untuned:
        return lines
    line = f"Not tuned, unlike the others: {', '.join(untuned)}"
    if places and command:
        line += f"; remedy: servobench tune --controllers {','.join(places)}"
    return [*lines, line]


def marked(names: Mapping[str, str], manifest: Manifest) -> dict[str, str]:
    """Return controllers with the names by which tables show them, and a mark where their user tuned them.

    The lines of `describe_tuning` explain it.
    """
    marks = {name: f"{names[name]} {TUNED}" for name in manifest.get("tuned", {}) if name in names}
    return {**names, **marks}


def mark_tuned(runs: pd.DataFrame, manifest: Manifest) -> pd.DataFrame:
    """Return runs for tables, in which controllers that their user tuned are `marked`."""
    names = {name: name for name in manifest.get("tuned", {})}
    return runs.replace({"controller": marked(names, manifest)})


def describe_settings(manifest: Manifest) -> dict[str, str]:
    """Return every setting of a folder as `section.name` and its text, also where a mismatch has another."""
    others = _set_by_mismatches(manifest)
    plants = manifest.get("plants", ())
    changed = manifest.get("changed") or ()
    settings = {}
    for section, values in manifest.get("configuration", {}).items():
        for name, value in values.items():
            key = f"{section}.{name}"
            texts = [_setting(value)]
            if section in plants and key not in changed:
                texts += others.get(name, [])
            settings[key] = "; ".join(texts)
    return settings


def _set_by_mismatches(manifest: Manifest) -> dict[str, list[str]]:
    """Return what mismatches of a folder set a plant's settings to, by name of the setting."""
    found: dict[str, list[str]] = {}
    for word in manifest.get("mismatches", ()):
        with contextlib.suppress(ValueError):  # files of calibrations may be elsewhere
            mismatch = Mismatch.parse(word)
            own = PROFILE_SETTINGS.get(mismatch.profile, {}) | mismatch.plant_settings
            for name, value in own.items():
                found.setdefault(name, []).append(f"{_setting(value)} with {word}")
    return found


def _setting(value: Any) -> str:  # noqa: ANN401 - a value of JSON
    if isinstance(value, list):
        return ", ".join(map(_setting, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return {"inf": "no limit", "None": "not set"}.get(str(value), str(value))


def _seeds(seeds: list[int]) -> str:
    unique = sorted(set(seeds))
    if len(unique) > 2 and unique[-1] - unique[0] == len(unique) - 1:
        return f"{unique[0]} to {unique[-1]} ({len(unique)})"
    return listed(list(map(str, unique)))
