"""The log of a run: arrays with one row a control period, made into a table once the run is over.

Runs side by side share one log, whose arrays have their lanes after the period: (k, ..., m). Row k holds instant t_k:
reference, observation, command, truth and how long controller and plant took. The error is that of the true feature.
Times are wall clock and the only columns that differ between two runs of the same seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servobench.controllers.controller import Diagnostics
from servobench.plant.contract.checks import FloatArray, Shape
from servobench.plant.contract.faults import RunFault
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.signals import (
    BoolArray,
    Command,
    Observation,
    PlantSpec,
    Truth,
    column_names,
)

if TYPE_CHECKING:
    import pandas as pd


class Period(NamedTuple):
    """A control period of a run, or of runs side by side."""

    observation: Observation  # at its begin
    reference: FloatArray  # (..., 1 + preview, m), from its begin on [unit of the feature]
    command: Command  # held during the period
    truth: Truth  # the true feature and Jacobian at its begin
    nanoseconds: tuple[int, int]  # wall-clock time of the controller's and of the plant's step


@dataclass(frozen=True, eq=False)
class Steps:
    """A run, or runs side by side, as arrays of k rows; NaN where a number is not known."""

    spec: PlantSpec  # names and units for the columns
    time: FloatArray  # (k,) [s]
    reference: FloatArray  # (k, ..., m) [unit of the feature]
    feature: FloatArray  # (k, ..., m), as measured [unit of the feature]
    true_feature: FloatArray  # (k, ..., m) [unit of the feature]
    joint_position: FloatArray  # (k, ..., n), as the encoders report it [rad]
    command: FloatArray  # (k, ..., n) [rad/s]
    feature_valid: BoolArray  # (k, ...), whether a measurement arrived
    capture_time: FloatArray  # (k, ...), exposure of the last one by the camera's clock [s]
    # (k, ..., m, n), the one that the controller used [unit of the feature per rad]
    estimated_jacobian: FloatArray
    true_jacobian: FloatArray  # (k, ..., m, n) [unit of the feature per rad]
    controller_time: FloatArray  # (k,) [µs]
    plant_time: FloatArray  # (k,) [µs]
    # (k,) for each number that the controller gave at least once; for one run only
    diagnostics: dict[str, FloatArray]

    @classmethod
    def unknown(cls, spec: PlantSpec, periods: int, lanes: Shape = ()) -> Steps:
        """Return rows of which no number is known, of one run or of runs in lanes."""

        def empty(*shape: int) -> FloatArray:
            return np.full((periods, *lanes, *shape), np.nan)

        return cls(
            spec,
            time=np.full(periods, np.nan),
            reference=empty(spec.m),
            feature=empty(spec.m),
            true_feature=empty(spec.m),
            joint_position=empty(spec.n),
            command=empty(spec.n),
            feature_valid=np.empty((periods, *lanes), dtype=np.bool_),
            capture_time=empty(),
            estimated_jacobian=empty(spec.m, spec.n),
            true_jacobian=empty(spec.m, spec.n),
            controller_time=np.full(periods, np.nan),
            plant_time=np.full(periods, np.nan),
            diagnostics={},
        )

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.time)

    def first(self, rows: int, lane: int | None = None) -> Steps:
        """Return the first rows, of all runs or of one of those side by side."""
        arrays = {}
        for item in fields(self)[1:-1]:  # between spec and diagnostics
            array = getattr(self, item.name)[:rows]
            arrays[item.name] = array if lane is None or array.ndim == 1 else array[:, lane]
        diagnostics = {name: values[:rows] for name, values in self.diagnostics.items()}
        return Steps(self.spec, **arrays, diagnostics=diagnostics)

    def error_norm(self) -> FloatArray:
        """Return ‖reference − true feature‖, (k, ...) [unit of the feature]."""
        return norm(self.reference - self.true_feature)

    def jacobian_error(self) -> FloatArray:
        """Return ‖Ĵ − J‖ / ‖J‖ (Frobenius), (k, ...)."""
        with np.errstate(all="ignore"):
            difference = norm(flat(self.estimated_jacobian - self.true_jacobian))
            return difference / norm(flat(self.true_jacobian))

    def jacobian_condition(self) -> FloatArray:
        """Return the largest over the smallest singular value of J, (k, ...); infinite where J has lost rank."""
        condition = np.full(self.true_jacobian.shape[:-2], np.nan)
        known = np.isfinite(flat(self.true_jacobian)).all(axis=-1)
        condition[known] = np.linalg.cond(self.true_jacobian[known])
        return condition

    def table(self, run_id: str, *, full_jacobian: bool = False) -> pd.DataFrame:
        """Return a table with one row a period.

        Args:
            run_id: content of the first column.
            full_jacobian: add every entry of the estimated and of the true Jacobian.
        """
        columns: dict[str, object] = {
            "run_id": run_id,
            "step": np.arange(len(self)),
            "time_s": self.time,
        }
        logged = self.reference, self.feature, self.true_feature, self.joint_position, self.command
        for names, values in zip(column_names(self.spec).values(), logged, strict=True):
            columns.update(zip(names, values.T, strict=True))
        columns["error_norm"] = self.error_norm()
        columns["jacobian_error"] = self.jacobian_error()
        columns["jacobian_condition"] = self.jacobian_condition()
        columns["feature_valid"] = self.feature_valid
        if not np.isnan(self.capture_time).all():
            columns["capture_time_s"] = self.capture_time
        columns["controller_time_us"] = self.controller_time
        columns["plant_time_us"] = self.plant_time
        columns.update((f"diagnostic_{name}", values) for name, values in self.diagnostics.items())
        if full_jacobian:
            columns.update(self._entries("estimated_jacobian", self.estimated_jacobian))
            columns.update(self._entries("true_jacobian", self.true_jacobian))
        import pandas as pd  # noqa: PLC0415 - lists of names start without it

        return pd.DataFrame(columns)

    def _entries(self, kind: str, jacobian: FloatArray) -> Iterator[tuple[str, FloatArray]]:
        if np.isnan(jacobian).all():
            return
        for i, feature in enumerate(self.spec.feature_names):
            for j, joint in enumerate(self.spec.joint_names):
                yield f"{kind}_{feature}_{joint}", jacobian[:, i, j]


class StepLog:
    """Collects the rows of a run, or of runs side by side, in arrays that are made beforehand."""

    def __init__(self, spec: PlantSpec, periods: int, lanes: Shape = ()) -> None:
        """Prepare an empty log.

        Args:
            spec: sizes, names and units.
            periods: how many rows there is room for.
            lanes: the leading axes of runs side by side.
        """
        self._count = 0
        self._rows = Steps.unknown(spec, periods, lanes)

    def add(self, period: Period, estimate: FloatArray | None, diagnostics: Diagnostics) -> None:
        """Write the next row.

        Args:
            period: of whose reference the first row is logged.
            estimate: (..., m, n), the Jacobian that the controller used, or None [unit of the feature per rad].
            diagnostics: the controller's own numbers; a name may come later than the first row.
        """
        k = self._count
        rows = self._rows
        observation = period.observation
        truth = period.truth
        rows.time[k] = observation.time
        rows.reference[k] = period.reference[..., 0, :]
        rows.feature[k] = observation.feature
        rows.true_feature[k] = truth.feature
        rows.joint_position[k] = observation.joint_position
        rows.command[k] = period.command.joint_velocity
        rows.feature_valid[k] = observation.feature_valid
        rows.capture_time[k] = observation.capture_time
        if estimate is not None:
            rows.estimated_jacobian[k] = estimate
        if truth.jacobian is not None:
            rows.true_jacobian[k] = truth.jacobian
        controller, plant = period.nanoseconds
        rows.controller_time[k] = controller / 1000.0
        rows.plant_time[k] = plant / 1000.0
        for name, value in diagnostics.items():
            if name not in rows.diagnostics:
                rows.diagnostics[name] = np.full(len(rows), np.nan)
            rows.diagnostics[name][k] = value
        self._count += 1

    def end(self, lanes: BoolArray, fault: RunFault) -> None:
        """End the run for a fault that the loop found; runs side by side end those in the lanes.

        Raises:
            RunFault: `fault`, which ends the run that has this log to itself.
        """
        raise fault

    def steps(self) -> Steps:
        """Return the rows so far."""
        return self._rows.first(self._count)


def flat(values: FloatArray) -> FloatArray:
    """Return values (..., m, n) as (..., m n)."""
    return values.reshape(*values.shape[:-2], values.shape[-2] * values.shape[-1])
