"""Tables of runs for a reader: in the terminal, on a page, in the report. Numbers are in handy units."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations
from typing import Any, Final

import numpy as np
import pandas as pd

from servobench.harness.analysis.cells import Cell, Row, as_text
from servobench.harness.analysis.comparison import (
    achieved_share,
    achievement,
    column_of,
    compare_pairs,
    outcomes,
    settled_share,
    settling_times,
    split_conditions,
    split_tasks,
)
from servobench.harness.analysis.measures import MEASURES, Measure
from servobench.harness.analysis.statistics import (
    MISSING,
    NO_ESTIMATE,
    Estimate,
    median_with_interval,
    success_rate,
    tail_mean,
)
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.ending import COMPLETED
from servobench.harness.run.outcome import ACHIEVED
from servobench.plant.settings import suggest

Tables = Iterator[tuple[str, pd.DataFrame]]  # title, rows of text


SWEPT: Final = ("noise_factor", "latency_s", "period_s")  # shown where they vary
CONDITIONS: Final = ("plant", "mismatch", *SWEPT)
COSTS: Final = (
    "controller_time_median_us",
    "controller_time_p99_us",
    "controller_time_overruns",
    "control_effort_rad",
    "saturation_fraction",
    "joint_acceleration_peak_rad_s2",
    "joint_acceleration_rms_rad_s2",
    "joint_jerk_rms_rad_s3",
    "command_switches",
    "jacobian_error_mean",
)
CURVE_MEASURES: Final = ("rms_error_second_lap", "rms_error_evaluated", "max_error", "max_joint_position_rad")
TAIL: Final = 0.95
MAX_REASON: Final = 60  # characters of a reason that are shown in a table


def statistics_tables(runs: pd.DataFrame, metric: str | None = None, never: float | None = None) -> Tables:
    """Yield for each plant, task and condition how each controller does, and how each pair of them differs."""
    for words, controllers, pairs in statistics_rows(runs, metric, never):
        yield words, as_text(controllers)
        if pairs:
            yield "pairs", as_text(pairs)


def statistics_rows(
    runs: pd.DataFrame, metric: str | None = None, never: float | None = None
) -> Iterator[tuple[str, list[Row], list[Row]]]:
    """Yield for each plant, task and condition its words, a row for each controller and one for each pair of them."""
    for words, place in split_conditions(runs):
        yield words, _controller_rows(place), _pair_rows(place, metric, never)


def judge_controllers(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each controller: how often and when it settled, its worst runs, and how runs failed.

    Args:
        runs: of one plant, task and condition.

    Returns:
        Text; medians and rates have 95 % intervals. Errors are in the unit of the plant's feature or a handier one.
    """
    return as_text(_controller_rows(runs))


def _controller_rows(runs: pd.DataFrame) -> list[Row]:
    unit, factor = MEASURES["steady_state_error"].scale(runs)
    rows: list[Row] = []
    for name, own in runs.groupby("controller", sort=False):
        ended = outcomes(own)
        failed = ended[~ended.isin(ACHIEVED)].value_counts()
        final = column_of(own, "steady_state_error").where(own["status"] == COMPLETED)
        rows.append(
            {
                "controller": Cell(str(name)),
                "runs": Cell(len(own)),
                f"{achievement(runs)}, %": Cell(achieved_share(own), ".1f"),
                "settling time, s": Cell(_median(settling_times(own)), ".2f"),
                "overshoot, %": Cell(_median(100.0 * column_of(own, "overshoot")), ".1f"),
                f"RMS end, {unit}": Cell(_median(factor * column_of(own, "rms_error_evaluated")), ".1f"),
                f"worst 5 %, {unit}": Cell(factor * tail_mean(final, TAIL), ".1f"),
                "failures": Cell(", ".join(f"{count} {kind}" for kind, count in failed.items()) or "none"),
            }
        )
    return rows


def compare_controllers(runs: pd.DataFrame, metric: str | None = None, never: float | None = None) -> pd.DataFrame:
    """Return a row for each pair of controllers: the median of their paired difference and Wilcoxon's p-value.

    Args:
        runs: of one plant, task and condition.
        metric: column that is compared; by default the settling time, on a curve the error along it.
        never: stands for the value of a run without one, or that did not complete; by default twice the largest value.

    Raises:
        ConfigurationError: no such column of numbers.
    """
    return as_text(_pair_rows(runs, metric, never))


def _pair_rows(runs: pd.DataFrame, metric: str | None, never: float | None) -> list[Row]:
    pairs = list(combinations(dict.fromkeys(runs["controller"]), 2))
    if not pairs:
        return []
    if metric is None:
        metric = "rms_error_evaluated" if len(split_tasks(runs)[1]) else "settling_time_s"
    numbers = [str(name) for name in runs.select_dtypes("number").columns]
    if metric not in numbers:
        raise ConfigurationError(f"--metric: the table has no column of numbers {metric!r}: {suggest(metric, numbers)}")
    if never is None:
        known = runs[metric].dropna()
        never = 2.0 * float(known.max()) if len(known) else 1.0
    compared = compare_pairs(runs, pairs, never=never, metric=metric, keys=("seed",))
    measure = MEASURES.get(metric, Measure(metric.replace("_", " "), 2, "1"))
    unit, factor = measure.scale(runs)
    what = measure.name if unit == "1" else f"{measure.name}, {unit}"
    return [
        {
            "pair": Cell(f"{pair.first} − {pair.second}"),
            "pairs": Cell(pair.difference.count),
            f"difference in {what}": Cell(pair.difference.scaled(factor), ".2f"),
            "p after Holm": Cell(pair.corrected_p_value, ".2g"),
        }
        for pair in compared
    ]


