"""The settings that a run varies: their keys, their short names, and their columns in the table of runs."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias


class ShortName(NamedTuple):
    """A short name for a setting that sweeps often vary; it has a column of its own, and a part of the run's name."""

    key: str  # key of the setting, `SECTION.KEY`
    column: str  # in the table of runs
    heading: str  # heading of this column where it is shown, with the unit
    usual: float | None = None  # in this column for runs that do not vary the setting
    scale: float = 1e3  # from the value to the number that is shown
    unit: str = "ms"  # unit of this number


SHORT_NAMES: Mapping[str, ShortName] = {
    "noise": ShortName("plant.sensing.noise_factor", "noise_factor", "noise factor", 1.0, 1.0, ""),
    "latency": ShortName("plant.sensing.latency", "latency_s", "latency [ms]"),
    "period": ShortName("run.period", "period_s", "period [ms]"),
}
ROLES = ("plant", "controller", "task")
# The beginnings of the key of a varied setting.
SECTIONS = ("run.", *(f"{role}." for role in ROLES))
ORDER = {short.key: order for order, short in enumerate(SHORT_NAMES.values())}

Row: TypeAlias = Mapping[str, Any]  # of the table of runs, by its columns
Value: TypeAlias = float | int | bool | str | tuple["Value", ...]
Varied: TypeAlias = tuple[tuple[str, Value], ...]


def varied_in_row(row: Row) -> Varied:
    """Return the settings that a run varies, by key, from its row in a table of runs."""
    columns = [(short.column, short.key, short.usual) for short in SHORT_NAMES.values()]
    columns += [(key, key, None) for key in row if "." in key]
    varied = {}
    for column, key, usual in columns:
        value = row.get(column)
        if value in (None, usual):
            continue
        if str(value).startswith("["):  # the JSON text of a list
            value = json.loads(value)
        if not (isinstance(value, float) and math.isnan(value)):
            varied[key] = value
    return tuple(varied.items())


def varied_columns(columns: Iterable[str]) -> dict[str, tuple[str, float]]:
    """Return the columns of settings that a run may vary with their headings and scales, those of short names first.

    Args:
        columns: of a table of runs.
    """
    known = {short.column: (short.heading, short.scale) for short in SHORT_NAMES.values()}
    known |= {name: (name, 1.0) for name in columns if name.startswith(SECTIONS)}
    return {name: known[name] for name in known if name in set(columns)}


def words_in_name(varied: tuple[str, Value]) -> str:
    """Return the part of a run's name that says one varied setting; empty for the usual value of a short name."""
    key, value = varied
    for name, short in SHORT_NAMES.items():
        if short.key == key and isinstance(value, int | float):
            if value == short.usual:
                return ""
            return f"-{name}{short.scale * value:.12g}{short.unit}"
    return f"-{key}={value}"
