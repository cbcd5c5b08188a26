"""Plans that are never written out: sequences whose entries are made when they are asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar, overload

Entry_co = TypeVar("Entry_co", covariant=True)


class Grid(Sequence[Entry_co], Generic[Entry_co]):
    """All combinations of the values of some axes, the last axis varying fastest."""

    def __init__(self, make: Callable[..., Entry_co], *axes: Sequence[Any]) -> None:
        """Plan the combinations.

        Args:
            make: returns an entry from a value of each axis.
            axes: the values of each axis; another grid can be one.
        """
        self._make = make
        self._axes = [(axis, len(axis)) for axis in reversed(axes)]
        self._length = math.prod(length for _, length in self._axes)

    def __len__(self) -> int:
        """Return the number of combinations."""
        return self._length

    @overload
    def __getitem__(self, index: int) -> Entry_co: ...
    @overload
    def __getitem__(self, index: slice) -> list[Entry_co]: ...
    def __getitem__(self, index: int | slice) -> Entry_co | list[Entry_co]:
        """Make one entry, or those of a slice."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = range(self._length)[index]
        values = []
        for axis, length in self._axes:
            place, own = divmod(place, length)
            values.append(axis[own])
        return self._make(*reversed(values))
