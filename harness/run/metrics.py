"""The metrics of a run, computed from its logged rows: `METRICS` declares each one, `judge_run` computes them.

A metric is one declaration: its column in the table of runs, its unit, its definition, how and where tables and figures
show it, which stand in `metrics.toml`, and the function that computes it. docs/results.md, the tables of a command,
`servobench statistics` and the report are made from the declarations. All errors are those of the true feature.
"""

import math
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servobench.harness.config.registry import DECLARED
from servobench.harness.run.log import Steps, flat
from servobench.harness.run.references import TaskKind
from servobench.harness.run.scenario import Span
from servobench.plant.contract.checks import AnyArray, FloatArray, IntArray, NamedArrays
from servobench.plant.contract.facts import read_beside
from servobench.plant.contract.lanes import norm

SETTLING_SHARE = 0.05  # band as a share of the initial error
DWELL = 0.5  # [s] least time within the band at the end of a run
FINAL_SPAN = 1.0  # [s] over which the steady state is averaged
ERROR_FLOOR = 0.3  # share of the settling band; a smaller error counts as none in `log_error`
LARGE_COMMAND = 0.1  # share of the joint's speed limit from which on a command counts as large
SWITCH_PERIODS = 2  # within which a change of sign counts as a switch


class Judged:
    """The rows of a run, or of runs side by side, with the period as the last, contiguous axis.

    The order of a sum decides its last bits, and stored tables are compared bit for bit: hence contiguous columns.

    Attributes:
        steps: the rows, at least one.
        fixed: whether the task has a fixed target.
        period: of control [s].
        error: of the true feature, (..., k) [unit of the feature].
        evaluated: the error in the evaluated part of the task, (..., j).
        second_lap: the error in the second lap of a curve that is repeated, (..., l).
        move_times: settling times of the moves of a sequence, (..., s) [s].
        feature: the true one, (..., m, k).
        reference: (..., m, k).
        command: (..., n, k) [rad/s].
        acceleration: of the commands, (..., n, k − 1) [rad/s²].
        jerk: of the commands, (..., n, k − 2) [rad/s³].
    """

    def __init__(
        self,
        steps: Steps,
        kind: TaskKind,
        evaluate_from: float,
        lap_time: float,
        moves: Sequence[Span],
    ) -> None:
        """Arrange the rows; see `judge_run`."""
        self.steps = steps
        self.fixed = kind == "point_to_point"
        self.period = steps.spec.period
        self.error = _columns(steps.error_norm())
        self.feature = _columns(steps.true_feature)
        self.reference = _columns(steps.reference)
        self.command = _columns(steps.command)
        begins = np.array([evaluate_from, lap_time, 2.0 * lap_time])
        judged_from, second, third = np.searchsorted(steps.time, begins - 1e-9)
        self.evaluated = self.error[..., judged_from:]
        self.second_lap = self.error[..., second:third]
        self.move_times = move_times(steps, moves)
        # The step from rest to the first command does not count.
        self.acceleration = np.diff(self.command, axis=-1) / self.period
        self.jerk = np.diff(self.acceleration, axis=-1) / self.period

    def same(self, value: float) -> FloatArray:
        """Return a value that all runs share, (...)."""
        return np.full(self.error.shape[:-1], value)


class Summary(NamedTuple):
    """A column of the table that a command prints at its end; of one kind of task only, if `kind` says so."""

    digits: int
    kind: TaskKind | None = None


@dataclass(frozen=True)
class Metric:
    """A metric: a column of the table of runs."""

    column: str  # its name
    unit: str  # of the column; empty for that of the plant's feature
    label: str  # its name wherever it is shown: in tables of commands, in the report and in figures
    digits: int  # behind the decimal point where it is shown
    meaning: str  # its definition
    # of runs, (...); None where only the sensing set-up knows them, see `servobench.harness.run.outcome`.
    values: Callable[[Judged], FloatArray] | None = None
    kind: TaskKind | None = None  # kind of the tasks that have it; None for all
    percent: bool = False  # whether it is shown in percent
    better: str = "less"  # `less`, `more`, or empty where neither direction is better
    margin: float | None = (
        None  # [unit] difference that does not matter; None for the usual one of the unit
    )
    # the tables of the report that show it, each with the group of columns: moves, curves, cost, runs
    tables: Mapping[str, str] = field(default_factory=dict)
    figure: str = ""  # the figure that shows it for each run: settling, effort, smoothness or own
    summary: Summary | None = None  # its column in the table that a command prints at its end


def judge_run(
    steps: Steps,
    kind: TaskKind,
    evaluate_from: float,
    lap_time: float = math.nan,
    moves: Sequence[Span] = (),
) -> NamedArrays:
    """Return the metrics of a run, or of runs side by side.

    Args:
        steps: the rows, at least one.
        kind: of the task; "point_to_point" has a fixed target, "sequence" several in a row.
        evaluate_from: where the evaluated part begins [s].
        lap_time: of a curve that is repeated [s]; NaN of any other.
        moves: of a sequence.

    Returns:
        Metric name -> (...), of those that such a task has; NaN where one does not apply, as the times of runs side by
        side.
    """
    run = Judged(steps, kind, evaluate_from, lap_time, moves)
    return {
        name: metric.values(run)
        for name, metric in BUILT_IN.items()
        if metric.values is not None and metric.kind in (None, kind)
    }


