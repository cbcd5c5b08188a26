"""The named errors: why a run ends before its last period (`status` is its word in the table of runs), or never begins.

    RunFault                    fault
    ├── PlantDiverged           plant_diverged
    ├── Collision               collision
    ├── FeatureLost             feature_lost
    ├── FmuError                fmu_error
    ├── ControllerDiverged      controller_diverged
    ├── FilterDiverged          filter_diverged
    └── SolverFailed            solver_failed

    ValueError
    └── ConfigurationError      no run: a setting or name that cannot be used

A plant or controller of a third party derives its own from `RunFault`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
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


class ConfigurationError(ValueError):
    """A setting or name that cannot be used; the message is one line for the user, also for a text of several."""

    def __init__(self, message: str) -> None:
        """Keep the message without line ends and without characters that would control a terminal."""
        words = " ".join(message.split())
        super().__init__("".join(each if each.isprintable() else repr(each)[1:-1] for each in words))


@contextmanager
def configuration_errors(place: str = "", *further: type[Exception]) -> Iterator[None]:
    """Raise a ValueError, or an error of further types, as a `ConfigurationError` with `place` before its message.

    Around statements, `with configuration_errors():`, or around a whole function as its decorator.
    """
    kinds: tuple[type[Exception], ...] = (ValueError, *further)
    try:
        yield
    except kinds as error:
        raise ConfigurationError(f"{place}{error}") from error
