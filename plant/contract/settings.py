"""Settings as frozen dataclasses whose fields carry their bounds in the type and are checked on construction.

    @settings
    class LagSettings:
        \"\"\"Settings of the joint lag.\"\"\"

        lag: NonNegative = 0.05
        \"\"\"[s] time constant of the joints' velocity loops; 0 means none.\"\"\"

The string below a field says its meaning, unit and source; the documentation's tables of settings are made from it.
Rules across fields stand in `__post_init__` and raise `ValueError`. Validation is by pydantic.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, field, fields, is_dataclass, replace
from functools import cache, wraps
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar, cast, dataclass_transform, get_type_hints

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Gt, Le, Lt
from pydantic import AllowInfNan, BeforeValidator, ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticCustomError

from servobench.plant.contract.checks import FloatArray

Number: TypeAlias = Annotated[float, AllowInfNan(False)]
"""A finite number."""
Positive: TypeAlias = Annotated[float, Gt(0.0), AllowInfNan(False)]
"""A finite number above 0."""
NonNegative: TypeAlias = Annotated[float, Ge(0.0), AllowInfNan(False)]
"""A finite number, 0 or above."""
PositiveOrInfinite: TypeAlias = Annotated[float, Gt(0.0)]
"""A number above 0, or `inf` for no limit."""
Share: TypeAlias = Annotated[float, Ge(0.0), Le(1.0)]
"""From 0 to 1, both included."""
ShareBelowOne: TypeAlias = Annotated[float, Ge(0.0), Lt(1.0)]
"""From 0 included to 1 excluded."""
Count: TypeAlias = Annotated[int, Ge(1)]
"""A whole number, 1 or above."""
Periods: TypeAlias = Annotated[int, Ge(0)]
"""A whole number of control periods, or another count that may be 0."""


def _as_numbers(value: Any) -> FloatArray:  # noqa: ANN401 - as read from a file
    if isinstance(value, np.ndarray):
        return value.astype(np.float64)
    entries = value if isinstance(value, list | tuple) else [value]
    if not all(isinstance(entry, int | float) and not isinstance(entry, bool) for entry in entries):
        raise PydanticCustomError("numbers", "a number or a list of numbers")
    try:
        return np.array(value, dtype=np.float64)
    except OverflowError as error:  # a whole number of hundreds of digits
        raise PydanticCustomError("numbers", "numbers below 1e308") from error


def _as_values(value: Any) -> npt.NDArray[Any]:  # noqa: ANN401 - as read from a file
    if isinstance(value, np.ndarray) and value.dtype.kind in "bU":
        return value
    entries = value if isinstance(value, list | tuple) else [value]
    for kind in (str, bool):
        if entries and all(isinstance(entry, kind) for entry in entries):
            return np.array(value)
    return _as_numbers(value)


Names: TypeAlias = Annotated[tuple[str, ...], BeforeValidator(lambda name: (name,) if isinstance(name, str) else name)]
"""One name or several."""
Numbers: TypeAlias = Annotated[FloatArray, BeforeValidator(_as_numbers)]
"""An array of numbers; in a file, a number or a list of numbers."""
Values: TypeAlias = Annotated[npt.NDArray[Any], BeforeValidator(_as_values)]
"""An array of numbers, of truth values or of texts; in a file, one of them or a list."""
File: TypeAlias = Annotated[Path, BeforeValidator(lambda value: Path(value) if isinstance(value, str) else value)]
"""The path of a file."""

Class = TypeVar("Class", bound=type)
Config = TypeVar("Config")

MAX_LISTED = 40  # number of names in an error message
_BOUNDS = {
    "greater_than": ("gt", "above"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "below"),
    "less_than_equal": ("le", "at most"),
}
_WANTED = {
    "finite_number": "finite",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "tuple_type": "a list",
    "mapping_type": "a section",
    "dict_type": "a section",
}


STRICT = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)


@dataclass_transform(frozen_default=True, field_specifiers=(field, Field))
def settings(kind: Class) -> Class:
    """Make a class a frozen dataclass whose fields are checked on construction.

    Construction raises a `ValueError` of one line that names the field, the wanted and the given value.
    """
    checked: Any = dataclass(frozen=True, config=STRICT)(kind)
    construct, names = checked.__init__, [item.name for item in fields(checked)]

    @wraps(construct)
    def construct_checked(self: Any, *arguments: Any, **values: Any) -> None:  # noqa: ANN401 - any field
        try:
            construct(self, **dict(zip(names, arguments, strict=False)), **values)
        except ValidationError as error:
            raise ValueError(describe(error)) from None

    checked.__init__ = construct_checked
    result: Class = checked
    return result


def nested(kind: type[Any]) -> Any:  # noqa: ANN401 - the default of a field of any settings class
    """Return the default of a field that holds the settings of a part: those of `kind`."""
    return field(default_factory=kind)


def override(name: str, default: Config, values: Mapping[str, Any]) -> Config:
    """Return the dataclass `default` with nested `values`, as TOML gives them, in place of its own.

    Args:
        name: of the section, for error messages.
        default: any frozen dataclass; fields that are dataclasses are sections of their own.
        values: lists become tuples, whole numbers are taken for numbers, true and false are not.

    Raises:
        ValueError: an unknown key, a value of the wrong type, or one that the dataclass refuses.
    """
    known = [item.name for item in fields(cast(Any, default))]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            raise ValueError(f"{name} has no setting {key!r}: {_suggest_setting(key, default)}")
        present = getattr(default, key)
        if is_dataclass(present):
            if not isinstance(value, Mapping):
                raise ValueError(f"{name}.{key} is a section of its own, got {value!r}")
            changes[key] = override(f"{name}.{key}", present, value)
        else:
            try:
                changes[key] = _adapters(cast(Any, type(default)))[key].validate_python(_with_tuples(value))
            except ValidationError as error:
                raise ValueError(describe(error, f"{name}.{key}")) from None
    try:
        return replace(cast(Any, default), **changes) if changes else default
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def suggest(word: str, known: Iterable[str]) -> str:
    """Return a remedy for an unknown word: the nearest known one, then all of them, or the first of many."""
    names = sorted(known)
    near = nearest(word, names)
    return f"{f'did you mean {near!r}? ' if near else ''}valid: {listed(names)}"


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is most like a possibly mistyped word; None if none is like it."""
    by_letters = {each.lower(): each for each in known}
    near = difflib.get_close_matches(word.lower(), by_letters, n=1)
    return by_letters[near[0]] if near else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a remedy to follow a list of known words: the nearest one; nothing if none is like `word`."""
    near = nearest(word, known)
    return f"; did you mean {near!r}?" if near else ""


def listed(names: Sequence[str]) -> str:
    """Return names with commas between them, or the first of many."""
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return f"{', '.join(names[:MAX_LISTED])}{more}"


def _suggest_setting(key: str, section: object) -> str:
    """Return a remedy for an unknown key: where in a nested section it stands, or the nearest one."""
    known = [item.name for item in fields(cast(Any, section))]
    for name in known:
        part = getattr(section, name)
        if is_dataclass(part) and key in (item.name for item in fields(part)):
            return f"did you mean {f'{name}.{key}'!r}?"
    return suggest(key, known) if known else "it has none"


def _with_tuples(value: object) -> object:
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


@cache
def _adapters(kind: type) -> dict[str, TypeAdapter[Any]]:
    """Return a validator for each field that is not a section."""
    hints = get_type_hints(kind, include_extras=True)
    types = {item.name: hints[item.name] for item in fields(kind)}
    return {key: TypeAdapter(hint, config=STRICT) for key, hint in types.items() if not is_dataclass(hint)}


def describe(error: ValidationError, name: str = "") -> str:
    """Return the first complaint of pydantic as one line: field, wanted and given value.

    Args:
        error: raised by pydantic.
        name: of the checked object, in front of the field.
    """
    first = error.errors(include_url=False)[0]
    name = ".".join([name] * bool(name) + [str(part) for part in first["loc"]])
    kind, context, came = first["type"], first.get("ctx", {}), first["input"]
    if kind == "value_error":
        return " ".join(str(context["error"]).split())
    if kind in _BOUNDS:
        key, word = _BOUNDS[kind]
        wanted = f"{word} {context[key]:g}"
    elif kind == "literal_error":
        words = context["expected"].replace("'", "").replace(" or ", ", ")
        return f"{name} must be one of {words}, got {came!r}{did_you_mean(str(came), words.split(', '))}"
    elif kind == "too_short":
        wanted = f"of length {context['min_length']} or more"
    elif kind in {"unexpected_keyword_argument", "missing"}:
        return f"{name}: {first['msg']}"
    else:
        wanted = _WANTED.get(kind, first["msg"].removeprefix("Input should be "))
    return f"{name} must be {wanted}, got {came!r}"
