"""The analysed loops as a table of numbers, and as text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from servobench.harness.analysis.loops.loop_analysis import LoopAnalysis

LEGEND = (
    "Gain margin: factor on the command. Delay margin: further latency of the camera. M_s: largest singular value of "
    "the sensitivity at the feature. Disk margin: for changes of each feature by itself. A dash: the loop is unstable. "
    "Linearised loops have frozen estimators; how these adapt is not judged."
)


def loop_table(loops: Sequence[LoopAnalysis]) -> pd.DataFrame:
    """Return a row for each loop; margins of a loop that is unstable are NaN, its limits 0."""
    rows = []
    for loop in loops:
        margins, stable = loop.margins, loop.stable
        numbers = {
            "gain_margin": margins.gain,
            "gain_reduction_margin": margins.gain_reduction,
            "phase_margin_deg": np.rad2deg(margins.phase),
            "delay_margin_s": margins.delay,
            "crossover_rad_s": margins.crossover,
            "sensitivity_peak": margins.sensitivity_peak,
            "complementary_peak": margins.complementary_peak,
            "disk_margin": margins.disk,
            "overshoot": max(0.0, float(loop.step.max()) - 1.0),
        }
        known = {name: value if stable else np.nan for name, value in numbers.items()}
        rows.append(
            {"controller": loop.name, "model": loop.model, "stable": stable, **known,
             "latency_limit_s": loop.latency_limit}
        )  # fmt: skip
    return pd.DataFrame(rows)


def printed(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table as text for a terminal."""
    columns = {"controller": table["controller"], "gain\nmargin": _text(table["gain_margin"], 2)}
    if "simulated_gain_margin" in table:
        columns["gain,\nsimulated"] = _text(table["simulated_gain_margin"], 2)
        columns["latency\nlimit, ms"] = _text(1000.0 * table["latency_limit_s"], 0)
        columns["latency,\nsimulated"] = _text(1000.0 * table["simulated_latency_limit_s"], 0)
        return pd.DataFrame(columns)
    columns["phase\nmargin, °"] = _text(table["phase_margin_deg"], 0)
    columns["delay\nmargin, ms"] = _text(1000.0 * table["delay_margin_s"], 0)
    columns["peak\nM_s"] = _text(table["sensitivity_peak"], 2)
    columns["disk\nmargin"] = _text(table["disk_margin"], 2)
    columns["over-\nshoot, %"] = _text(100.0 * table["overshoot"], 0)
    return pd.DataFrame(columns)


def _text(values: pd.Series[float], digits: int) -> pd.Series[str]:
    return values.map(lambda value: "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.{digits}f}")
