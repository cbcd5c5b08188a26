"""Tables that judge the controllers of a results folder: rates, medians, tails, failures, paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any, Final

import pandas as pd

from servobench.harness.analysis.statistics import (
    SETTLED,
    Estimate,
    column_of,
    compare_pairs,
    median_with_interval,
    outcomes,
    settled_share,
    settling_times,
    tail_mean,
)
from servobench.harness.config.settings import ConfigurationError, suggest
from servobench.harness.run.episode import COMPLETED

FEATURE_METRICS: Final = (
    "steady_state_error",
    "rms_error",
    "max_error",
    "rms_error_evaluated",
)  # in the feature's unit
PLACE: Final = ("plant", "task", "mismatch", "noise_factor", "latency_periods")
TAIL: Final = 0.95


def places(runs: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return the runs of each plant, task and condition, with words for it, in order of appearance."""
    known = [name for name in PLACE if name in runs]
    found = []
    for key, group in runs.groupby(known, sort=False, dropna=False):
        values: dict[str, Any] = dict(zip(known, key, strict=True))
        words = f"{values['task']} on {values['plant']}, {values['mismatch']}"
        if values.get("noise_factor", 1.0) != 1.0:
            words += f", noise × {values['noise_factor']:g}"
        latency = float(values.get("latency_periods", float("nan")))
        if math.isfinite(latency):
            words += f", latency {latency:g} periods"
        found.append((words, group))
    return found


def judge_controllers(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each controller: how often and when it settled, how bad its worst runs were, how runs failed.

    Args:
        runs: of one plant, task and condition.

    Returns:
        Columns controller, runs, settled [%], settling time [s], overshoot [%], RMS of the judged part [mm], worst 5 %
        of the final error [mm] and failures, as text; medians and rates with 95 % intervals.
    """
    rows = []
    for name, own in runs.groupby("controller", sort=False):
        ended = outcomes(own)
        failed = ended[ended != SETTLED].value_counts()
        rows.append(
            {
                "controller": name,
                "runs": str(len(own)),
                "settled, %": _text(settled_share(own), 1),
                "settling time, s": _median(settling_times(own), 1.0, 2),
                "overshoot, %": _median(own.get("overshoot"), 100.0, 1),
                "RMS end, mm": _median(own.get("rms_error_evaluated"), 1000.0, 1),
                "worst 5 %, mm": _tail(own),
                "failures": ", ".join(f"{count} {kind}" for kind, count in failed.items()) or "none",
            }
        )
    return pd.DataFrame(rows)


def usual_metric(runs: pd.DataFrame) -> str:
    """Return what the controllers of one task are compared by: settling time, or on a curve the error along it."""
    moves = column_of(runs, "overshoot").notna().any()
    return "settling_time_s" if moves or "rms_error_evaluated" not in runs else "rms_error_evaluated"


def compare_controllers(runs: pd.DataFrame, metric: str | None = None, never: float | None = None) -> pd.DataFrame:
    """Return a row for each pair of controllers: the median of their paired difference and what Wilcoxon's test says.

    Args:
        runs: of one plant, task and condition.
        metric: the column compared; by default the usual one.
        never: what a run without a value, or one that did not complete, counts as; by default twice the largest value.

    Raises:
        ConfigurationError: no such column of numbers.
    """
    pairs: Sequence[tuple[str, str]] = list(combinations(dict.fromkeys(runs["controller"]), 2))
    if not pairs:
        return pd.DataFrame()
    metric = usual_metric(runs) if metric is None else metric
    numbers = [str(name) for name in runs.select_dtypes("number").columns]
    if metric not in numbers:
        raise ConfigurationError(f"--metric: the table has no column of numbers {metric!r}: {suggest(metric, numbers)}")
    if never is None:
        known = runs[metric].dropna()
        never = 2.0 * float(known.max()) if len(known) else 1.0
    compared = compare_pairs(runs, pairs, never=never, metric=metric, keys=("seed",))
    heading, factor = _in_units(metric)
    return pd.DataFrame(
        [
            {
                "pair": f"{pair.first} − {pair.second}",
                "pairs": str(pair.difference.count),
                f"difference in {heading}": _text(_scaled(pair.difference, factor), 2),
                "p after Holm": f"{pair.corrected_p_value:.2g}",
            }
            for pair in compared
        ]
    )


def _in_units(metric: str) -> tuple[str, float]:
    """Return a column's name with a unit of handy size, and the factor to it."""
    name, _, unit = (f"{metric}_m" if metric in FEATURE_METRICS else metric).rpartition("_")
    handy, factor = {"m": ("mm", 1000.0), "s": ("s", 1.0), "us": ("µs", 1.0), "rad": ("rad", 1.0)}.get(unit, ("", 1.0))
    return (f"{name.replace('_', ' ')}, {handy}" if handy else metric.replace("_", " ")), factor


def _scaled(estimate: Estimate, factor: float) -> Estimate:
    return Estimate(factor * estimate.value, factor * estimate.low, factor * estimate.high, estimate.count)


def _median(values: pd.Series[float] | None, factor: float, digits: int) -> str:
    if values is None or values.notna().sum() == 0:
        return "–"
    return _text(median_with_interval(factor * values.astype(float)), digits)


def _tail(runs: pd.DataFrame) -> str:
    if "steady_state_error" not in runs:
        return "–"
    return f"{1000.0 * tail_mean(runs['steady_state_error'].where(runs['status'] == COMPLETED), TAIL):.1f}"


def _text(estimate: Estimate, digits: int) -> str:
    return f"{estimate.value:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"
