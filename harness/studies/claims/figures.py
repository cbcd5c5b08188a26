"""The figure behind each answer: what was measured, on every plant, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.analysis.statistics import NO_ESTIMATE
from servobench.harness.pictures.draw import save_figure
from servobench.harness.pictures.places import draw_places
from servobench.harness.pictures.style import method_styles
from servobench.harness.studies.claims.measurements import Answer, Measurement

READINGS = {"ε = 0": "reading_epsilon", "entries": "reading_entries"}  # claim -> name of its figure
MAX_LABEL = 28  # characters of an ordinate's label on one line


def draw_answers(answers: Sequence[Answer], folder: Path) -> list[Path]:
    """Draw a figure for each claim, a column a plant and division, a row a measurement; return all files."""
    files = []
    for claim in dict.fromkeys(answer.claim for answer in answers):
        figure = _draw([answer for answer in answers if answer.claim == claim])
        files += save_figure(figure, folder / READINGS.get(claim, f"claim_{claim}"))
    return files


def _draw(answers: Sequence[Answer]) -> Figure:
    panels = list(dict.fromkeys(m.panel for answer in answers for m in answer.measurements))
    figure = Figure(figsize=(4.6 * len(answers), 2.6 * len(panels) + 0.6), layout="constrained")
    grid = figure.subplots(len(panels), len(answers), squeeze=False, sharey="row")
    for column, answer in enumerate(answers):
        for row, panel in enumerate(panels):
            _draw_panel(grid[row, column], [m for m in answer.measurements if m.panel == panel])
        grid[0, column].set_title(f"{answer.plant}, {answer.division}:\n{answer.verdict}")
    for row, panel in enumerate(panels):
        grid[row, 0].set_ylabel(panel if len(panel) < MAX_LABEL else panel.replace(", ", ",\n", 1))
    figure.suptitle(answers[0].title)
    return figure


def _draw_panel(axes: Axes, measured: Sequence[Measurement]) -> None:
    if not measured:
        axes.set_axis_off()
        return
    places = list(dict.fromkeys(m.place for m in measured))
    labels = list(dict.fromkeys(m.label for m in measured))
    known = {(m.label, m.place): m.estimate for m in measured}
    values = {label: [known.get((label, place), NO_ESTIMATE) for place in places] for label in labels}
    draw_places(axes, range(len(places)), values, method_styles(labels))
    axes.set_xticks(range(len(places)), places)
    axes.set_xlim(-0.6, len(places) - 0.4)
    if "−" in measured[0].panel or " over " in measured[0].panel:  # a difference or a ratio: a line at "alike"
        axes.axhline(0.0 if "−" in measured[0].panel else 1.0, color="black", linewidth=0.8)
    else:
        ends = np.array([[m.estimate.value, m.estimate.high] for m in measured])
        axes.set_ylim(0.0, 1.15 * max(1e-9, float(np.max(ends[np.isfinite(ends)], initial=0.0))))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize=7, frameon=False)
