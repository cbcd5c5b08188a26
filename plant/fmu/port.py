"""Buffers in which variables of an FMU are read or written together."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.fmu.description import Variable, total_size


class Port:
    """Variables that are read or written together, with their buffer; instances side by side have a row each.

    Attributes:
        values: (..., size), the buffer.
        members: the variables themselves.
        variables: value references and their number, for C.
    """

    def __init__(self, variables: Sequence[Variable], lead: tuple[int, ...] = ()) -> None:
        """Prepare the buffer, whose leading axis is `lead`."""
        self.members = tuple(variables)
        self.values: FloatArray = np.zeros((*lead, total_size(variables)))
        self._address = self.values.ctypes.data
        count = len(variables)
        references = (ctypes.c_uint32 * count)(*(variable.reference for variable in variables))
        self.variables = references, ctypes.c_size_t(count)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number of a row, for messages."""
        return tuple(label for variable in self.members for label in variable.labels())

    @property
    def summary(self) -> str:
        """A few names, for messages."""
        return ", ".join(self.labels[:3]) + (", …" if len(self.labels) > 3 else "")

    def pointer(self, row: int = 0) -> ctypes.c_void_p:
        """Return a row of the buffer, for C."""
        return ctypes.c_void_p(self._address + row * self.values.shape[-1] * self.values.itemsize)
