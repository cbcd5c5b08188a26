"""The tables and sentences of the analysis notebook, from the table of runs alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from servobench.harness.analysis.statistics import (
    Estimate,
    column_of,
    median_with_interval,
    settled_share,
    settling_times,
)
from servobench.harness.batch import results
from servobench.harness.run.episode import COMPLETED

CONDITIONS = ("plant", "mismatch", "noise_factor", "latency_periods")  # what a folder may vary beside the task
NOTHING = Estimate(np.nan, np.nan, np.nan, 0)
MEASURES = {  # column -> heading, factor, digits
    "settling_time_s": ("settling [s]", 1.0, 2),
    "overshoot": ("overshoot [%]", 100.0, 1),
    "steady_state_error": ("last second [mm]", 1000.0, 2),
    "rms_error_evaluated": ("RMS, evaluated part [mm]", 1000.0, 2),
    "max_error": ("largest error [mm]", 1000.0, 1),
    "path_length_ratio": ("path ratio", 1.0, 3),
    "jacobian_error_mean": ("mean Jacobian error [%]", 100.0, 1),
    "control_effort_rad": ("control effort [rad]", 1.0, 2),
    "saturation_fraction": ("saturated periods [%]", 100.0, 1),
    "feature_invalid_fraction": ("periods without a feature [%]", 100.0, 1),
    "controller_time_median_us": ("controller step, median [µs]", 1.0, 0),
    "controller_time_p99_us": ("controller step, 99 % [µs]", 1.0, 0),
    "plant_time_median_us": ("plant step, median [µs]", 1.0, 0),
}
SHORTEST = 60  # characters of a reason that are shown in a table


def describe_folder(folder: Path, runs: pd.DataFrame) -> str:
    """Return in Markdown what was run and with what.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest = results.read_manifest(folder)
    completed = int((runs["status"] == COMPLETED).sum())
    runs_in_words = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    lines = [f"- **{runs_in_words}**, of which {completed} reached the last period."]
    lines += [
        f"- {name.replace('_', ' ')}: {_listed(runs[name].unique().tolist())}"
        for name in ("plant", "controller", "task", "mismatch", *CONDITIONS[2:])
        if name in runs
    ]
    lines.append(f"- seeds: {_seeds(runs['seed'].tolist())}")
    packages = manifest.get("packages") or {}
    made = (
        f"made {manifest.get('created', 'at an unknown time')} by servobench {packages.get('servobench') or 'unknown'}"
    )
    commit = manifest.get("git_commit")
    lines.append(f"- {made}{f', commit `{commit}`' if commit else ''}, Python {manifest.get('python', 'unknown')}")
    return "\n".join(lines)


def other_tables(folder: Path) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield name and content of each table that a folder has beside its runs and steps, such as answered claims."""
    for path in sorted(folder.iterdir()):
        if path.name in (results.RUNS, results.STEPS) or path.name.startswith("."):
            continue
        if path.suffix == ".parquet":
            yield path.stem, pd.read_parquet(path)
        elif path.suffix == ".csv":
            yield path.stem, pd.read_csv(path)


def split_tasks(runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the runs of the moves and those of the tracked curves; only a move can have an overshoot.

    A task of which no run was judged, as each ended before its first period, is in neither.
    """
    judged = runs.loc[column_of(runs, "max_error").notna(), "task"].unique()
    moves = runs.loc[column_of(runs, "overshoot").notna(), "task"].unique()
    curves = [task for task in judged if task not in moves]
    return runs[runs["task"].isin(moves)], runs[runs["task"].isin(curves)]


def settling_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each condition and controller how many moves settled, how fast, and with what error."""
    moves, _ = split_tasks(runs)
    rows = []
    for key, group in _groups(moves):
        share = settled_share(group)
        rows.append(
            key
            | {
                "moves": len(group),
                "settled": int(settling_times(group).notna().sum()),
                "settled [%]": round(share.value),
                "settled, 95 %": f"{share.low:.0f} – {share.high:.0f}",
            }
            | _median(group, "settling_time_s")
            | _median(group, "overshoot")
            | _median(group, "steady_state_error")
        )
    return pd.DataFrame(rows)


def tracking_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each condition, task and controller the errors along the curve."""
    _, curves = split_tasks(runs)
    rows = []
    for key, group in _groups(curves, "task"):
        completed = int((group["status"] == COMPLETED).sum())
        row = key | {"runs": len(group), "completed": completed}
        rows.append(row | _median(group, "rms_error_evaluated") | _median(group, "max_error"))
    return pd.DataFrame(rows)


