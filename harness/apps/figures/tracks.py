"""The logged steps of a results folder, arranged for figures: by plant and mismatch, task and controller.

A `Track` has the steps of one run, an `Ensemble` the runs of one controller over all seeds at common instants, for
medians and bands.
"""

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, final

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    POINT_TO_POINT,
    column_of,
    handy_unit,
    settling_times,
    with_places,
)
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors

FEATURE = "feature_"
LONG = 6000  # [rows] A longer run is not drawn row by row.
OVERVIEW = 600  # [rows] About this many stand for a long run.
# [rows] The end of a long run is drawn row by row: two laps at the default period.
CLOSING = 400
ERROR = "error_norm"
JACOBIAN = "jacobian_error"
# A row of an overview has the root mean square of these columns over all rows for which it stands.
ROOT_MEAN_SQUARES = (ERROR, JACOBIAN)
ERROR_COLUMNS = ("run_id", "time_s", ERROR)
COLUMNS = (*ERROR_COLUMNS, JACOBIAN)
BAND = (0.1, 0.5, 0.9)  # quantiles over seeds: the band's edges and its middle
WINDOW = 0.5  # [s] The error along a curve is averaged over this time.
MARGIN = 1.5  # [1] A figure shows moves for this multiple of the slowest settling time.
MIN_SHARE = 0.2  # [1] A figure shows at least this share of a run.


@dataclass(frozen=True, eq=False)
class Shown:
    """Unit, band and kind in which runs of a task are shown, by their rows in the table of runs."""

    row: Mapping[Any, Any]  # row of the run, or of the first one

    @property
    def point_to_point(self) -> bool:
        """Whether the task has a fixed target."""
        return bool(self.row.get("task_kind") == POINT_TO_POINT)

    @property
    def error_unit(self) -> tuple[str, float]:
        """The unit in which errors are shown, and the factor to it from that of the feature."""
        return handy_unit(self.row.get("feature_unit"))

    @property
    def settling_band(self) -> float:
        """The error within which a run counts as settled [`error_unit`]; NaN if the table has none."""
        return self.error_unit[1] * float(self.row.get("settling_band", np.nan))


@final
@dataclass(frozen=True, eq=False)
class Track(Shown):
    """The steps of one run."""

    table: pd.DataFrame  # its steps, at least one; columns without any value are left out

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
        names = [
            name.removeprefix(FEATURE) for name in self.table.columns if name.startswith(FEATURE)
        ]
        return [name for name in names if f"reference_{name}" in self.table.columns]

    @property
    def long(self) -> bool:
        """Whether the run has too many rows to draw them one by one."""
        return len(self.table) > LONG

    @property
    def step(self) -> int:
        """Number of rows for which one row of an overview stands."""
        return len(self.table) // OVERVIEW if self.long else 1

    def overview(self) -> Self:
        """Return the track with few rows; errors are root mean squares over all rows for which one stands."""
        return self.thinned(self.step)

    def thinned(self, step: int) -> Self:
        """Return the track with every `step`-th row, which has the root mean square of errors over these rows."""
        if step == 1:
            return self
        few = self.table.iloc[::step].reset_index(drop=True)
        row_of_overview = np.arange(len(self.table)) // step
        for name in ROOT_MEAN_SQUARES:
            if name in few:
                means = (self.table[name] ** 2).groupby(row_of_overview).mean()
                few[name] = np.sqrt(means.to_numpy())
        return replace(self, table=few)

    def closing(self) -> Self:
        """Return the end of a long track, row by row."""
        if not self.long:
            return self
        return replace(self, table=self.table.iloc[-CLOSING:].reset_index(drop=True))

    def for_path(self) -> Self:
        """Return the rows that show the path in space: of a curve that is followed for long, the end."""
        if self.point_to_point:
            return self.overview()
        return self.closing()

    def error(self) -> FloatArray:
        """Return the norm of the true error, (k,) [`error_unit`]."""
        return self.error_unit[1] * self.column(ERROR)

    def column(self, name: str) -> FloatArray:
        """Return a column as (k,) numbers; NaN where the run has none."""
        unknown = pd.Series(np.nan, self.table.index)
        return np.asarray(self.table.get(name, unknown), dtype=np.float64)

    def vectors(self, kind: str) -> FloatArray:
        """Return the features of a kind (`feature_`, `true_feature_`, `reference_`), (k, m) in their unit."""
        columns = [self.column(kind + name) for name in self.features]
        return np.stack(columns, axis=-1).reshape(len(self.table), -1)


