"""The log of one run: a row a control period.

Row k holds instant t_k: reference, observation, command, truth and how long controller and plant took. The error is
judged on the true feature. Times are wall clock and the only columns that differ between two runs of the same seed.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from servobench.controllers.controller import Diagnostics
from servobench.plant.checks import FloatArray
from servobench.plant.signals import Command, Observation, PlantSpec, Truth


class StepLog:
    """Collects the rows of one run."""

    def __init__(self, spec: PlantSpec, *, full_jacobian: bool = False) -> None:
        """Prepare an empty log.

        Args:
            spec: names and units for the columns.
            full_jacobian: also keep every entry of the estimated and of the true Jacobian.
        """
        self._spec = spec
        self._full_jacobian = full_jacobian
        self._rows: list[dict[str, float | bool]] = []

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._rows)

    def add(
        self,
        observation: Observation,
        reference: FloatArray,
        command: Command,
        truth: Truth,
        estimate: FloatArray | None,
        diagnostics: Diagnostics,
        nanoseconds: tuple[int, int],
    ) -> None:
        """Add the row of one instant.

        Args:
            observation: what the controller saw.
            reference: (m,), the desired feature now.
            command: what it answered.
            truth: the true feature and Jacobian of this instant.
            estimate: (m, n), the Jacobian it used, or None.
            diagnostics: what the controller tells about itself.
            nanoseconds: how long the controller's and the plant's step took.
        """
        spec = self._spec
        row: dict[str, float | bool] = {"time_s": observation.time}
        for kind, values in (
            ("reference", reference),
            ("feature", observation.feature),
            ("true_feature", truth.feature),
        ):
            row.update(
                (f"{kind}_{name}_{spec.feature_unit}", value)
                for name, value in zip(spec.feature_names, values.tolist(), strict=True)
            )
        for kind, unit, values in (
            ("joint_position", "rad", observation.joint_position),
            ("joint_velocity_command", "rad_s", command.joint_velocity),
        ):
            row.update(
                (f"{kind}_{name}_{unit}", value) for name, value in zip(spec.joint_names, values.tolist(), strict=True)
            )
        row["error_norm"] = float(np.linalg.norm(reference - truth.feature))
        row["jacobian_error"], row["jacobian_condition"] = _judge_jacobian(estimate, truth.jacobian)
        row["feature_valid"] = observation.feature_valid
        row["controller_time_us"], row["plant_time_us"] = (time / 1000.0 for time in nanoseconds)
        row.update((f"diagnostic_{name}", float(value)) for name, value in diagnostics.items())
        if self._full_jacobian:
            for kind, jacobian in (("estimated", estimate), ("true", truth.jacobian)):
                if jacobian is not None:
                    row.update(self._entries(f"{kind}_jacobian", jacobian))
        self._rows.append(row)

    def table(self, run_id: str) -> pd.DataFrame:
        """Return the rows as a table with the columns run_id and step in front."""
        table = pd.DataFrame(self._rows)
        table.insert(0, "run_id", run_id)
        table.insert(1, "step", np.arange(len(table)))
        return table

    def _entries(self, kind: str, jacobian: FloatArray) -> dict[str, float]:
        spec = self._spec
        return {
            f"{kind}_{feature}_{joint}": float(jacobian[i, j])
            for i, feature in enumerate(spec.feature_names)
            for j, joint in enumerate(spec.joint_names)
        }


def _judge_jacobian(estimate: FloatArray | None, true: FloatArray | None) -> tuple[float, float]:
    """Return ‖Ĵ − J‖/‖J‖ (Frobenius) and cond(J); NaN where one of them is not known."""
    if true is None:
        return np.nan, np.nan
    singular = np.linalg.svd(true, compute_uv=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf
    if estimate is None:
        return np.nan, condition
    return float(np.linalg.norm(estimate - true) / np.linalg.norm(true)), condition
