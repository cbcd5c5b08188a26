"""Settings as frozen dataclasses whose fields carry their bounds in the type and are checked on construction.

    @settings
    class LagSettings:
        \"\"\"Settings of the joint lag.\"\"\"

        lag: NonNegative = 0.05
        \"\"\"[s] time constant of the joints' velocity loops; 0 means none.\"\"\"

The string below a field says its meaning, unit and source; the documentation's tables of settings are made from it.
Rules across fields stand in `__post_init__` and raise `ValueError`. Validation is by pydantic.
"""

import ast
import difflib
import inspect
import json
import logging
import math
import operator
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import Field, field, fields, is_dataclass, replace
from dataclasses import dataclass as plain_dataclass
from functools import cache, partial, wraps
from itertools import pairwise
from multiprocessing import parent_process
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Self,
    TypeAlias,
    TypeVar,
    cast,
    dataclass_transform,
    get_args,
    get_type_hints,
)

import numpy as np
from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import (
    AllowInfNan,
    BeforeValidator,
    ConfigDict,
    PlainValidator,
    TypeAdapter,
    ValidationError,
)
from pydantic.dataclasses import dataclass, rebuild_dataclass
from pydantic_core import PydanticCustomError, PydanticKnownError

from servobench.plant.contract.checks import AnyArray, FloatArray
from servobench.plant.contract.faults import one_line
from servobench.plant.contract.units import (
    EXTENT,
    alternatives,
    in_own_unit,
    in_unit,
    split_quantity,
)


@plain_dataclass(frozen=True)
class Usual:
    """The usual sizes of a number, in its annotation; one beyond them is used, with a remark to the user."""

    size: float
    least: float = 0.0

    def bound_beyond(self, number: float) -> str:
        """Return the bound that a number lies beyond, in words; empty for a number of usual size."""
        size = abs(number)
        if size > self.size:
            return f"at most {self.size:g}"
        if 0.0 < size < self.least:
            return f"at least {self.least:g}"
        return ""


Number: TypeAlias = Annotated[float, AllowInfNan(False)]
"""A finite number."""
Positive: TypeAlias = Annotated[float, Gt(0.0), AllowInfNan(False)]
"""A finite number above 0."""
NonNegative: TypeAlias = Annotated[float, Ge(0.0), AllowInfNan(False)]
"""A finite number, 0 or above."""
PositiveOrInfinite: TypeAlias = Annotated[float, Gt(0.0)]
"""A number above 0, or `inf` for no limit."""
Delay: TypeAlias = Annotated[NonNegative, Usual(2.0)]
"""A time of a loop, 0 or above [s]."""
Deviation: TypeAlias = Annotated[Positive, Usual(0.1)]
"""A standard deviation of a feature in natural units [m]."""
Duration: TypeAlias = Annotated[Positive, Usual(3600.0)]
"""Length of a run or a part of it [s]."""
JointSpeed: TypeAlias = Annotated[Positive, Usual(20.0, 0.01)]
"""The speed of a joint [rad/s]."""
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


def _as_extent(value: Any) -> float | str:  # noqa: ANN401 - as read from a file
    number = value
    if isinstance(value, str):
        parts = split_quantity(value)
        in_pixels = parts is not None and parts[1] == "px"
        number = parts[0] if parts is not None and in_pixels else None
    if not isinstance(number, int | float) or isinstance(number, bool) or not math.isfinite(number):
        raise PydanticCustomError("extent", "a number of metres or a text such as '2px'")
    if number < 0.0:
        raise PydanticKnownError("greater_than_equal", {"ge": 0.0})
    if isinstance(value, str):
        return f"{number:g}px"
    return float(number)


def _as_values(value: Any) -> AnyArray:  # noqa: ANN401 - as read from a file
    if isinstance(value, np.ndarray) and value.dtype.kind in "bU":
        return value
    entries = value if isinstance(value, list | tuple) else [value]
    for kind in (str, bool):
        if entries and all(isinstance(entry, kind) for entry in entries):
            return np.array(value)
    return _as_numbers(value)


Rows: TypeAlias = tuple[tuple[Number, ...], ...]
"""Rows of finite numbers, as of a matrix."""
Names: TypeAlias = Annotated[
    tuple[str, ...], BeforeValidator(lambda name: (name,) if isinstance(name, str) else name)
]
"""One name or several."""
SomeNames: TypeAlias = Annotated[Names, MinLen(1)]
"""The same, but not none."""
Numbers: TypeAlias = Annotated[FloatArray, BeforeValidator(_as_numbers)]
"""An array of numbers; in a file, a number or a list of numbers."""
Values: TypeAlias = Annotated[AnyArray, BeforeValidator(_as_values)]
"""An array of numbers, of truth values or of texts; in a file, one of them or a list."""
Extent: TypeAlias = Annotated[NonNegative | str, PlainValidator(_as_extent)]
"""A number, 0 or above, or a text such as "2px"."""
File: TypeAlias = Annotated[
    Path, BeforeValidator(lambda value: Path(value) if isinstance(value, str) else value)
]
"""The path of a file."""

