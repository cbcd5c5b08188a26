"""Tables for a page: columns in groups, a value with its interval in one cell, a row for each condition and controller.

The columns of such a table are pairs (group, heading) and its cells are text; the columns that say which runs a row
is about are in the group without a name.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import pandas as pd

from servobench.controllers.methods import PUBLISHED
from servobench.harness.analysis.comparison import (
    achieved_share,
    achievement,
    column_of,
    in_handy_units,
    metric_heading,
    outcomes,
    settling_times,
    shown_unit,
    shown_value,
    split_conditions,
    split_tasks,
)
from servobench.harness.analysis.statistics import (
    MISSING,
    NO_ESTIMATE,
    Estimate,
    median_with_interval,
    number,
    success_rate,
)
from servobench.harness.analysis.verdict import scores
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import (
    ACHIEVED,
    JOINT_AT_LIMIT,
    NOT_FOLLOWED,
    NOT_SETTLED,
    OUTCOMES,
    TARGET_UNREACHABLE,
)
from servobench.harness.run.request import varied_columns
from servobench.harness.run.result import COMPLETED

WHICH: Final = ""  # the group of columns that say which runs a row is about
CONDITIONS: Final = ("plant", "robot", "sensing", "mismatch")  # with the settings that are varied
GROUPS: Final = {
    "moves": ("Time", "Error", "Motion"),
    "curves": ("RMS error", "Motion"),
    "cost": ("Step of the controller", "Joints", "Estimate"),
    "runs": ("Time", "Error", "Motion"),
}  # table -> groups of columns in order; a metric says in which of them it is
MEANINGS: Final = {
    NOT_SETTLED: "the true error did not come into the settling band, or left it again",
    NOT_FOLLOWED: "the RMS error of the judged part of the curve is too large",
    TARGET_UNREACHABLE: "the true arm cannot come that near to the target or to the judged part of the curve",
    JOINT_AT_LIMIT: "a joint stood at its stop for a second while the error was too large",
}
MOST_PLACES: Final = 5  # that have columns of their own in the overview

Row = dict[tuple[str, str], Any]


def overview(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the success rate and score of each controller, a group of columns for each place.

    Where there are many conditions, a group is a task with all its conditions.
    """
    places = split_conditions(runs)
    if len(places) > MOST_PLACES:
        places = [(str(task), own) for task, own in runs.groupby("task", sort=False)]
    single = runs["plant"].nunique() * runs["mismatch"].nunique() == 1
    rows: list[Row] = []
    for name in ordered(runs["controller"]):
        row: Row = {(WHICH, "controller"): name}
        for words, place in places:
            own = place[place["controller"] == name]
            where = str(place["task"].iloc[0]) if single and place["task"].nunique() == 1 and len(places) > 1 else words
            row[where, f"{achievement(place)} [%]"] = f"{achieved_share(own):.0f}" if len(own) else MISSING
            table, unit, digits = scores(place)
            heading = f"after [{unit}]" if unit == "s" else f"RMS error [{unit}]"
            row[where, heading] = (
                f"{median_with_interval(table[name]):.{digits}f}" if name in table and len(table) else MISSING
            )
        rows.append(row)
    return pd.DataFrame(rows)


