"""How each column of the table of runs is shown to a reader: its name, unit and digits."""

from __future__ import annotations

from typing import Final, NamedTuple

import pandas as pd

HANDY_UNITS: Final = {"m": ("mm", 1000.0)}


def handy_unit(feature_unit: str | None) -> tuple[str, float]:
    """Return the unit in which errors of a feature are shown, and the factor to it; None is an unknown unit."""
    return HANDY_UNITS.get(feature_unit or "", (feature_unit or "feature unit", 1.0))


def settling_band(runs: pd.DataFrame, factor: float = 1.0) -> str:
    """Return the settling band of these runs times a factor with its unit, `5 mm`; words where they have several."""
    known = runs.reindex(columns=["settling_band", "feature_unit"]).dropna().drop_duplicates()
    if len(known) != 1:
        return "the settling band" if factor == 1.0 else f"{factor:g} settling bands"
    (band,), (unit,) = known["settling_band"], known["feature_unit"]
    name, handy = handy_unit(str(unit))
    return f"{factor * handy * float(band):.3g} {name}"


class Measure(NamedTuple):
    """How a column of the table of runs is shown; where `unit` is None, in the unit of the plant's feature."""

    name: str
    digits: int  # behind the decimal point
    unit: str | None = None
    factor: float = 1.0  # from the column to `unit`

    def scale(self, runs: pd.DataFrame) -> tuple[str, float]:
        """Return the unit in which these runs are shown, and the factor to it."""
        if self.unit:
            return self.unit, self.factor
        units = runs.reindex(columns=["feature_unit"])["feature_unit"].dropna().unique().tolist()
        return (" or ".join(units), 1.0) if len(units) > 1 else handy_unit(units[0] if units else None)


MEASURES: Final = {
    "settling_time_s": Measure("settling time", 2, "s"),
    "overshoot": Measure("overshoot", 1, "%", 100.0),
    "steady_state_error": Measure("last second", 2),
    "rms_error_second_lap": Measure("RMS of the second lap", 2),
    "rms_error_evaluated": Measure("RMS of the judged part", 2),
    "max_error": Measure("largest error", 1),
    "pose_error_mm": Measure("pose error, last second", 1, "mm"),
    "pose_error_deg": Measure("angle error, last second", 2, "deg"),
    "path_length_ratio": Measure("path ratio", 3, "1"),
    "jacobian_error_mean": Measure("mean Jacobian error", 1, "%", 100.0),
    "max_joint_position_rad": Measure("largest joint position", 2, "rad"),
    "control_effort_rad": Measure("control effort", 2, "rad"),
    "saturation_fraction": Measure("saturated periods", 1, "%", 100.0),
    "joint_acceleration_peak_rad_s2": Measure("peak acceleration", 1, "rad/s²"),
    "joint_acceleration_rms_rad_s2": Measure("RMS acceleration", 2, "rad/s²"),
    "joint_jerk_peak_rad_s3": Measure("peak jerk", 0, "rad/s³"),
    "joint_jerk_rms_rad_s3": Measure("RMS jerk", 1, "rad/s³"),
    "command_switches": Measure("sign switches", 0, "1"),
    "feature_invalid_fraction": Measure("periods without a feature", 1, "%", 100.0),
    "controller_time_median_us": Measure("controller step, median", 0, "µs"),
    "controller_time_p99_us": Measure("controller step, 99 %", 0, "µs"),
    "controller_time_overruns": Measure("steps over the period", 0, "1"),
    "plant_time_median_us": Measure("plant step, median", 0, "µs"),
}


def in_handy_units(runs: pd.DataFrame) -> pd.DataFrame:
    """Return runs of several units with the errors of each in its handy one; runs of one unit as they are."""
    units = runs.reindex(columns=["feature_unit"])["feature_unit"]
    if units.nunique() < 2:
        return runs
    handy = [handy_unit(unit if isinstance(unit, str) else None) for unit in units]
    factors = [factor for _, factor in handy]
    errors = [name for name, measure in MEASURES.items() if measure.unit is None and name in runs]
    changed = {name: factors * runs[name] for name in errors}
    return runs.assign(feature_unit=[unit for unit, _ in handy], **changed)