def settling_time(error: FloatArray, band: npt.ArrayLike, period: float) -> FloatArray:
    """Return the time from which on `error` stays within `band`, interpolated linearly between two periods.

    Args:
        error: (..., k), one value a period [unit of the feature].
        band: one number or (...) [unit of the feature].
        period: [s].

    Returns:
        (...) [s]; NaN if the error is outside at the end, or came in less than `DWELL` before it.
    """
    count = error.shape[-1]
    band = np.asarray(band)
    outside = ~(error <= band[..., None])
    after_last_outside = count - outside[..., ::-1].argmax(axis=-1)
    first = np.where(outside.any(axis=-1), after_last_outside, 0)
    settled = (count - first) * period >= DWELL - 1e-9
    row = np.where(settled, first, 0)[..., None]
    before = np.take_along_axis(error, np.maximum(row - 1, 0), axis=-1)[..., 0]
    after = np.take_along_axis(error, row, axis=-1)[..., 0]
    # The share is no number where the first row is inside, or where no row stays inside.
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (band - after) / (before - after)
        crossing = first - np.where(first > 0, share, 0.0)
    return np.where(settled, crossing * period, np.nan)


def move_times(steps: Steps, moves: Sequence[Span]) -> FloatArray:
    """Return the settling times of moves in a row, each from its own first row on.

    Args:
        steps: the rows of a run, or of runs side by side.
        moves: of the task.

    Returns:
        (..., s) [s]; NaN of a move that did not settle while its target was held, or that the run did not come to.
    """
    error = _columns(steps.error_norm())
    times = np.full((*error.shape[:-1], len(moves)), np.nan)
    for place, span in enumerate(moves):
        first, behind = np.searchsorted(steps.time, np.array(span) - 1e-9)
        if first < behind:
            own = error[..., first:behind]
            times[..., place] = settling_time(own, steps.spec.feature.band, steps.spec.period)
    return times


def log_error(error: FloatArray, band: float) -> FloatArray:
    """Return the mean over periods, (...), of log₁₀(e / 0.3 band), at least 0, of an error (..., k) [as the band]."""
    return np.log10(np.maximum(error / (ERROR_FLOOR * band), 1.0)).mean(axis=-1)


def overshoot(feature: FloatArray, target: FloatArray) -> FloatArray:
    """Return how far the feature passes the target along the initial error, as a share of that.

    Args:
        feature: (..., m, k) [unit of the feature].
        target: (..., m) [unit of the feature].

    Returns:
        (...), at least 0; NaN if the run starts at the target.
    """
    start = feature[..., 0]
    way = target - start
    length = np.vecdot(way, way)
    passed = np.vecmat(way, feature - start[..., None]).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > 0.0, np.maximum(0.0, passed / length - 1.0), np.nan)


def path_length(points: FloatArray) -> FloatArray:
    """Return the length, (...), of the path through `points`, (..., m, k) [their unit]."""
    steps = np.ascontiguousarray(np.diff(points, axis=-1).mT)
    return norm(steps).sum(axis=-1)


def sign_switches(command: FloatArray, limit: FloatArray) -> IntArray:
    """Return how often joints are driven back and forth, summed over joints.

    A joint switches in a period whose command is large, that is at least `LARGE_COMMAND` of the limit, if its previous
    large command has the other sign and is at most `SWITCH_PERIODS` periods old. A slow reversal is no switch.

    Args:
        command: (..., n, k) [rad/s].
        limit: (n,) [rad/s].

    Returns:
        (...) switches; 0 for a single period.
    """
    sign = np.where(np.abs(command) >= LARGE_COMMAND * limit[:, None], np.sign(command), 0.0)
    before = np.zeros_like(sign)  # sign of the newest large command of the periods that count
    for back in range(SWITCH_PERIODS, 0, -1):
        earlier = sign[..., :-back]
        before[..., back:] = np.where(earlier == 0.0, before[..., back:], earlier)
    return np.count_nonzero(sign * before < 0.0, axis=(-2, -1))


def final_rows(period: float) -> slice:
    """Return the rows over which the steady state is averaged, for a control period [s]."""
    return slice(-max(1, round(FINAL_SPAN / period)), None)


