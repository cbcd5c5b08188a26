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

from dataclasses import Field, field, fields
from functools import wraps
from typing import Annotated, Any, TypeAlias, TypeVar, dataclass_transform

from annotated_types import Ge, Gt, Le, Lt
from pydantic import AllowInfNan, ConfigDict, ValidationError
from pydantic.dataclasses import dataclass

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

Class = TypeVar("Class", bound=type)

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
}


@dataclass_transform(frozen_default=True, field_specifiers=(field, Field))
def settings(kind: Class) -> Class:
    """Make a class a frozen dataclass whose fields are checked on construction.

    Construction raises a `ValueError` of one line that names the field, what was wanted and what came.
    """
    checked: Any = dataclass(frozen=True, config=ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True))(
        kind
    )
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


def describe(error: ValidationError) -> str:
    """Return the first complaint of pydantic as one line: field, what was wanted, what came."""
    first = error.errors(include_url=False)[0]
    name = ".".join(str(part) for part in first["loc"])
    kind, context, came = first["type"], first.get("ctx", {}), first["input"]
    if kind == "value_error":
        return " ".join(str(context["error"]).split())
    if kind in _BOUNDS:
        key, word = _BOUNDS[kind]
        wanted = f"{word} {context[key]:g}"
    elif kind == "literal_error":
        wanted = "one of " + context["expected"].replace("'", "").replace(" or ", ", ")
    elif kind == "too_short":
        wanted = f"of length {context['min_length']} or more"
    elif kind in {"unexpected_keyword_argument", "missing"}:
        return f"{name}: {first['msg']}"
    else:
        wanted = _WANTED.get(kind, first["msg"].removeprefix("Input should be "))
    return f"{name} must be {wanted}, got {came!r}"
