"""Metrics of users: functions of the steps of a run, declared by `@servobench.metric` in a file.

    @servobench.metric(unit="m·s²", better="less", margin=0.01)
    def itae(steps):
        return np.trapezoid(steps["time_s"] * steps["error_norm"], steps["time_s"])

The function gets the table of steps of one run, with at least one row, and returns a number. NaN is none: such a run is
left out of medians, and lost in a comparison of pairs. It is called in the process of the run.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeAlias

from servobench.harness.config.entries import Kind
from servobench.harness.config.registry import DECLARED, Registry
from servobench.harness.run.metrics import BUILT_IN, Metric, Summary
from servobench.harness.run.result import Ending, WrongAnswer, ends_batch
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import Record
from servobench.plant.contract.settings import NonNegative, settings

if TYPE_CHECKING:
    import pandas as pd

GROUP = "Own"  # columns in tables of the report, and kind of figure
TABLES = ("moves", "curves", "runs")  # tables of the report


Digits: TypeAlias = Literal[0, 1, 2, 3, 4, 5, 6]


@settings
class Declaration:
    """What tables and verdicts need to know of a metric of a user's."""

    unit: str
    """unit of the returned number; empty for that of the features"""
    better: Literal["less", "more", ""] = "less"
    """which is better; empty where neither is"""
    margin: NonNegative | None = None
    """[unit] difference that does not matter; None for the usual one of its unit"""
    digits: Digits = 3
    """behind the decimal point"""


@dataclass(frozen=True, eq=False)
class OwnMetric:
    """A metric of a user's."""

    name: str  # its column
    summary: str  # first line of the function's docstring
    declared: Declaration
    function: Callable[[pd.DataFrame], float]

    def __reduce__(self) -> tuple[Any, ...]:
        """Be pickled by its place: its module has this object, not the function, under the function's name."""
        return _found, (self.function.__module__, self.function.__qualname__, self.name)

    def __call__(self, steps: pd.DataFrame) -> float:
        """Return the number of a run.

        Raises:
            WrongAnswer: the function returns something else.
        """
        given: object = self.function(steps.copy())
        wanted = f"{self.name} must return a finite number or NaN"
        if not isinstance(given, Real):
            raise WrongAnswer(f"{wanted}, got a {type(given).__name__}", self.function)
        if math.isinf(given):
            raise WrongAnswer(f"{wanted}, got {given}", self.function)
        return float(given)

    def record(self) -> Record:
        """Return its declaration for the manifest of a results folder."""
        code = {"function": self.function.__qualname__, "summary": self.summary}
        return {**code, **asdict(self.declared)}


def _found(module: str, attribute: str, name: str) -> OwnMetric:
    own: OwnMetric = getattr(sys.modules[module], attribute)
    return replace(own, name=name)


def metric(
    *,
    unit: str,
    better: Literal["less", "more", ""] = "less",
    margin: float | None = None,
    digits: Digits = 3,
) -> Callable[[Callable[[pd.DataFrame], float]], OwnMetric]:
    """Declare a function of the steps of a run as a metric, for the option `--metric FILE.py:NAME`.

    Args:
        unit: of the returned number; empty for that of the features.
        better: which is better, "less" or "more"; empty where neither is.
        margin: difference that does not matter [unit]; None for the usual one of its unit.
        digits: behind the decimal point where it is shown, up to 6.

    Raises:
        ConfigurationError: a wrong argument.
    """
    with configuration_errors("servobench.metric: "):
        declared = Declaration(unit, better, margin, digits)

    def declare(function: Callable[[pd.DataFrame], float]) -> OwnMetric:
        lines = (function.__doc__ or function.__name__).strip().splitlines()
        return OwnMetric(function.__name__, lines[0], declared, function)

    return declare


def values_of(
    metrics: Sequence[OwnMetric], steps: pd.DataFrame, *, debug: bool = False
) -> tuple[dict[str, float], str]:
    """Return metrics of a run by name, NaN of one that fails, and why the last of these failed; empty if none did.

    Args:
        metrics: to compute.
        steps: of the run; without a row there is no value.
        debug: raise the error of one that fails.
    """
    values = dict.fromkeys([each.name for each in metrics], math.nan)
    fault = ""
    for each in metrics if len(steps) else ():
        try:
            values[each.name] = each(steps)
        except BaseException as error:
            if debug or ends_batch(error):
                raise
            fault = f"{each.name} has no value: {Ending.of(error).reason}"
    return values, fault


def declare_metrics(records: Mapping[str, Record]) -> None:
    """Let tables, figures and verdicts know metrics of users for as long as the command takes.

    Args:
        records: of the manifest, by name; the other entries of a record are of the code.

    Raises:
        ConfigurationError: a record that declares none, or one of this package.
    """
    if taken := BUILT_IN.keys() & records.keys():
        raise ConfigurationError(f"own metric {min(taken)}: servobench has one of this name")
    entries = [field.name for field in fields(Declaration)]
    for name, record in records.items():
        values: dict[str, Any] = {entry: record.get(entry) for entry in entries}
        with configuration_errors(f"own metric {name}: "):
            declared = Declaration(**values)
        DECLARED[name] = Metric(
            column=name,
            unit=declared.unit,
            label=name,
            digits=declared.digits,
            meaning=str(record.get("summary")),
            better=declared.better,
            margin=declared.margin,
            tables=dict.fromkeys(TABLES, GROUP),
            figure=GROUP.lower(),
            summary=Summary(declared.digits),
        )


def _refuse_class(given: type[Any]) -> NoReturn:
    raise ConfigurationError(f"{given.__name__} is a class; a metric is a function")


_WANTED = 'wanted a function below @servobench.metric(unit="...")'
_KIND = Kind[OwnMetric]("metric", OwnMetric, (), _WANTED, _refuse_class, lambda entry, _: entry)
METRIC_REGISTRY = Registry[OwnMetric](
    _KIND, "servobench.metrics", {}, advice=lambda _: "name a function, such as ./mine.py:itae"
)
