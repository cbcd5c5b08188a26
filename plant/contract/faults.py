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

MAX_LENGTH = 4000  # characters of a message; a longer one repeats something that a file holds


class RunFault(RuntimeError):
    """A named reason why a run ended before its last period."""

    status: ClassVar[str] = "fault"

    def __init_subclass__(cls, status: str | None = None) -> None:
        """Take the word of the table of runs; a class without one has that of its base, or sets `status` itself."""
        if status is not None:
            cls.status = status


class PlantDiverged(RunFault, status="plant_diverged"):
    """The plant's state is no longer finite."""


class Collision(RunFault, status="collision"):
    """The arm touched itself or a body of the room."""


class FeatureLost(RunFault, status="feature_lost"):
    """The feature was not measured for too many periods in a row."""


class FmuError(RunFault, status="fmu_error"):
    """An FMU reported a failure or returned a value that is not finite."""


class ControllerDiverged(RunFault, status="controller_diverged"):
    """A controller returned a command that is not finite."""


class FilterDiverged(RunFault, status="filter_diverged"):
    """A covariance lost symmetry, positive definiteness or finiteness."""


class SolverFailed(RunFault, status="solver_failed"):
    """An optimiser returned no usable answer and no fallback was configured."""


def one_line(words: object) -> str:
    """Return an error's message, or other words, as one line without blanks at its ends."""
    return " ".join(str(words).split())


class ConfigurationError(ValueError):
    """A setting or name that cannot be used; the message is one line for the user, also for a text of several."""

    def __init__(self, message: str) -> None:
        """Keep the message without line ends and without characters that would control a terminal."""
        words = one_line(message)
        if len(words) > MAX_LENGTH:
            half = MAX_LENGTH // 2
            words = f"{words[:half]} ... {words[-half:]}"
        super().__init__(
            "".join(each if each.isprintable() else repr(each)[1:-1] for each in words)
        )


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