def move_tables(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each move how many runs settled, how fast, and with what error."""
    return _by_task(split_tasks(in_handy_units(runs))[0], "moves")


def curve_tables(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each curve how many runs followed it, and with what error."""
    return _by_task(split_tasks(in_handy_units(runs))[1], "curves")


def outcome_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the shares of outcomes [%] of each condition, task and controller of which a run failed."""
    named = runs.assign(outcome=outcomes(runs))
    mixed = [
        (row, own) for row, own in _rows(named, [*_varied(runs), "task"]) if not own["outcome"].isin(ACHIEVED).all()
    ]
    found = {str(word) for _, own in mixed for word in own["outcome"]}
    table = []
    for row, own in mixed:
        row[WHICH, "runs"] = str(len(own))
        for word in [*(word for word in OUTCOMES if word in found), *sorted(found - set(OUTCOMES))]:
            count = int((own["outcome"] == word).sum())
            share = success_rate(count, len(own)).scaled(100.0)
            row[_kind_of(word), f"{word} [%]"] = f"{share:.0f}" if count else MISSING
        table.append(row)
    return pd.DataFrame(table)


def meanings(table: pd.DataFrame) -> dict[str, str]:
    """Return the meaning of each outcome in an outcome table; the words of faults explain themselves."""
    shown = {str(name[1]).removesuffix(" [%]") for name in list(table) if isinstance(name, tuple)}
    return {word: meaning for word, meaning in MEANINGS.items() if word in shown}


def cost_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return computing times, as far as known, and use of the joints for each plant and controller."""
    return _table(runs, "cost", ["plant"] if runs["plant"].nunique() > 1 else [], counted=False)


def failure_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each way in which runs of a controller ended early, with the reason of the first."""
    failed = runs[runs["status"] != COMPLETED]
    rows = []
    for (controller, plant, status), own in failed.groupby(["controller", "plant", "status"], sort=False):
        total = ((runs["controller"] == controller) & (runs["plant"] == plant)).sum()
        first = own.iloc[0]
        which = {"controller": controller, "plant": plant, "ended by": status, "runs": f"{len(own)} of {total}"}
        example = {"run": first["run_id"], "reason": first.get("reason") or MISSING}
        rows.append({(WHICH, name): str(text) for name, text in which.items()}
                    | {("The first of them", name): str(text) for name, text in example.items()})  # fmt: skip
    return pd.DataFrame(rows)


def runs_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row per run: identity, status, outcome and main metrics."""
    runs = in_handy_units(runs)
    named = runs.assign(outcome=outcomes(runs))
    table: dict[tuple[str, str], list[str]] = {}
    headings = varied_columns(runs.columns)
    for name in ("controller", "task", *_varied(runs)):
        heading, factor = headings.get(name, (name, 1.0))
        table[WHICH, heading] = [shown_value(value, factor) for value in named[name]]
    table[WHICH, "seed"] = named["seed"].astype(str).tolist()
    for name in ("status", "outcome"):
        table["How it ended", name] = named[name].astype(str).tolist()
    for group, name in _columns("runs", runs):
        _, factor = shown_unit(name, runs)
        spec = f".{METRICS[name].digits}f"
        table[group, metric_heading(name, runs)] = [number(factor * value, spec) for value in column_of(runs, name)]
    return pd.DataFrame(table)


def ordered(names: pd.Series[str]) -> list[str]:
    """Return names in order of appearance, each method's published division directly after the method."""
    found = [str(name) for name in dict.fromkeys(names)]
    methods = list(dict.fromkeys(name.removesuffix(PUBLISHED) for name in found))
    return [name for method in methods for name in (method, method + PUBLISHED) if name in found]


def _by_task(runs: pd.DataFrame, kind: str) -> dict[str, pd.DataFrame]:
    return {str(task): _table(own, kind, _varied(runs), counted=True) for task, own in runs.groupby("task", sort=False)}


def _table(runs: pd.DataFrame, kind: str, keys: Sequence[str], *, counted: bool) -> pd.DataFrame:
    """Return medians of measures with their intervals in groups of columns, a row for each of `keys` and controller."""
    rows = []
    for row, own in _rows(runs, keys):
        if counted:
            row["Runs", "number"] = str(len(own))
            row["Runs", f"{achievement(runs)} [%]"] = f"{achieved_share(own):.0f}"
        for group, name in _columns(kind, runs):
            middle = _median(own, name, shown_unit(name, runs)[1])
            row[group, metric_heading(name, runs)] = f"{middle:.{METRICS[name].digits}f}"
        rows.append(row)
    return pd.DataFrame(rows)


def _rows(runs: pd.DataFrame, keys: Sequence[str]) -> Iterator[tuple[Row, pd.DataFrame]]:
    """Yield the runs of each condition and controller with the cells that say which they are."""
    names, headings = ordered(runs["controller"]), varied_columns(runs.columns)
    for key, place in runs.groupby(list(keys), sort=False, dropna=False) if keys else [((), runs)]:
        for name in names:
            own = place[place["controller"] == name]
            if len(own):
                row: Row = {(WHICH, "controller"): name}
                for column, value in zip(keys, key, strict=True):
                    heading, factor = headings.get(column, (column, 1.0))
                    row[WHICH, heading] = shown_value(value, factor)
                yield row, own


def _varied(runs: pd.DataFrame) -> list[str]:
    """Return the columns of conditions that differ between the runs."""
    known = (*CONDITIONS, *varied_columns(runs.columns))
    return [name for name in known if name in runs and runs[name].nunique(dropna=False) > 1]


def _columns(kind: str, runs: pd.DataFrame) -> list[tuple[str, str]]:
    """Return the metrics of a table that these runs have, each with its group, in the order of the groups."""
    return [
        (group, name)
        for group in GROUPS[kind]
        for name, metric in METRICS.items()
        if metric.tables.get(kind) == group and column_of(runs, name).notna().any()
    ]


def _median(own: pd.DataFrame, name: str, factor: float) -> Estimate:
    """Return the median of a measure; a move that never settled counts as ∞, of other measures a gap is left out."""
    if name == "settling_time_s":
        return median_with_interval(factor * settling_times(own))
    values = factor * column_of(own, name)
    return median_with_interval(values, missing="left_out") if values.notna().any() else NO_ESTIMATE


def _kind_of(word: str) -> str:
    if word in ACHIEVED:
        return "As asked"
    return "Reached the last period" if word in OUTCOMES else "Ended early"
