"""How often methods fail in ten million control periods, and what their failures have in common.

    servobench sweep --plants kinematic --controllers ... --seeds 100000:150000 --out results/rates
    python docs/failure_rates.py results/rates docs/pictures    # prints the table, draws three pictures

A run fails if it ends early or has not settled at its end. What it may depend on is compared between failed and other
runs: the angle by which the camera was turned, the distance from start to target, the largest condition number of the
true Jacobian on the way, and the error in the last second. The rank statistic is the chance that a failed run has the
larger value, 0.5 if it says nothing.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import rankdata

from servobench.harness.analysis.comparison import settling_times
from servobench.harness.analysis.statistics import success_rate
from servobench.harness.batch.results import load_runs
from servobench.harness.config.settings import Settings
from servobench.harness.pictures.style import figure_style, method_styles
from servobench.harness.run.experiment import draw
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolved import resolve_sections, select

CAUSES = {
    "camera_angle": "camera turned by [deg]",
    "distance": "start to target [m]",
    "jacobian_condition_max": "largest condition number",
    "steady_state_error": "error in the last second [m]",
}
SHARES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 1.0)  # of runs, where bins of causes end


def main(folder: Path, pictures: Path) -> None:
    """Print the two tables of a sweep and draw its three pictures."""
    runs = judged(load_runs(folder))
    print("\n".join([*rate_table(runs), "", *cause_table(runs)]))  # noqa: T201 - the output of the command
    pictures.mkdir(parents=True, exist_ok=True)
    for name, figure in (
        ("final_errors", exceedance(runs)),
        ("failures_by_condition", by_cause(runs, "jacobian_condition_max")),
        ("failures_by_target", by_target(runs)),
    ):
        figure.savefig(pictures / f"{name}.png", dpi=110)


def judged(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs with whether they failed, and with what that may depend on."""
    drawn = robots(runs.drop_duplicates("seed"))
    runs = runs.assign(failed=settling_times(runs).isna())
    return runs.merge(drawn, on="seed")


def robots(runs: pd.DataFrame) -> pd.DataFrame:
    """Return what was drawn for each seed: mismatch, distance and target; all methods meet the same robots."""
    requests = [
        RunRequest(row.plant, row.controller, row.task, row.mismatch, int(row.seed)) for row in runs.itertuples()
    ]
    sections = resolve_sections(requests[:1], Settings())
    rows = []
    for request, text in zip(requests, runs["mismatch_values"], strict=True):
        drawn, values = draw(select(request, sections)), json.loads(text)
        target = drawn.scenario.reference.at(0.0)
        x, y, _ = drawn.true.to_base(target)
        distance = np.linalg.norm(drawn.true.feature(drawn.scenario.start) - target)
        rows.append((request.seed, np.degrees(abs(values["camera_angle"])), distance, x, y))
    return pd.DataFrame(rows, columns=["seed", "camera_angle", "distance", "x", "y"])


def rate_table(runs: pd.DataFrame) -> Iterator[str]:
    """Yield the rows of the table of failure rates with 95 % Wilson intervals."""
    yield "| method | runs | periods | ended early | not settled | failure rate [95 % interval] |"
    yield "|---|---|---|---|---|---|"
    for method, own in runs.groupby("controller", sort=False):
        early = own["status"] != "completed"
        kinds = ", ".join(f"{count} {kind}" for kind, count in own.loc[early, "status"].value_counts().items())
        rate = success_rate(int(own["failed"].sum()), len(own))
        cells = (
            f"{len(own):,}",
            f"{own['periods'].sum():,}",
            kinds or "0",
            f"{(own['failed'] & ~early).sum():,}",
            f"{rate:.1e}",
        )
        yield f"| `{method}` | {' | '.join(cells)} |"


def cause_table(runs: pd.DataFrame) -> Iterator[str]:
    """Yield the rows of the table of causes: medians of failed and other runs, and the rank statistic."""
    yield f"| method | {' | '.join(CAUSES.values())} |"
    yield f"|---|{'---|' * len(CAUSES)}"
    for method, own in runs.groupby("controller", sort=False):
        failed = own["failed"].to_numpy()
        if failed.all() or not failed.any():
            continue
        cells = []
        for cause in CAUSES:
            values = own[cause].to_numpy()
            ranks, count = rankdata(values), failed.sum()
            larger = (ranks[failed].sum() - count * (count + 1) / 2) / (count * (~failed).sum())
            cells.append(f"{np.median(values[failed]):.3g} / {np.median(values[~failed]):.3g} ({larger:.2f})")
        yield f"| `{method}` | {' | '.join(cells)} |"


def exceedance(runs: pd.DataFrame) -> Figure:
    """Draw which share of the runs has a larger error in the last second."""
    with figure_style():
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for method, style in method_styles(runs["controller"].unique()).items():
            errors = 1e3 * np.sort(runs.loc[runs["controller"] == method, "steady_state_error"].to_numpy())
            shares = 1.0 - np.arange(len(errors)) / len(errors)
            axes.plot(errors, shares, label=method, color=style.colour, linestyle=style.line, linewidth=1.4)
        axes.axvline(5.0, color="black", linewidth=0.8)
        axes.set(xlabel="error in the last second [mm]", ylabel="share of runs above", xscale="log", yscale="log")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return figure


def by_cause(runs: pd.DataFrame, cause: str) -> Figure:
    """Draw the failure rate over a cause with its 95 % interval, in bins that get finer where few runs are."""
    with figure_style():
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for method, style in method_styles(runs["controller"].unique()).items():
            own = runs[runs["controller"] == method]
            bins = own.groupby(pd.qcut(own[cause], SHARES, duplicates="drop"), observed=True)
            places = [(part[cause].median(), success_rate(int(part["failed"].sum()), len(part))) for _, part in bins]
            seen = [(place, rate) for place, rate in places if rate.value > 0.0]
            x, y = np.array([place for place, _ in seen]), np.array([rate.value for _, rate in seen])
            reach = [y - [rate.low for _, rate in seen], [rate.high for _, rate in seen] - y] if seen else None
            look = {"color": style.colour, "linestyle": style.line, "marker": style.marker, "markersize": 4.5}
            label = method if seen else f"{method}: none"
            axes.errorbar(x, y, yerr=reach, label=label, linewidth=1.4, capsize=2.0, **look)
        axes.set(xlabel=CAUSES[cause], ylabel="failure rate", xscale="log", yscale="log")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return figure


def by_target(runs: pd.DataFrame) -> Figure:
    """Draw where the targets of failed runs lie, seen from above, in the base frame."""
    methods = list(runs["controller"].unique())
    with figure_style():
        figure = Figure(figsize=(2.3 * len(methods), 3.3), layout="constrained")
        panels = np.atleast_1d(figure.subplots(1, len(methods), sharex=True, sharey=True))
        everywhere = runs.drop_duplicates("seed")
        for axes, (method, style) in zip(panels, method_styles(methods).items(), strict=True):
            failed = runs[(runs["controller"] == method) & runs["failed"]]
            axes.hexbin(everywhere["x"], everywhere["y"], gridsize=24, cmap="Greys", alpha=0.5, linewidths=0.0)
            axes.plot(failed["x"], failed["y"], ".", color=style.colour, markersize=3.0)
            axes.set(title=f"{method}: {len(failed)}", xlabel="x [m]", aspect="equal")
        panels[0].set_ylabel("y [m]")
        return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