Section: TypeAlias = Mapping[str, Any]
"""Values of settings by nested or dotted keys."""

Class = TypeVar("Class", bound=type)
Config = TypeVar("Config")

REMARKS = list[str]()  # remarks that this worker process keeps for its parent
MAX_LISTED = 40  # number of names in an error message
_BOUNDS = {
    "greater_than": ("gt", "above", operator.gt),
    "greater_than_equal": ("ge", "at least", operator.ge),
    "less_than": ("lt", "below", operator.lt),
    "less_than_equal": ("le", "at most", operator.le),
}
STORED_STRINGS = Path(__file__).parents[1] / "data" / "field_strings.json"
UNIT = re.compile(r"(?:\[(.+?)\] ?)?(.*)")  # the beginning of a string below a field
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

    Construction raises a `ValueError` of one line that names the field, the wanted and the given value. The checks are
    built with the first construction, as a command constructs few classes; those of a local class at once, as the names
    in its types are gone later.
    """
    is_local = "<locals>" in kind.__qualname__
    config = ConfigDict(**STRICT, defer_build=not is_local)
    checked: Any = dataclass(frozen=True, config=config)(kind)
    construct = checked.__init__
    names = [item.name for item in fields(checked)]

    @wraps(construct)
    def construct_checked(self: Any, *arguments: Any, **values: Any) -> None:  # noqa: ANN401 - any field
        if not checked.__pydantic_complete__:
            rebuild_dataclass(checked)
            checked.__init__ = construct_checked
        try:
            # By name, so that a complaint names the field and not the number of an argument.
            named = dict(zip(names, arguments, strict=False))
            construct(self, **named, **values)
        except ValidationError as error:
            raise ValueError(describe(error)) from None

    checked.__init__ = construct_checked
    return checked


def nested(kind: type[Any]) -> Any:  # noqa: ANN401 - the default of a field of any settings class
    """Return the default of a field that holds the settings of a part: those of `kind`."""
    return field(default_factory=kind)


def override(name: str, default: Config, values: Section) -> Config:
    """Return the dataclass `default` with nested `values`, as TOML gives them, in place of its own.

    Args:
        name: of the section, for error messages.
        default: any frozen dataclass; fields that are dataclasses are sections of their own.
        values: lists become tuples, whole numbers are taken for numbers, true and false are not, and a number may be
            a text with its unit, such as "80ms".

    Raises:
        ValueError: an unknown key, a value of the wrong type, or one that the dataclass refuses.
    """
    known = [item.name for item in fields(cast(Any, default))]
    changes = {}
    for key, value in values.items():
        if key not in known:
            raise ValueError(f"{name} has no setting {key!r}: {_suggest_setting(key, default)}")
        present = getattr(default, key)
        if is_dataclass(present):
            if not isinstance(value, Mapping):
                raise ValueError(f"{name}.{key} is a section of its own, got {value!r}")
            changes[key] = override(f"{name}.{key}", present, value)
        else:
            changes[key] = check_field(f"{name}.{key}", type(default), key, value)
    try:
        return replace(cast(Any, default), **changes) if changes else default
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def suggest(word: str, known: Iterable[str]) -> str:
    """Return a remedy for an unknown word: the nearest known one, then all of them, or the first of many."""
    names = sorted(known)
    near = nearest(word, names)
    remedy = f"valid: {listed(names)}"
    if near:
        remedy = f"did you mean {near!r}? {remedy}"
    return remedy


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is most like a possibly mistyped word; None if none is like it."""
    by_letters = {each.lower(): each for each in known}
    near = difflib.get_close_matches(word.lower(), by_letters, n=1)
    if not near:
        return None
    return by_letters[near[0]]


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a remedy to follow a list of known words: the nearest one; nothing if none is like `word`."""
    near = nearest(word, known)
    if near:
        return f"; did you mean {near!r}?"
    return ""


def listed(names: Sequence[str], most: int = MAX_LISTED) -> str:
    """Return names with commas between them, or the first of many."""
    first = ", ".join(names[:most])
    if len(names) <= most:
        return first
    return f"{first} and {len(names) - most} more"


def _suggest_setting(key: str, section: object) -> str:
    """Return a remedy for an unknown key: where in a nested section it stands, or the nearest one."""
    known = [item.name for item in fields(cast(Any, section))]
    for name in known:
        part = getattr(section, name)
        if is_dataclass(part) and key in (item.name for item in fields(part)):
            place = f"{name}.{key}"
            return f"did you mean {place!r}?"
    if not known:
        return "it has none"
    return suggest(key, known)


def with_tuples(value: Any) -> Any:  # noqa: ANN401 - any value of TOML
    """Return a value with tuples for lists, at any depth, also in tuples."""
    if isinstance(value, dict):
        return {key: with_tuples(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return tuple(map(with_tuples, value))
    return value


@plain_dataclass(frozen=True)
class Check:
    """How a value is checked: its type with bounds, and the usual sizes of its numbers."""

    type: TypeAdapter[Any]
    usual: Usual
    bare: bool = False  # whether its numbers are written without units, as in a URDF

    @classmethod
    def of(cls, hint: Any, *, bare: bool = False) -> Self:  # noqa: ANN401 - any annotation
        """Return the check of an annotation, which may have a `Usual`."""
        adapter = TypeAdapter(hint, config=STRICT)
        usual = _usual(hint) or Usual(math.inf)
        return cls(adapter, usual, bare)


@cache
def _checks(kind: type) -> dict[str, Check]:
    """Return the check of each field that is not a section."""
    hints = get_type_hints(kind, include_extras=True)
    checks = {}
    for item in fields(kind):
        hint = hints[item.name]
        if not is_dataclass(hint):
            checks[item.name] = Check.of(hint)
    return checks


@cache
def _unit(kind: type, key: str) -> str:
    """Return the unit of a field; empty where its string names none."""
    text = field_strings(kind).get(key, "")
    found = UNIT.fullmatch(text)
    return (found and found[1]) or ""


@cache
def field_strings(kind: type[Any]) -> dict[str, str]:
    """Return the strings below the fields of a class and of those that it inherits from, as one line each, by field."""
    strings: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        try:
            source = inspect.getsource(each)
        except (OSError, TypeError):
            # The class was typed in, is not written in Python, or came without its source.
            strings |= _stored_strings().get(f"{each.__module__}.{each.__qualname__}", {})
            continue
        definition = ast.parse(textwrap.dedent(source)).body[0]
        strings |= strings_in(definition)
    return strings


def strings_in(definition: ast.stmt) -> dict[str, str]:
    """Return the strings below the fields of a class in its syntax tree, as one line each, by field."""
    strings: dict[str, str] = {}
    if not isinstance(definition, ast.ClassDef):
        return strings
    for item, below in pairwise(definition.body):
        match item, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(
                value=ast.Constant(value=str(text))
            ):
                strings[name] = one_line(text)
    return strings


@cache
def _stored_strings() -> dict[str, dict[str, str]]:
    """Return the strings of the classes of this package by class and field, for an installation without sources.

    `make tables` stores them.
    """
    return json.loads(STORED_STRINGS.read_text(encoding="utf-8"))


def check_field(name: str, kind: type[Any], key: str, given: object) -> Any:  # noqa: ANN401 - any setting
    """Return the checked value of a field of a settings class, which is no section; see `read_value`."""
    settings_class = cast(Any, kind)
    check = _checks(settings_class)[key]
    return read_value(name, given, check, partial(_unit, settings_class, key))


def read_value(name: str, given: object, check: Check, unit: Callable[[], str]) -> Any:  # noqa: ANN401 - as checked
    """Return a checked value, and remark on an unusual one.

    Args:
        name: for messages.
        given: as TOML has it; numbers may be texts with their unit.
        check: its type.
        unit: returns the own unit of its numbers; empty for none.

    Raises:
        ValueError: another type, out of bounds, or in a unit that does not fit; in the unit in which it was written.
    """
    written = with_tuples(given)
    try:
        value = check.type.validate_python(_in_own_unit(name, written, unit))
    except ValidationError as error:
        raise ValueError(describe(error, name, written, unit(), bare=check.bare)) from None
    for number in _numbers_in(value):
        if check.usual.bound_beyond(number):
            _remark_unusual(name, number, check, unit())
            break  # One remark for a list is enough.
    return value


def _remark_unusual(name: str, number: float, check: Check, unit: str) -> None:
    """Remark on a number of unusual size, with the unit in which it may have been meant."""
    usual = check.usual
    meant = likely_meant(
        number, unit, lambda other: usual.least <= abs(other) <= usual.size, bare=check.bare
    )
    bound = f"{usual.bound_beyond(number)} {unit}".removesuffix(" 1")
    remark(f"{name} is {number:g}, and usually {bound}{meant}")


@cache
def remark(text: str) -> None:
    """Print a remark for the user on standard error, once; a worker process keeps it for the one that started it."""
    if parent_process() is None:
        logging.getLogger("servobench").warning("servobench: note: %s", text)
    else:
        REMARKS.append(text)


def _in_own_unit(name: str, written: object, unit: Callable[[], str]) -> object:
    """Return numbers in place of texts that are numbers with a unit."""
    if isinstance(written, tuple):
        return tuple(_in_own_unit(name, each, unit) for each in written)
    if not isinstance(written, str):
        return written
    parts = split_quantity(written)
    if parts is None:
        return written
    number, written_unit = parts
    own = unit()
    if not own:
        return written
    if own == EXTENT and written_unit == "px":
        return written
    if "/" in written and not written_unit:
        return number
    try:
        in_own = in_own_unit(number, written_unit, own)
    except ValueError as error:
        raise ValueError(f"{name} must be {error}, got {written!r}") from None
    # A whole number passes a check for whole numbers as well.
    if in_own.is_integer():
        return int(in_own)
    return in_own


def _usual(hint: Any) -> Usual | None:  # noqa: ANN401 - any annotation
    """Return the usual sizes in an annotation, or in that of its items."""
    for each in get_args(hint):
        found = each if isinstance(each, Usual) else _usual(each)
        if found:
            return found
    return None


def _numbers_in(value: object) -> Iterator[float]:
    """Yield the numbers of a value: itself, or those in an array or in tuples at any depth."""
    if isinstance(value, np.ndarray):
        value = tuple(np.ravel(value).tolist())
    if isinstance(value, tuple):
        for each in value:
            yield from _numbers_in(each)
    elif isinstance(value, int | float):
        yield value


def likely_meant(
    number: float, unit: str, fits: Callable[[float], bool], *, bare: bool = False
) -> str:
    """Return the remedy for a plain number that may have been meant in another unit, such as millimetres."""
    meant = {text: f"{value:.6g}" for text, value in alternatives(number, unit) if fits(value)}
    if not meant:
        return ""
    wanted = "the unit, too"
    if bare:
        wanted = f"{' or '.join(meant.values())}, as units cannot be written here"
    return f"; if {' or '.join(meant)} is meant, write {wanted}"


def native(value: Any) -> Any:  # noqa: ANN401 - anything that a user gave
    """Return a number or text of numpy as one of Python, whose representation in a message is the number or text."""
    if isinstance(value, np.generic):
        return value.item()
    return value


def describe(
    error: ValidationError,
    name: str = "",
    written: object = None,
    unit: str = "",
    *,
    bare: bool = False,
) -> str:
    """Return the first complaint of pydantic as one line: field, wanted and given value.

    Args:
        error: raised by pydantic.
        name: of the checked object, in front of the field.
        written: the value as the user wrote it; numbers may be texts with a unit.
        unit: own unit of the number.
        bare: whether units cannot be written.
    """
    first = error.errors(include_url=False)[0]
    for place in first["loc"]:
        if isinstance(written, tuple) and isinstance(place, int) and place < len(written):
            written = written[place]
    places = [str(part) for part in first["loc"]]
    if name:
        places.insert(0, name)
    name = ".".join(places)
    kind = first["type"]
    context = first.get("ctx", {})
    came = native(first["input"])
    if kind == "value_error":
        return one_line(context["error"])
    if kind in _BOUNDS:
        key, word, within = _BOUNDS[kind]
        bound = context[key]
        if isinstance(written, str) and (parts := split_quantity(written)) and parts[1]:
            written_unit = parts[1]
            return f"{name} must be {word} {in_unit(bound, written_unit, unit):g}{written_unit}, got {written}"
        meant = likely_meant(came, unit, lambda other: within(other, bound), bare=bare)
        return f"{name} must be {word} {bound:g}, got {came!r}{meant}"
    if kind == "literal_error":
        words = context["expected"].replace("'", "").replace(" or ", ", ")
        remedy = did_you_mean(str(came), words.split(", "))
        return f"{name} must be one of {words}, got {came!r}{remedy}"
    if kind == "too_short":
        wanted = f"of length {context['min_length']} or more"
    elif kind in {"unexpected_keyword_argument", "missing"}:
        return f"{name}: {first['msg']}"
    else:
        wanted = _WANTED.get(kind, first["msg"].removeprefix("Input should be "))
    return f"{name} must be {wanted}, got {came!r}"
