"""How each column of the table of runs is shown to a reader: its name, unit and digits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import pandas as pd


@dataclass(frozen=True)
class Measure:
    """How a column of the table of runs is shown.

    Attributes:
        name: for the reader.
        unit: of the shown number; empty = that of the plant's feature, or a handier one.
        factor: from the column to `unit`.
        digits: behind the decimal point.
    """

    name: str
    unit: str
    factor: float
    digits: int

    def scale(self, runs: pd.DataFrame) -> tuple[str, float]:
        """Return the unit in which these runs are shown, and the factor to it."""
        if self.unit:
            return self.unit, self.factor
        units = runs.reindex(columns=["feature_unit"])["feature_unit"].dropna().unique().tolist()
        return HANDY_UNITS.get(units[0], (units[0], 1.0)) if len(units) == 1 else ("feature unit", 1.0)


HANDY_UNITS: Final = {"m": ("mm", 1000.0)}
MEASURES: Final = {
    "settling_time_s": Measure("settling time", "s", 1.0, 2),
    "overshoot": Measure("overshoot", "%", 100.0, 1),
    "steady_state_error": Measure("last second", "", 1.0, 2),
    "rms_error_evaluated": Measure("RMS of the evaluated part", "", 1.0, 2),
    "max_error": Measure("largest error", "", 1.0, 1),
    "path_length_ratio": Measure("path ratio", "1", 1.0, 3),
    "jacobian_error_mean": Measure("mean Jacobian error", "%", 100.0, 1),
    "control_effort_rad": Measure("control effort", "rad", 1.0, 2),
    "saturation_fraction": Measure("saturated periods", "%", 100.0, 1),
    "feature_invalid_fraction": Measure("periods without a feature", "%", 100.0, 1),
    "controller_time_median_us": Measure("controller step, median", "µs", 1.0, 0),
    "controller_time_p99_us": Measure("controller step, 99 %", "µs", 1.0, 0),
    "plant_time_median_us": Measure("plant step, median", "µs", 1.0, 0),
}