Tracks = dict[str, Track]
TracksByTask = Mapping[str, Tracks]


@dataclass(frozen=True, eq=False)
class Group:
    """The runs that belong into one figure: of one plant and mismatch, and in each task of one seed."""

    plant: str
    mismatch: str  # as it was given, or words for that of a twin
    runs: pd.DataFrame  # all runs of this plant and mismatch
    seed: int  # seed of the runs in `tasks`
    tasks: dict[str, Tracks]  # task -> controller -> track; tasks without any step are left out


def load_groups(folder: ResultsFolder, runs: pd.DataFrame) -> Iterator[Group]:
    """Yield a group for each plant and mismatch of a folder's table of runs, with the runs of its smallest seed.

    Raises:
        ConfigurationError: not a results folder.
    """
    for (plant, mismatch), group in with_places(runs).groupby(["plant", "mismatch"], sort=False):
        of_first_seed = group[group["seed"] == group["seed"].min()]
        chosen = of_first_seed.drop_duplicates(["task", "controller"])
        tasks: dict[str, Tracks] = {}
        for track in load_tracks(folder, chosen):
            tracks = tasks.setdefault(track.row["task"], {})
            tracks[track.row["controller"]] = track
        if tasks:  # a sweep keeps no steps, and a run may end before its first
            seed = int(chosen["seed"].iloc[0])
            yield Group(str(plant), str(mismatch), group, seed, tasks)


def track_of(row: Mapping[Any, Any], steps: pd.DataFrame) -> Track:
    """Return the track of a run whose steps come from a table with columns of other runs."""
    return Track(row, steps.dropna(axis=1, how="all").reset_index(drop=True))


def load_tracks(
    folder: ResultsFolder, runs: pd.DataFrame, columns: Collection[str] | None = None
) -> Iterator[Track]:
    """Yield the tracks of those runs that have steps, in their order; with all columns, or those named."""
    try:
        steps = folder.steps(runs["run_id"].tolist(), columns)
    except ConfigurationError as error:
        if type(error) is not ConfigurationError:  # a file is damaged
            raise
        # No steps are kept, or each of these runs ended before its first period.
        return
    tables = {str(run_id): own for run_id, own in steps.groupby("run_id", sort=False)}
    for row in runs.drop_duplicates("run_id").to_dict("records"):
        if row["run_id"] in tables:
            yield track_of(row, tables[row["run_id"]])


