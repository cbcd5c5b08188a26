"""Saved states of an FMU: handles of an instance, bytes, and that of a world."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, final

from servobench.plant.contract.checks import FloatArray


@dataclass(frozen=True, eq=False)
class FmuState:
    """A saved state of an FMU's world.

    Attributes:
        fmu: of each instance: bytes for any process with the same FMU, or, if it cannot serialise, a handle of the
            world that saved it.
        period: number of periods since the start.
        integrated: (..., n), rad, joint positions of an FMU that has none itself.
    """

    fmu: tuple[bytes | ctypes.c_void_p, ...]
    period: int
    integrated: FloatArray


class Stateful(Protocol):
    """The part of an instance that is used here."""

    state: ClassVar[str]
    deserialise: ClassVar[str]

    def call(self, name: str, *arguments: Any) -> None:  # noqa: ANN401 - what C takes
        """Call a function of the library and check its status; raises FmuError."""


@final
class States:
    """The states of one instance."""

    def __init__(self, instance: Stateful) -> None:
        """Take the instance."""
        self._instance, self._word = instance, instance.state

    def save(self) -> ctypes.c_void_p:
        """Return the present state; it has to be given to `free`."""
        state = ctypes.c_void_p()
        self._instance.call(f"Get{self._word}", ctypes.byref(state))
        return state

    def restore(self, state: ctypes.c_void_p) -> None:
        """Return to a saved state."""
        self._instance.call(f"Set{self._word}", state)

    def free(self, state: ctypes.c_void_p) -> None:
        """Free a saved state."""
        self._instance.call(f"Free{self._word}", ctypes.byref(state))

    def save_bytes(self) -> bytes:
        """Return the present state as bytes that another process understands."""
        state = self.save()
        try:
            size = ctypes.c_size_t()
            self._instance.call(f"Serialized{self._word}Size", state, ctypes.byref(size))
            content = (ctypes.c_char * size.value)()
            self._instance.call(f"Serialize{self._word}", state, content, size)
            return bytes(content)
        finally:
            self.free(state)

    def restore_bytes(self, content: bytes) -> None:
        """Return to a state from `save_bytes`."""
        state = ctypes.c_void_p()
        place = ctypes.c_size_t(len(content)), ctypes.byref(state)
        self._instance.call(f"{self._instance.deserialise}{self._word}", content, *place)
        try:
            self.restore(state)
        finally:
            self.free(state)
