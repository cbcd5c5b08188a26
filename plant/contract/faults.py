"""Every named reason why a run ends before its last period; `status` is its word in the table of runs.

    RunFault                    fault
    ├── PlantDiverged           plant_diverged
    ├── Collision               collision
    ├── FeatureLost             feature_lost
    ├── FmuError                fmu_error
    ├── ControllerDiverged      controller_diverged
    ├── FilterDiverged          filter_diverged
    └── SolverFailed            solver_failed

A plant or controller of a third party derives its own from `RunFault`. Bad settings are a `ValueError`, not a fault.
"""

from __future__ import annotations

from typing import ClassVar


class RunFault(RuntimeError):
    """A named reason why a run ended before its last period."""

    status: ClassVar[str] = "fault"


class PlantDiverged(RunFault):
    """The plant's state is no longer finite."""

    status: ClassVar[str] = "plant_diverged"


class Collision(RunFault):
    """The arm touched itself or a body of the room."""

    status: ClassVar[str] = "collision"


class FeatureLost(RunFault):
    """The feature was not measured for too many periods in a row."""

    status: ClassVar[str] = "feature_lost"


class FmuError(RunFault):
    """An FMU reported a failure or returned a value that is not finite."""

    status: ClassVar[str] = "fmu_error"


class ControllerDiverged(RunFault):
    """A controller returned a command that is not finite."""

    status: ClassVar[str] = "controller_diverged"


class FilterDiverged(RunFault):
    """A covariance lost symmetry, positive definiteness or finiteness."""

    status: ClassVar[str] = "filter_diverged"


class SolverFailed(RunFault):
    """An optimiser returned no usable answer and no fallback was configured."""

    status: ClassVar[str] = "solver_failed"