def outcome_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each condition, task and controller how many runs had which outcome, in percent."""
    named = runs.assign(outcome=outcomes(runs))
    words = named["outcome"].value_counts().index
    rows = []
    for key, group in _groups(named, "task"):
        counts = {word: int((group["outcome"] == word).sum()) for word in words}
        shares = {
            word: f"{success_rate(n, len(group)).scaled(100.0):.0f}" if n else MISSING for word, n in counts.items()
        }
        rows.append(key | {"runs": len(group)} | {f"{word} [%]": share for word, share in shares.items()})
    return pd.DataFrame(rows)


def settling_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each condition and controller how many moves settled, how fast, and with what error."""
    moves, _ = split_tasks(runs)
    rows = []
    for key, group in _groups(moves):
        share = settled_share(group)
        counts = {
            "moves": len(group),
            "settled": int(settling_times(group).notna().sum()),
            "settled [%]": round(share.value),
            "settled, 95 %": f"{share.low:.0f} – {share.high:.0f}",
        }
        rows.append(key | counts | _medians(group, moves, "settling_time_s", "overshoot", "steady_state_error"))
    return pd.DataFrame(rows)


def tracking_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each condition, task and controller the errors along the curve."""
    _, curves = split_tasks(runs)
    rows = []
    for key, group in _groups(curves, "task"):
        counts = {"runs": len(group), "completed": int((group["status"] == COMPLETED).sum())}
        rows.append(key | counts | _medians(group, curves, *filter(partial(_is_informative, curves), CURVE_MEASURES)))
    return pd.DataFrame(rows)


def cost_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return for each plant and controller what a step costs, as far as known, and how much the joints are used."""
    rows = []
    for (plant, controller), group in runs.groupby(["plant", "controller"], sort=False):
        row: dict[str, Any] = {"plant": plant, "controller": controller}
        for name in filter(partial(_is_informative, runs), COSTS):
            heading, factor, digits = _shown(name, runs)
            row[heading] = _rounded(factor * column_of(group, name).median(), digits)
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
    """Return every run as a row: conditions, how it ended, and its measures."""
    names = (*CONDITIONS, "task", "controller", "seed", "status", "outcome")
    table = runs[[name for name in names if _is_informative(runs, name)]].copy()
    for name in MEASURES:
        if _is_informative(runs, name):
            heading, factor, digits = _shown(name, runs)
            table[heading] = (factor * runs[name].astype(float)).round(digits)
    if "reason" in runs and (runs["reason"].fillna("") != "").any():
        table["reason"] = [
            text if len(text) <= MAX_REASON else f"{text[: MAX_REASON - 1]}…" for text in runs["reason"].fillna("")
        ]
    return table.reset_index(drop=True)


def _groups(runs: pd.DataFrame, *more: str) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    names = [name for name in (*CONDITIONS, *more, "controller") if _is_informative(runs, name)]
    grouped = runs.groupby(names, sort=False, dropna=False)
    return [(dict(zip(names, key, strict=True)), group) for key, group in grouped]


def _is_informative(runs: pd.DataFrame, name: str) -> bool:
    """Return whether there is such a column with a value and, where only a sweep varies it, more than one."""
    return name in runs and runs[name].nunique() > (name in SWEPT)


def _shown(name: str, runs: pd.DataFrame) -> tuple[str, float, int]:
    """Return heading, factor and digits of a column of `runs`."""
    measure = MEASURES[name]
    unit, factor = measure.scale(runs)
    return measure.name if unit == "1" else f"{measure.name} [{unit}]", factor, measure.digits


def _medians(group: pd.DataFrame, runs: pd.DataFrame, *names: str) -> dict[str, Any]:
    """Return medians of columns under their headings in `runs`, each with its interval behind it where there is one.

    A move that never settled counts as one that settles after all others, ∞; of other measures a gap is left out.
    """
    cells: dict[str, Any] = {}
    for name in names:
        heading, factor, digits = _shown(name, runs)
        if name == "settling_time_s":
            middle = median_with_interval(factor * settling_times(group))
        else:
            values = factor * column_of(group, name)
            middle = median_with_interval(values, missing="left_out") if values.notna().any() else NO_ESTIMATE
        interval = "" if np.isnan(middle.low) else f"{middle.low:.{digits}f} – {middle.high:.{digits}f}"
        cells[heading] = _rounded(middle.value, digits)
        cells[f"{MEASURES[name].name}, 95 %"] = interval.replace("inf", "∞")
    return cells


def _rounded(value: float, digits: int) -> float:
    return round(float(value), digits) if digits or np.isnan(value) else float(round(value))


def _median(values: pd.Series[float]) -> Estimate:
    """Return the median of a column, a missing value counting as ∞; no estimate where all are missing."""
    return median_with_interval(values) if values.notna().any() else NO_ESTIMATE