def cost_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each plant and controller what a step costs and how much the joints are used."""
    rows = []
    for (plant, controller), group in runs.groupby(["plant", "controller"], sort=False):
        row: dict[str, Any] = {"plant": plant, "controller": controller}
        for name in ("controller_time_median_us", "controller_time_p99_us", "control_effort_rad", "saturation_fraction",
                     "jacobian_error_mean"):  # fmt: skip
            heading, factor, digits = MEASURES[name]
            row[heading] = _number(factor * column_of(group, name).median(), digits)
        rows.append(row)
    return pd.DataFrame(rows)


def failure_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each way in which runs of a controller ended early, with one of the reasons."""
    failed = runs[runs["status"] != COMPLETED]
    rows = []
    for (controller, plant, status), group in failed.groupby(["controller", "plant", "status"], sort=False):
        total = len(runs[(runs["controller"] == controller) & (runs["plant"] == plant)])
        row = {"controller": controller, "plant": plant, "ended by": status, "runs": f"{len(group)} of {total}"}
        first = group.iloc[0]
        rows.append(row | {"for example": first["run_id"], "reason": str(first.get("reason", ""))})
    return pd.DataFrame(rows)


def runs_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return every run as a row for the reader: conditions, how it ended, and its measures in handy units."""
    names = [
        name for name in (*CONDITIONS, "task", "controller", "seed", "status") if name in runs and _tells(runs, name)
    ]
    table = runs[names].copy()
    for name, (heading, factor, digits) in MEASURES.items():
        if name in runs:
            table[heading] = (factor * runs[name].astype(float)).round(digits)
    if "reason" in runs and (runs["reason"].fillna("") != "").any():
        table["reason"] = [
            text if len(text) <= SHORTEST else f"{text[: SHORTEST - 1]}…" for text in runs["reason"].fillna("")
        ]
    return table.reset_index(drop=True)


def _groups(runs: pd.DataFrame, *more: str) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    names = [name for name in (*CONDITIONS, *more, "controller") if name in runs and _tells(runs, name)]
    grouped = runs.groupby(names, sort=False, dropna=False)
    return [(dict(zip(names, key, strict=True)), group) for key, group in grouped]


def _tells(runs: pd.DataFrame, name: str) -> bool:
    """Return whether a column says something: what only a sweep varies is left out where it is always the same."""
    return name not in CONDITIONS[2:] or runs[name].nunique() > 1


def _median(group: pd.DataFrame, name: str) -> dict[str, Any]:
    """Return the median of a measure under its heading, with its interval behind it where there is one.

    A move that never settled counts as one that settles after all others, ∞; of other measures a gap is left out.
    """
    heading, factor, digits = MEASURES[name]
    if name == "settling_time_s":
        middle = median_with_interval(factor * settling_times(group))
    else:
        values = factor * column_of(group, name)
        middle = median_with_interval(values, missing="left_out") if values.notna().any() else NOTHING
    interval = "" if np.isnan(middle.low) else f"{middle.low:.{digits}f} – {middle.high:.{digits}f}"
    return {heading: _number(middle.value, digits), f"{heading.split(' [')[0]}, 95 %": interval.replace("inf", "∞")}


def _number(value: float, digits: int) -> float:
    return round(float(value), digits) if digits or np.isnan(value) else float(round(value))


def _listed(values: list[Any], most: int = 15) -> str:
    words = [f"`{value}`" for value in values[:most]]
    return ", ".join(words) + (f" and {len(values) - most} more" if len(values) > most else "")


def _seeds(seeds: list[int]) -> str:
    unique = sorted(set(seeds))
    if len(unique) > 2 and unique == list(range(unique[0], unique[-1] + 1)):
        return f"{unique[0]} to {unique[-1]} ({len(unique)})"
    return _listed(unique)
