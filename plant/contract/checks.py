"""Checks of arrays and numbers at the boundary of a function."""

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int_]
Floats32 = npt.NDArray[np.float32]
AnyArray = npt.NDArray[Any]
NamedArrays: TypeAlias = Mapping[str, FloatArray]
Triple: TypeAlias = tuple[float, float, float]  # x, y and z, or another number of three parts
Shape: TypeAlias = tuple[int, ...]  # sizes of axes, often of the leading ones alone
REAL = "fiub"  # kinds of arrays, as numpy names them


def is_finite(array: FloatArray) -> bool:
    """Return whether no entry is infinite or NaN; the sum of squares is tried first, at a third of the cost."""
    flat = array.reshape(-1)
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(array).all())


def real_numbers(name: str, value: npt.ArrayLike) -> FloatArray:
    """Return a float64 copy of numbers.

    Raises:
        ValueError: texts, objects or complex numbers, or a mask that would be lost.
    """
    given = np.asanyarray(value)
    if given.dtype.kind not in REAL:
        raise ValueError(f"{name} must be real numbers, got {given.dtype}")
    if type(given) is not np.ndarray and np.ma.is_masked(given):  # numpy.ma takes long to import
        raise ValueError(f"{name} must be numbers, got a masked array; write .filled(value)")
    return np.array(given, dtype=np.float64)


def as_array(name: str, value: npt.ArrayLike, shape: Shape) -> FloatArray:
    """Return a read-only float64 copy of `value`.

    Args:
        name: name of the argument, for the error message.
        value: anything array-like.
        shape: wanted shape.

    Raises:
        ValueError: wrong shape, or an entry that is no finite number.
    """
    array = real_numbers(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not is_finite(array):
        raise ValueError(f"{name} must be finite, got {array.tolist()}")
    array.flags.writeable = False
    return array


def check_number(name: str, value: float, *, above: float) -> None:
    """Check that a number is finite and greater than `above`.

    Raises:
        ValueError: it is not; names the argument, the wanted and the given value.
    """
    if not above < real_numbers(name, value) < math.inf:
        raise ValueError(f"{name} must be above {above:g}, got {value}")


def whole_steps(period: float, own_step: float) -> int:
    """Return the number of a plant's own steps in a control period.

    Args:
        period: control period, s.
        own_step: the plant's own step, s.

    Returns:
        The whole number of own steps, at least 1.

    Raises:
        ValueError: the own step does not divide the period.
    """
    count = round(period / own_step) if period > 0.0 else 0
    if count < 1 or abs(count * own_step - period) > 1e-9:
        nearest = max(count, 1) * own_step
        raise ValueError(
            f"period must be a whole multiple of the plant's own step of {own_step:.9g} s, got {period:.9g} s; "
            f"the nearest is {nearest:.9g} s"
        )
    return count


def fewest_parts(period: float, longest: float) -> int:
    """Return the least number of equal parts of a period [s], none longer than `longest` [s] by more than rounding."""
    return max(1, math.ceil(period / longest - 1e-6))
