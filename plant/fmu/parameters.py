"""Values for parameters of any type, set before every run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from servobench.plant.fmu.description import REAL_TYPES, FmuDescription, Variable, total_size
from servobench.plant.fmu.instance import Instance
from servobench.plant.fmu.port import Port

STRUCTURAL: Final = "structuralParameter"
BITS: Final = {
    "Integer": 32,
    "Enumeration": 32,
    **{f"{sign}Int{bits}": bits for sign in ("", "U") for bits in (8, 16, 32, 64)},
}
EXACT: Final = 2**53  # up to which a float64 holds every whole number

Setter = Callable[[Instance, int], None]


def structural_sizes(description: FmuDescription, values: Mapping[str, npt.NDArray[Any]]) -> dict[str, int]:
    """Return the values that a mapping gives to structural parameters.

    Raises:
        ValueError: a value that is no size.
    """
    sizes: dict[str, int] = {}
    for name, value in values.items():
        variables = description.find(name, "parameters", None)
        if variables[0].causality == STRUCTURAL:
            check_value(variables, name, value)
            sizes |= {variable.name: int(np.ravel(value)[0]) for variable in variables}
    return sizes


def check_value(variables: list[Variable], name: str, value: npt.NDArray[Any]) -> None:
    """Check that a value fits the type of the parameter that a mapping names.

    Raises:
        ValueError: it does not; says what was wanted.
    """
    kind, given = variables[0].type, np.asarray(value)
    if len({variable.type for variable in variables}) > 1:
        raise ValueError(f"parameter {name!r} stands for variables of several types; name each by itself")
    came = given.tolist()
    if kind == "String":
        fits, wanted = given.dtype.kind == "U", "text"
    elif kind == "Boolean":
        fits, wanted = given.dtype.kind == "b", "true or false"
    elif kind in BITS:
        signed = not kind.startswith("U")
        low, high = (-(2 ** (BITS[kind] - 1)), 2 ** (BITS[kind] - 1) - 1) if signed else (0, 2 ** BITS[kind] - 1)
        low, high = max(low, -EXACT), min(high, EXACT)
        fits = given.dtype.kind == "f" and bool(((given == np.round(given)) & (given >= low) & (given <= high)).all())
        wanted = f"a whole number from {low} to {high}"
    elif kind in REAL_TYPES:
        fits, wanted = given.dtype.kind == "f", "a number"
    else:
        raise ValueError(f"parameter {name!r} is of type {kind}, which a mapping cannot set")
    if not fits:
        raise ValueError(f"parameter {name!r} is of type {kind}: wanted {wanted}, got {came!r}")


def setter(variables: list[Variable], name: str, value: npt.NDArray[Any], lead: tuple[int, ...]) -> Setter:
    """Return a function that gives a parameter its value in an instance, by the row of its run.

    Args:
        variables: that the name stands for.
        name: for messages.
        value: one for all of its values, or each, also for each of the runs side by side.
        lead: leading axes of the runs.

    Raises:
        ValueError: a value of the wrong type or size.
    """
    check_value(variables, name, value)
    size, given = total_size(variables), np.asarray(value)
    if given.shape not in ((), (size,), (*lead, size)):
        raise ValueError(f"parameter {name!r} must have {size} values, got {given.size}")
    if variables[0].type == "String":
        texts = [str(text) for text in np.broadcast_to(given, (size,)).tolist()]
        return lambda instance, _row: instance.set_texts(variables, texts)
    port = Port(variables, lead)
    port.values[...] = given
    if variables[0].causality == STRUCTURAL:
        return lambda instance, _row: instance.configure(port)
    return lambda instance, row: instance.writer(port, row)()
