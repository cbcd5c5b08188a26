"""The logged steps of a results folder, arranged as figures want them: by plant and mismatch, task and controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import with_places
from servobench.harness.analysis.measures import handy_unit
from servobench.harness.batch import results
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.checks import FloatArray

FEATURE = "feature_"
LONG = 6000  # [rows] of a run that is not drawn row by row
OVERVIEW = 600  # [rows] about, that stand for a long run
CLOSING = 400  # [rows] at the end of a long run that are drawn one by one: two laps at the default period
ROOT_MEAN_SQUARES = (
    "error_norm",
    "jacobian_error",
)  # of which a row of an overview has that of all rows for which it stands


@dataclass(frozen=True, eq=False)
class Track:
    """The steps of one run.

    Attributes:
        row: its row in the table of runs.
        table: its steps, at least one; columns without any value are left out.
    """

    row: Mapping[str, Any]
    table: pd.DataFrame

    @property
    def completed(self) -> bool:
        """Whether the run reached its last period."""
        return bool(self.row["status"] == COMPLETED)

    @property
    def time(self) -> FloatArray:
        """Instants, (k,) [s]."""
        return self.column("time_s")

    @property
    def features(self) -> list[str]:
        """Names of the features with their unit, such as `x_m`."""
        names = [name.removeprefix(FEATURE) for name in self.table.columns if name.startswith(FEATURE)]
        return [name for name in names if f"reference_{name}" in self.table.columns]

    @property
    def point_to_point(self) -> bool:
        """Whether the reference rests."""
        return bool(np.ptp(self.vectors("reference_"), axis=0).max(initial=0.0) == 0.0)

    @property
    def error_unit(self) -> tuple[str, float]:
        """The unit in which errors are shown, and the factor to it from that of the feature."""
        return handy_unit(self.row.get("feature_unit"))

    @property
    def settling_band(self) -> float:
        """The error within which the run counts as settled [`error_unit`]; NaN if the table does not tell it."""
        return self.error_unit[1] * float(self.row.get("settling_band", np.nan))

    @property
    def long(self) -> bool:
        """Whether the run has too many rows to draw them one by one."""
        return len(self.table) > LONG

    def overview(self) -> Track:
        """Return the track with few rows; errors are root mean squares over all rows for which one stands."""
        if not self.long:
            return self
        step = len(self.table) // OVERVIEW
        few = self.table.iloc[::step].reset_index(drop=True)
        for name in ROOT_MEAN_SQUARES:
            if name in few:
                means = (self.table[name] ** 2).groupby(np.arange(len(self.table)) // step).mean()
                few[name] = np.sqrt(means.to_numpy())
        return Track(self.row, few)

    def closing(self) -> Track:
        """Return the end of a long track, row by row."""
        return Track(self.row, self.table.iloc[-CLOSING:].reset_index(drop=True)) if self.long else self

    def for_path(self) -> Track:
        """Return the rows that show the path in space: of a curve that is followed for long, the end."""
        return self.overview() if self.point_to_point else self.closing()

    def error(self) -> FloatArray:
        """Return the norm of the true error, (k,) [`error_unit`]."""
        return self.error_unit[1] * self.column("error_norm")

    def column(self, name: str) -> FloatArray:
        """Return a column as (k,) numbers; NaN where the run has none."""
        return np.asarray(self.table.get(name, pd.Series(np.nan, self.table.index)), dtype=np.float64)

    def vectors(self, kind: str) -> FloatArray:
        """Return the features of a kind (`feature_`, `true_feature_`, `reference_`), (k, m) in their unit."""
        return np.stack([self.column(kind + name) for name in self.features], axis=-1).reshape(len(self.table), -1)


Tracks = dict[str, Track]


@dataclass(frozen=True, eq=False)
class Group:
    """The runs that belong into one figure: of one plant and mismatch, and in each task of one seed.

    Attributes:
        plant: its name.
        mismatch: as it was given.
        seed: of these runs.
        tasks: task -> controller -> track; tasks without any step are left out.
    """

    plant: str
    mismatch: str
    seed: int
    tasks: dict[str, Tracks]

    def select(self, *, point_to_point: bool) -> dict[str, Tracks]:
        """Return the tasks with a fixed target, or those with a moving reference."""
        return {
            task: tracks
            for task, tracks in self.tasks.items()
            if next(iter(tracks.values())).point_to_point == point_to_point
        }


def load_groups(folder: Path) -> Iterator[Group]:
    """Yield a group for each plant and mismatch, with the runs of its smallest seed.

    Raises:
        ConfigurationError: not a results folder.
    """
    runs = with_places(results.load_runs(folder))
    for (plant, mismatch), group in runs.groupby(["plant", "mismatch"], sort=False):
        chosen = group[group["seed"] == group["seed"].min()].drop_duplicates(["task", "controller"])
        try:
            steps = results.load_steps(folder, chosen["run_id"].tolist())
        except ConfigurationError:  # a sweep keeps no steps, and a run may end before its first
            continue
        tables = dict(iter(steps.groupby("run_id", sort=False)))
        tasks: dict[str, Tracks] = {}
        for row in chosen.to_dict("records"):
            if row["run_id"] in tables:
                table = tables[row["run_id"]].dropna(axis=1, how="all").reset_index(drop=True)
                tasks.setdefault(row["task"], {})[row["controller"]] = Track({str(k): row[k] for k in row}, table)
        yield Group(str(plant), str(mismatch), int(chosen["seed"].iloc[0]), tasks)


def each(kind: Callable[[Track], Track], tracks: Tracks) -> Tracks:
    """Return the tracks as `Track.overview`, `Track.closing` or `Track.for_path` make them."""
    return {name: kind(track) for name, track in tracks.items()}


def longest(tracks: Tracks) -> Track:
    """Return the track with the most periods."""
    return max(tracks.values(), key=lambda track: len(track.table))


def label_of(feature: str) -> str:
    """Return `x [m]` for `x_m`."""
    name, _, unit = feature.rpartition("_")
    return f"{name} [{unit}]"
