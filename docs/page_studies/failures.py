"""How often methods fail in ten million control periods, and what their failures have in common.

A run fails if it ends early or has not settled at its end. What it may depend on is compared between failed and other
runs: the angle by which the camera was turned, the distance from start to target, the largest condition number of the
true Jacobian on the way, and the error in the last second. The rank statistic is the chance that a failed run has the
larger value, 0.5 if it says nothing. At last the failed runs are repeated, with one thing changed at a time.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import rankdata

from page_studies.cells import by_method, ended_early, quoted, rows_by_method, settled
from page_studies.study import CALIBRATES, FIVE, Study, Words, settings, sweep
from servobench.harness.analysis.comparison import settling_times, success_rate
from servobench.harness.apps.figures.style import figure_style, method_styles, plain_logarithms
from servobench.harness.batch.results import load_runs
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve_sections, select
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.sampling import draw

CAUSES = {
    "camera_angle": "camera turned by [deg]",
    "distance": "start to target [m]",
    "jacobian_condition_max": "largest condition number",
    "steady_state_error": "error in the last second [m]",
}
FAILED = "of the failed runs settle"
METHODS = (*FIVE, CALIBRATES)
RUNS = "runs"  # the part of which failures are repeated
CHANGES = {
    "with 20 s": settings(["random.duration=20"]),
    "with 60 s": settings(["random.duration=60"]),
    "without noise": ("--noise", "0"),
    "at 40 Hz": ("--period", "0.025"),
}


def tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the rates of failure, what failed runs have in common, and how many settle with one thing changed."""
    runs = load_runs(folder / RUNS)
    runs = runs.assign(failed=settling_times(runs).isna()).merge(
        robots(runs.drop_duplicates("seed")), on="seed"
    )
    causes = {title: partial(cause_of_failure, cause=cause) for cause, title in CAUSES.items()}
    again = (
        {title: load_runs(folder / part_of(title)) for title in CHANGES}
        if runs["failed"].any()
        else {}
    )
    changed = []
    for method, own in by_method(runs):
        seeds = own.loc[own["failed"], "seed"]
        same = {
            title: each[(each["controller"] == method) & each["seed"].isin(seeds)]
            for title, each in again.items()
        }
        if len(seeds):
            counts = {title: settled(each) for title, each in same.items()}
            changed.append({FAILED: f"{quoted(method)}, of {len(seeds)}"} | counts)
    return {
        "failures": pd.DataFrame(rows_by_method(runs, RATES)),
        "failure_causes": pd.DataFrame(rows_by_method(runs, causes)),
        "failures_changed": pd.DataFrame(changed, columns=[FAILED, *CHANGES]),
    }


def pictures(folder: Path) -> dict[str, bytes]:
    """Return the picture of the errors at the end."""
    stream = io.BytesIO()
    with figure_style():
        exceedance(load_runs(folder / RUNS)).savefig(stream, format="png", dpi=110)
    return {"pictures/final_errors.png": stream.getvalue()}


def repeated(options: Words) -> Callable[[Path], Words]:
    """Return what makes the command that repeats the robots on which any method failed, with `options`."""

    def command(folder: Path) -> Words:
        runs = load_runs(folder / RUNS)
        seeds = sorted(set(runs.loc[settling_times(runs).isna(), "seed"]))
        return (
            sweep("kinematic", METHODS, "random", ",".join(map(str, seeds)) + ",", *options)
            if seeds
            else ()
        )

    return command


def robots(runs: pd.DataFrame) -> pd.DataFrame:
    """Return what was drawn for each seed: mismatch and distance; all methods meet the same robots."""
    requests = [
        RunRequest(row.plant, row.controller, row.task, row.mismatch, int(row.seed))
        for row in runs.itertuples()
    ]
    sections = resolve_sections(requests[:1], Settings())
    rows = []
    for request, text in zip(requests, runs["mismatch_values"], strict=True):
        drawn, values = draw(select(request, sections)), json.loads(text)
        distance = np.linalg.norm(
            drawn.true.feature(drawn.scenario.start) - drawn.scenario.reference.at(0.0)
        )
        rows.append((request.seed, np.degrees(abs(values["camera_angle"])), distance))
    return pd.DataFrame(rows, columns=["seed", "camera_angle", "distance"])


# With the 95 % Wilson interval
RATES = {
    "runs": lambda runs: f"{len(runs):,}",
    "periods": lambda runs: f"{runs['periods'].sum():,}",
    "ended early": lambda runs: ended_early(runs) or "0",
    "not settled": lambda runs: f"{(runs['failed'] & (runs['status'] == COMPLETED)).sum():,}",
    "failure rate [95 % interval]": lambda runs: (
        f"{success_rate(int(runs['failed'].sum()), len(runs)):.1e}"
    ),
}


def cause_of_failure(runs: pd.DataFrame, cause: str) -> str:
    """Return the medians of failed and of other runs of a method, and the rank statistic."""
    failed, values = runs["failed"].to_numpy(), runs[cause].to_numpy()
    count = failed.sum()
    if failed.all() or not count:
        return "all failed" if count else "none failed"
    larger = (rankdata(values)[failed].sum() - count * (count + 1) / 2) / (count * (~failed).sum())
    return f"{np.median(values[failed]):.3g} / {np.median(values[~failed]):.3g} ({larger:.2f})"


def part_of(title: str) -> str:
    """Return the part in which one thing is changed."""
    return title.replace(" ", "_")


def exceedance(runs: pd.DataFrame) -> Figure:
    """Draw which share of the runs has a larger error in the last second."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for method, style in method_styles(runs["controller"].unique()).items():
        errors = 1e3 * np.sort(
            runs.loc[runs["controller"] == method, "steady_state_error"].to_numpy()
        )
        shares = 1.0 - np.arange(len(errors)) / len(errors)
        axes.plot(
            errors, shares, label=method, color=style.colour, linestyle=style.line, linewidth=1.4
        )
    axes.axvline(5.0, color="black", linewidth=0.8, label="settling band, 5 mm")
    robots, (task,), (plant,) = (
        runs["seed"].nunique(),
        runs["task"].unique(),
        runs["plant"].unique(),
    )
    axes.set(
        title=f"{task} on {plant}, {robots:,} robots", xlabel="error of the last second [mm]", yscale="log",
        ylabel="share of runs with a larger error",
    )  # fmt: skip
    plain_logarithms(axes, "x")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


FAILURES = Study(
    "failures",
    "how often methods fail in ten million periods, and why",
    50,
    {RUNS: sweep("kinematic", METHODS, "random", "100000:150000")}
    | {part_of(title): repeated(options) for title, options in CHANGES.items()},
    tables,
    pictures,
)
