"""Units in which users may write quantities, such as `80ms`, `60deg`, `2px`, `125Hz` or `1/30`.

A setting's own unit stands in brackets at the beginning of the string below its field; a plain number is in this unit.
"""

import math
import re

DEGREES = 180.0 / math.pi
EXTENT = "m or px"  # own unit of lengths that are pixels where features are pixels
UNITS = {  # own unit -> unit -> how many of it are one of the own unit
    "s": {"s": 1.0, "ms": 1e3, "us": 1e6, "min": 1.0 / 60.0},
    "m": {"m": 1.0, "cm": 1e2, "mm": 1e3},
    EXTENT: {"m": 1.0, "cm": 1e2, "mm": 1e3, "px": 1.0},
    "rad": {"rad": 1.0, "deg": DEGREES},
    "deg": {"deg": 1.0, "rad": 1.0 / DEGREES},
    "rad/s": {"rad/s": 1.0, "deg/s": DEGREES},
    "rad/s²": {"rad/s²": 1.0, "deg/s²": DEGREES, "rad/s^2": 1.0, "deg/s^2": DEGREES},
    "1": {"": 1.0, "%": 1e2},
    "kg": {"kg": 1.0, "g": 1e3},
    "Hz": {"Hz": 1.0, "kHz": 1e-3},
}
RATES = {"Hz": "s"}  # unit -> own unit of which it is the reciprocal
SPELLINGS = str.maketrans({"°": "deg", "µ": "u", "μ": "u"})
NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
QUANTITY = re.compile(rf"([-+]?{NUMBER})(?:\s*/\s*({NUMBER}))?\s*(.*)", re.IGNORECASE)


def split_quantity(text: str) -> tuple[float, str] | None:
    """Return the number and the unit of a text such as `80ms` or `1/30 s`; None for one that begins with no number."""
    match = QUANTITY.fullmatch(text.strip())
    divisor = 1.0 if match is None else float(match[2] or 1.0)
    if match is None or divisor == 0.0:
        return None
    return float(match[1]) / divisor, match[3].translate(SPELLINGS)


def units_of(own: str) -> list[str]:
    """Return the units in which a quantity of an own unit may be written."""
    return [*UNITS.get(own, {own: 1.0}), *(rate for rate, unit in RATES.items() if unit == own)]


def in_own_unit(number: float, unit: str, own: str) -> float:
    """Return a number of one of `units_of(own)` in the own unit; of a rate the reciprocal.

    Raises:
        ValueError: another unit, or a rate of 0.
    """
    if RATES.get(unit) == own and number != 0.0:
        return 1.0 / number
    per = UNITS.get(own, {own: 1.0}).get(unit)
    if per is None:
        raise ValueError(f"a number in {', '.join(filter(None, units_of(own))) or 'no unit'}")
    return number / per


def in_unit(number: float, unit: str, own: str) -> float:
    """Return a number of the own unit in another one; the reverse of `in_own_unit`."""
    return 1.0 / number if RATES.get(unit) == own else number * UNITS.get(own, {own: 1.0})[unit]


def alternatives(number: float, own: str) -> list[tuple[str, float]]:
    """Return the quantities that a plain number may have been meant as, with their values in the own unit.

    They are those in smaller units and rates: a number that is too large in metres may be one of millimetres, or below
    100 of centimetres.
    """
    unlikely = ("us",) if abs(number) < 100.0 else ("us", "cm")
    smaller = [
        unit for unit, per in UNITS.get(own, {}).items() if per > 1.0 and unit not in unlikely
    ]
    rates = [rate for rate, unit in RATES.items() if unit == own]
    if abs(number) < 1.0 or (own == "1" and number < 0.0):  # a share
        return []
    return [
        (f"{number:g}{unit}", in_own_unit(number, unit, own))
        for unit in (*smaller, *rates)
        if "^" not in unit
    ]
