"""Pictures of analysed loops: Bode, Nyquist, sensitivity, step, limits of gain over latency; and a page of them."""

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from servobench.harness.apps.figures.style import (
    add_legend,
    drawing_of,
    figure_style,
    method_styles,
    plain_logarithms,
    save_figure,
)
from servobench.harness.apps.loops.loop_analysis import LoopAnalysis
from servobench.harness.apps.loops.systems import largest_gain, loci, sensitivity
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.facts import read_beside
from servobench.plant.contract.files import write_text

PAGE = "analyse.html"
TEMPLATE = "loops.html"
FIGURES = "figures"
LATENCIES: FloatArray = np.linspace(0.0, 0.5, 21)  # [s]
FACTORS: FloatArray = np.geomspace(0.1, 10.0, 41)  # [1] factors on the command
# [1] M_s at the edges of the colours; above 2 a loop is hardly robust.
PEAKS = (1.0, 1.2, 1.4, 1.7, 2.0, 3.0, 5.0, 20.0)
COLUMNS = 3
SHEET = read_beside(__file__, "pictures.toml")
LINES = SHEET["lines"]


def draw_loops(loops: Sequence[LoopAnalysis]) -> Figure:
    """Draw the loops side by side."""
    figure = Figure(figsize=(11.0, 6.6), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    magnitude, nyquist, peaks, phase, step, limits = panels
    styles = method_styles([loop.name for loop in loops])
    for loop in loops:
        style = styles[loop.name]
        frequency = loop.response.frequency
        L = loop.response.at_feature()
        look = style.line_arguments(len(frequency))
        for i, curve in enumerate(loci(L).T):
            label = loop.name if i == 0 else None  # the loci of a loop share an entry of the legend
            magnitude.plot(frequency, np.abs(curve), label=label, **look)
            phase.plot(frequency, _falling_phase(curve), **look)
            nyquist.plot(curve.real, curve.imag, **(look | {"marker": ""}))
        peaks.plot(frequency, largest_gain(sensitivity(L)), **look)
        if loop.stable:
            time = np.arange(len(loop.step)) * loop.arm.period
            for curve in loop.step.T:
                step.plot(time, curve, **style.line_arguments(len(time)))
        limits.plot(
            1000.0 * LATENCIES,
            loop.gain_limits(LATENCIES.tolist()),
            **style.line_arguments(len(LATENCIES)),
        )
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    nyquist.plot(np.cos(angle), np.sin(angle), **LINES["unit_circle"])
    nyquist.plot(-1.0, 0.0, **LINES["critical"])
    magnitude.axhline(1.0, **LINES["usual"])
    phase.axhline(-180.0, **LINES["usual"])
    limits.axhline(1.0, **LINES["usual"])
    latency = 1000.0 * loops[0].arm.latency
    limits.axvline(latency, linestyle=(0, (2, 2)), **LINES["usual"])
    for axes, settings in zip(panels, SHEET["panels"].values(), strict=True):
        axes.set(**settings)
    for axes in (magnitude, peaks, limits):
        plain_logarithms(axes)
    add_legend(figure, [magnitude])
    return figure


def draw_stability_map(loops: Sequence[LoopAnalysis]) -> Figure:
    """Draw M_s over gain and latency, a panel for each loop."""
    rows = math.ceil(len(loops) / COLUMNS)
    columns = min(len(loops), COLUMNS)
    figure = Figure(figsize=(3.6 * columns + 0.8, 2.9 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    norm = mpl.colors.BoundaryNorm(PEAKS, 256)
    for axes, loop in zip(grid.flat, loops, strict=False):
        peaks = np.minimum(loop.sensitivity_peaks(FACTORS, LATENCIES.tolist()), 2.0 * PEAKS[-1])
        limits = loop.gain_limits(LATENCIES.tolist())
        unstable = FACTORS[:, None] >= limits[None, :]
        axes.pcolormesh(
            1000.0 * LATENCIES,
            FACTORS,
            np.where(unstable, np.nan, peaks),
            norm=norm,
            **SHEET["map"],
        )
        axes.plot(1000.0 * LATENCIES, limits, color="black", linewidth=1.4)
        axes.plot(1000.0 * loop.arm.latency, 1.0, **LINES["present"])
        axes.set(title=loop.name, ylim=(FACTORS[0], FACTORS[-1]))
        axes.set(xlabel="latency of the camera [ms]", ylabel="factor on the command")
        axes.label_outer()
        axes.grid(visible=False)
        plain_logarithms(axes)
    for axes in grid.flat[len(loops) :]:
        axes.set_axis_off()
    figure.colorbar(
        mpl.cm.ScalarMappable(norm, SHEET["map"]["cmap"]), ax=grid, label="M_s", format="%g"
    )
    return figure


def write_pictures(
    folder: Path, loops: Sequence[LoopAnalysis], table: pd.DataFrame, legend: str
) -> list[Path]:
    """Write the pictures of at least one loop as PNG and PDF, and a page of them with their table and its legend.

    Returns:
        The files, the page first.
    """
    with figure_style():
        figures = {"loops": draw_loops(loops), "stability_map": draw_stability_map(loops)}
    paths = []
    for name, figure in figures.items():
        paths += save_figure(figure, folder / FIGURES / name)
    fields: dict[str, object] = {}
    for name, figure in figures.items():
        drawing = drawing_of(figure)._asdict()
        fields |= {f"{name}_{key}": value for key, value in drawing.items()}
    fields["table"] = table.rename(columns=one_line).to_html(index=False, border=0)
    fields["legend"] = escape(legend)
    template = Template((Path(__file__).parent / TEMPLATE).read_text(encoding="utf-8"))
    text = template.substitute(fields)
    page = folder / PAGE
    write_text(page, text)
    return [page, *paths]


def one_line(heading: str) -> str:
    """Return a heading without the breaks that a terminal needs, also within a word."""
    return heading.replace("-\n", "").replace("\n", " ")


def _falling_phase(curve: FloatArray) -> FloatArray:
    """Return the phase of a locus without jumps, [°], that begins between −270 and 90."""
    phase = np.rad2deg(np.unwrap(np.angle(curve)))
    return phase - 360.0 * np.ceil((phase[0] - 90.0) / 360.0)