def _path_length_ratio(run: Judged) -> FloatArray:
    """Return the length of the true path over that of the shortest one; NaN where nothing has to move."""
    way = path_length(run.reference)
    if run.fixed:
        way = norm(run.reference[..., 0] - run.feature[..., 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(way > 0.0, path_length(run.feature) / way, np.nan)


def _median_time(run: Judged, moves: slice) -> FloatArray:
    """Return the median settling time of moves of a sequence; NaN if one of them has none, or without such moves."""
    times = run.move_times[..., moves]
    if not times.shape[-1]:
        return run.same(math.nan)
    return np.median(times, axis=-1)


def _saturation(run: Judged) -> FloatArray:
    limit = run.steps.spec.joint_velocity_limit[:, None] * (1 - 1e-9)
    at_limit = np.abs(run.command) >= limit
    return at_limit.any(axis=-2).mean(axis=-1)


def _overruns(run: Judged) -> FloatArray:
    """Return the number of steps of the controller that took longer than the period; NaN where times are unknown."""
    times = run.steps.controller_time
    if np.isnan(times).any():
        return run.same(math.nan)
    return run.same(float(np.count_nonzero(times > 1e6 * run.period)))


def _columns(values: AnyArray) -> AnyArray:
    """Return values (k, ...) or (k, ..., m) with the period as the last, contiguous axis."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def _peak(run: Judged, values: FloatArray) -> FloatArray:
    if values.size:
        return np.abs(values).max(axis=(-2, -1))
    return run.same(np.nan)


def _rms(run: Judged, values: FloatArray) -> FloatArray:
    """Return the root mean square over the last axis; NaN where it is empty."""
    if not values.shape[-1]:
        return run.same(np.nan)
    return np.sqrt(np.mean(values**2, axis=-1))


def _of_known(summary: Callable[..., FloatArray], values: FloatArray) -> FloatArray:
    """Return the mean or maximum over periods, (...), of those values (..., k) that are not NaN; NaN without any."""
    unknown = np.isnan(values)
    if not unknown.any():
        return summary(values, axis=-1)
    summaries = []
    for row in values.reshape(-1, values.shape[-1]):
        known = row[~np.isnan(row)]
        summaries.append(summary(known) if len(known) else np.nan)
    return np.array(summaries).reshape(values.shape[:-1])


_VALUES: Mapping[str, Callable[[Judged], FloatArray]] = {
    "settling_time_s": lambda run: settling_time(
        run.error, run.steps.spec.feature.band, run.period
    ),
    "settling_time_5pct_s": lambda run: settling_time(
        run.error, SETTLING_SHARE * run.error[..., 0], run.period
    ),
    "settling_time_first_s": lambda run: _median_time(run, slice(0, 1)),
    "settling_time_second_s": lambda run: _median_time(run, slice(1, 2)),
    "settling_time_later_s": lambda run: _median_time(run, slice(2, None)),
    "overshoot": lambda run: (
        overshoot(run.feature, run.reference[..., 0]) if run.fixed else run.same(np.nan)
    ),
    "steady_state_error": lambda run: run.error[..., final_rows(run.period)].mean(axis=-1),
    "rms_error": lambda run: _rms(run, run.error),
    "max_error": lambda run: run.error.max(axis=-1),
    "rms_error_second_lap": lambda run: _rms(run, run.second_lap),
    "rms_error_evaluated": lambda run: _rms(run, run.evaluated),
    "log_error": lambda run: log_error(run.error, run.steps.spec.feature.band),
    "path_length_ratio": _path_length_ratio,
    "max_joint_position_rad": lambda run: np.abs(_columns(run.steps.joint_position)).max(
        axis=(-2, -1)
    ),
    "control_effort_rad": lambda run: flat(np.abs(run.command)).sum(axis=-1) * run.period,
    "saturation_fraction": _saturation,
    "joint_acceleration_peak_rad_s2": lambda run: _peak(run, run.acceleration),
    "joint_acceleration_rms_rad_s2": lambda run: _rms(run, flat(run.acceleration)),
    "joint_jerk_peak_rad_s3": lambda run: _peak(run, run.jerk),
    "joint_jerk_rms_rad_s3": lambda run: _rms(run, flat(run.jerk)),
    "command_switches": lambda run: sign_switches(
        run.command, run.steps.spec.joint_velocity_limit
    ).astype(np.float64),
    "feature_invalid_fraction": lambda run: np.mean(_columns(~run.steps.feature_valid), axis=-1),
    "jacobian_error_mean": lambda run: _of_known(np.mean, _columns(run.steps.jacobian_error())),
    "jacobian_condition_max": lambda run: _of_known(
        np.max, _columns(run.steps.jacobian_condition())
    ),
    "controller_time_median_us": lambda run: run.same(float(np.median(run.steps.controller_time))),
    "controller_time_p99_us": lambda run: run.same(
        float(np.quantile(run.steps.controller_time, 0.99))
    ),
    "controller_time_overruns": _overruns,
    "plant_time_median_us": lambda run: run.same(float(np.median(run.steps.plant_time))),
}
"""What computes a metric, by its name; the pose errors are known to the sensing set-up alone."""


def _declared(column: str, summary: Any = None, **entry: Any) -> Metric:  # noqa: ANN401
    """Return the metric of an entry of `metrics.toml`."""
    if summary is not None:
        summary = Summary(**summary)
    return Metric(column, values=_VALUES.get(column), summary=summary, **entry)


_TABLE = read_beside(__file__, "metrics.toml")
BUILT_IN = {column: _declared(column, **entry) for column, entry in _TABLE.items()}
"""Every metric of this package by the name of its column, in the order of the table of runs."""
METRICS: Mapping[str, Metric] = ChainMap(DECLARED, BUILT_IN)
"""The same, and then those of users that the present command knows."""
