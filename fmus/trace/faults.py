"""What ends a run, as an expression beside the results: a code of `MESSAGES`, 0 for none.

Code raises where its numbers are of no use. A recorded step has no way out in its middle: it goes on, and says what was
wrong. Functions that are recorded on their own, such as the ways of a branch, collect their faults in a frame each.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import casadi
import numpy as np

from servobench.fmus.trace.array import Expression, Traced, as_traced

NOT_FINITE: Final = 1
NOT_DEFINITE: Final = 2
MESSAGES: Final = {
    NOT_FINITE: "the estimate or the command is not finite",
    NOT_DEFINITE: "a covariance is not positive definite",
}


@dataclass
class Frame:
    """The faults of a function that is being recorded.

    Attributes:
        code: of the worst one, an expression.
    """

    code: Expression = field(default_factory=lambda: casadi.MX(0.0))


_FRAMES: list[Frame] = []


@contextmanager
def frame() -> Iterator[Frame]:
    """Collect the faults within."""
    _FRAMES.append(Frame())
    try:
        yield _FRAMES[-1]
    finally:
        _FRAMES.pop()


def note_fault(wrong: Any, code: int) -> None:  # noqa: ANN401 - an array of truth
    """Note that something is wrong where an entry is true."""
    note_code(casadi.mmax(code * as_traced(wrong).flat()))


def note_code(code: Expression) -> None:
    """Note a fault by its code, 0 for none."""
    _FRAMES[-1].code = casadi.fmax(_FRAMES[-1].code, code)


def is_finite(array: Any) -> bool:  # noqa: ANN401 - an array
    """Return that an array is finite; an expression that is not is a fault."""
    if isinstance(array, Traced) and not array.constant:
        wrong: Any = np.logical_not(np.isfinite(array))
        note_fault(wrong, NOT_FINITE)
        return True
    return bool(np.isfinite(np.asarray(array)).all())