def values_drawn(row: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the values of a run's mismatch that were drawn, from its row in the table of runs.

    Raises:
        ConfigurationError: the row has something else.
    """
    with configuration_errors(
        f"run {row['run_id']} has mismatch_values that are none: ", TypeError
    ):
        return dict(json.loads(row.get("mismatch_values") or "{}"))


def longest(tracks: Tracks) -> Track:
    """Return the track with the most periods."""
    return max(tracks.values(), key=lambda track: len(track.table))


def label_of(feature: str) -> str:
    """Return `x [m]` for `x_m`."""
    name, _, unit = feature.rpartition("_")
    return f"{name} [{unit}]"


@final
@dataclass(frozen=True, eq=False)
class Ensemble(Shown):
    """The runs of one controller on one task, a row a seed."""

    time: FloatArray  # instants, (k,) [s]
    # Norm of the true error, (r, k) [`error_unit`]; infinite from an early end on.
    error: FloatArray
    jacobian_error: FloatArray  # relative error, (r, k) [%]; NaN where it is not known
    settling_time: float  # median [s]; infinite if half of the runs never settled
    mostly_ended: bool  # whether half of the runs ended early, so that no median goes on to the end
    camera_moved_at: float  # when the camera was moved [s]; NaN where it was not

    @property
    def period(self) -> float:
        """Control period [s]; NaN of a run of one period."""
        if len(self.time) > 1:
            return float(self.time[1] - self.time[0])
        return math.nan

    @property
    def shown_error(self) -> FloatArray:
        """The error, (r, k) [`error_unit`]; along a curve its root mean square over `WINDOW`."""
        if self.point_to_point or not self.period < WINDOW:
            return self.error
        periods = round(WINDOW / self.period)
        with np.errstate(invalid="ignore"):
            squares = pd.DataFrame(self.error.T**2).replace(math.inf, np.nan)
            means = squares.rolling(periods, min_periods=1).mean().to_numpy().T
        return np.where(np.isfinite(self.error), np.sqrt(means), self.error)


Ensembles = dict[str, Ensemble]
Tasks = Mapping[str, Ensembles]


def quantile(values: FloatArray, share: float) -> FloatArray:
    """Return a quantile over runs, (k,), of values (r, k) of which some may be infinite; NaN counts as the largest."""
    ordered = np.sort(values, axis=0)
    place = share * (len(values) - 1)
    below = math.floor(place)
    part = place - below
    if not part:  # zero times an infinite value above would be NaN
        return ordered[below]
    return (1.0 - part) * ordered[below] + part * ordered[below + 1]


def load_ensembles(folder: ResultsFolder, runs: pd.DataFrame) -> dict[str, Ensembles]:
    """Return the ensembles of runs of one plant and mismatch with steps, task -> controller -> ensemble."""
    moves_at = folder.configuration.get("run", {}).get("camera_moves_at")
    tracks: dict[tuple[str, str], list[Track]] = {}
    for track in load_tracks(folder, runs, COLUMNS):
        key = track.row["task"], track.row["controller"]
        tracks.setdefault(key, []).append(track)
    unbegun = runs[(runs["status"] != COMPLETED) & (column_of(runs, "periods") == 0.0)]
    never = unbegun.groupby(["task", "controller"]).size()
    ensembles: dict[str, Ensembles] = {}
    for (task, name), own in tracks.items():
        ensemble = _ensemble(own, int(never.get((task, name), 0)), moves_at)
        ensembles.setdefault(task, {})[name] = ensemble
    return ensembles


def shown_until(ensembles: Ensembles) -> float:
    """Return until when a figure shows these runs [s]: a move until well after the slowest method has settled."""
    each = list(ensembles.values())
    end = max(float(ensemble.time[-1]) for ensemble in each)
    settling_times = [ensemble.settling_time for ensemble in each]
    known = [time for time in settling_times if math.isfinite(time)]
    moved = any(math.isfinite(ensemble.camera_moved_at) for ensemble in each)
    if not known or not each[0].point_to_point or moved:
        return end
    return min(end, max(MARGIN * max(known), MIN_SHARE * end))


def _ensemble(tracks: Sequence[Track], never: int, moves_at: object) -> Ensemble:
    """Return the ensemble of tracks and of runs that never began; a camera moves after that share of a run."""
    runs = pd.DataFrame([track.row for track in tracks])
    longest_track = max(tracks, key=lambda track: len(track.table))
    # All runs of an ensemble are thinned alike, so that they have common instants.
    few = [track.thinned(longest_track.step) for track in tracks]
    time = max((track.time for track in few), key=len)

    def padded(values: FloatArray, filling: float) -> FloatArray:
        return np.concatenate([values, np.full(len(time) - len(values), filling)])

    errors = []
    for track in few:
        after_end = math.nan if track.completed else math.inf
        errors.append(padded(track.error(), after_end))
    errors += never * [np.full(len(time), math.inf)]
    jacobian_errors = [padded(100.0 * track.column(JACOBIAN), math.nan) for track in few]
    settled_after = [*settling_times(runs).fillna(math.inf), *never * [math.inf]]
    ended_early = (runs["status"] != COMPLETED).sum() + never
    return Ensemble(
        row=tracks[0].row,
        time=time,
        error=np.stack(errors),
        jacobian_error=np.stack(jacobian_errors),
        settling_time=float(np.median(settled_after)),
        mostly_ended=bool(ended_early / (len(runs) + never) >= BAND[1]),
        camera_moved_at=_camera_moved_at(runs, longest_track, moves_at),
    )


def _camera_moved_at(runs: pd.DataFrame, longest: Track, share: object) -> float:
    """Return when the camera was moved [s], after a share of the longest run; NaN where it was not."""
    moves = any(values_drawn(row).get("move_angle", 0.0) != 0.0 for row in runs.to_dict("records"))
    if not moves or not isinstance(share, int | float) or not 0.0 <= share < 1.0:
        return math.nan
    return float(longest.time[int(share * len(longest.time))])
