"""What a command that carries out runs prints at its end: a table for each place, and what its words mean."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import pandas as pd

from servobench.harness.analysis.comparison import achievement, column_of, outcomes, split_tasks, with_places
from servobench.harness.analysis.measures import MEASURES, settling_band
from servobench.harness.analysis.statistics import MISSING
from servobench.harness.analysis.tables import CONDITIONS, Tables
from servobench.harness.run.outcome import ACHIEVED, FOLLOWED, FOLLOWING_BANDS, SETTLED

BAND: Final = ("settling_band", "feature_unit")
SWEEP_COLUMNS: Final = (
    *CONDITIONS,
    "sensing",
    "task",
    "controller",
    "status",
    "outcome",
    "settling_time_s",
    "task_kind",
    "rms_error_evaluated",
    *BAND,
)  # what `sweep_tables` and `outcome_legend` read
LATE: Final = "*"  # mark of a controller of which a step took longer than the period
SWEEP_KEYS: Final = ["plant", "task", "mismatch", "noise", "latency", "period", "controller"]


def outcome_legend(parts: Iterable[pd.DataFrame]) -> str:
    """Return what the good outcomes of runs mean, whose table comes in pieces."""
    bands = pd.concat([part.reindex(columns=list(BAND)).drop_duplicates() for part in parts])
    return (
        f"{SETTLED}: came within {settling_band(bands)} and stayed; "
        f"{FOLLOWED}: RMS error of the judged part at most {settling_band(bands, FOLLOWING_BANDS)}"
    )


def summary_legend(runs: pd.DataFrame) -> str:
    """Return what the words in `summary_tables` mean."""
    late = f"; {LATE} some steps took longer than the period" if _is_late(runs) else ""
    switches = "switches: joint commands that change sign between large values within two periods"
    return f"{outcome_legend([runs])}; over: overshoot; {switches}; numbers are medians over runs{late}"


def sweep_legend(parts: Iterable[pd.DataFrame]) -> str:
    """Return what the words in `sweep_tables` mean."""
    return f"{outcome_legend(parts)}; noise: factor; latency, period: ms, – as configured"


def summary_tables(runs: pd.DataFrame) -> Tables:
    """Yield what a comparison ends with: a table for each plant, mismatch and task, a row for each controller."""
    for (plant, mismatch, task), place in with_places(runs).groupby(["plant", "mismatch", "task"], sort=False):
        rows = []
        for name, own in place.groupby("controller", sort=False):
            unit, factor = MEASURES["rms_error_evaluated"].scale(place)
            if achievement(place) == FOLLOWED:
                special = {
                    f"RMS lap 2\n{unit}": _middle(own, "rms_error_second_lap", factor, 1),
                    "joints\nrad": _middle(own, "max_joint_position_rad", 1.0, 2),
                }
            else:
                special = {
                    "after\ns": _middle(own, "settling_time_s", 1.0, 2),
                    "over\n%": _middle(own, "overshoot", 100.0, 0),
                }
            rows.append(
                {
                    "controller": str(name),
                    "outcome": _shares(own),
                    **special,
                    f"RMS end\n{unit}": _middle(own, "rms_error_evaluated", factor, 1),
                    "switches": _middle(own, "command_switches", 1.0, 0),
                    "step\nµs": _middle(own, "controller_time_median_us", 1.0, 0) + (LATE if _is_late(own) else ""),
                }
            )
        yield f"{task} on {plant}, {mismatch}", pd.DataFrame(rows)


def _shares(runs: pd.DataFrame) -> str:
    """Return the outcome that all runs have, or a line for each outcome with its share."""
    shares = 100.0 * outcomes(runs).value_counts(normalize=True)
    return shares.index[0] if len(shares) == 1 else "\n".join(f"{share:.0f} % {word}" for word, share in shares.items())


def sweep_tables(parts: Iterable[pd.DataFrame]) -> Tables:
    """Yield what a sweep ends with, for each plant and task.

    That is the share of settled runs, or of those that followed their curve, a row for each condition; and where there
    are others, the share of each outcome over all conditions.

    Args:
        parts: pieces of the table of runs; only numbers of runs are kept of each.
    """
    counted, curves = [], set[str]()
    for part in parts:
        counted.append(_count_outcomes(part))
        curves |= set(split_tasks(part)[1]["task"])
    counts = pd.concat(counted).groupby([*SWEEP_KEYS, "outcome"], sort=False, as_index=False)["runs"].sum()
    for (plant, task), place in counts.groupby(["plant", "task"], sort=False):
        good = place["runs"].where(place["outcome"].isin(ACHIEVED), 0)
        sums = place.assign(good=good).groupby(SWEEP_KEYS[2:], sort=False)[["good", "runs"]].sum()
        table = (100.0 * sums["good"] / sums["runs"]).unstack(sort=False).map(_percent)
        table["runs"] = sums["runs"].unstack(sort=False).max(axis=1).map("{:.0f}".format)
        word = FOLLOWED if task in curves else SETTLED
        shares = table.rename_axis(columns=None).reset_index()
        if (shares["period"] == MISSING).all():
            del shares["period"]
        yield f"{task} on {plant}: {word}, %", shares
        if good.sum() < place["runs"].sum():
            kinds = place.pivot_table(values="runs", index="controller", columns="outcome", aggfunc="sum", sort=False)
            table = (100.0 * kinds.div(kinds.sum(axis=1), axis=0)).map(_percent)
            yield f"{task} on {plant}: what came of the runs, %", table.rename_axis(columns=None).reset_index()


def _percent(value: float) -> str:
    return MISSING if pd.isna(value) else f"{value:.1f}"


def _count_outcomes(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how many runs of each condition had which outcome."""
    runs = with_places(runs).assign(
        outcome=outcomes(runs),
        noise=runs["noise_factor"].map("{:g}".format),
        latency=_milliseconds(runs["latency_s"]),
        period=_milliseconds(runs["period_s"]),
    )
    return runs.groupby([*SWEEP_KEYS, "outcome"], sort=False).size().rename("runs").reset_index()


def _milliseconds(times: pd.Series[float]) -> list[str]:
    return [MISSING if pd.isna(time) else f"{1e3 * time:g}" for time in times]


def _is_late(runs: pd.DataFrame) -> bool:
    """Return whether a step of a controller took longer than the control period."""
    return bool((column_of(runs, "controller_time_overruns") > 0.0).any())


def _middle(runs: pd.DataFrame, name: str, factor: float, digits: int) -> str:
    value = column_of(runs, name).median()
    return MISSING if pd.isna(value) else f"{factor * value:.{digits}f}"
