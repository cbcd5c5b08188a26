"""RTDE packets: the variables of a UR's controller, recipes of them, and the bytes on the socket.

A packet is big-endian: u16 size of the whole, u8 kind, body. A recipe is a list of variables that travel together.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
"""

import asyncio
import struct
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from itertools import islice
from typing import Any, Final, Self

CONTROLLER: Final = tomllib.loads(files(__package__).joinpath("controller.toml").read_text(encoding="utf-8"))
MAX_NAMES: Final = 2048  # bytes of a list of names, by the guide
NOT_FOUND: Final = "NOT_FOUND"
CODES: Final = CONTROLLER["codes"]  # type -> layout of struct
ZEROS: Final = {kind: (0,) * int(code[:-1] or 1) for kind, code in CODES.items()}
REGISTERS: Final = {"int": "INT32", "double": "DOUBLE"}


def _types(way: str) -> dict[str, str]:
    """Return the type of each variable that travels one way, `input` or `output`."""
    registers = {f"{way}_{word}_register_{k}": kind for word, kind in REGISTERS.items() for k in range(48)}
    return {name: kind for kind, names in CONTROLLER[f"{way}s"].items() for name in names.split()} | registers


OUTPUTS: Final = _types("output")
INPUTS: Final = _types("input")


class WireError(ValueError):
    """Bytes that are no packet of this protocol; the message is one line."""


@dataclass(frozen=True)
class Recipe:
    """Variables that travel together.

    Attributes:
        names: of the variables, in their order on the wire.
        types: of each, or `NOT_FOUND`, with which nothing can travel.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]

    @classmethod
    def of(cls, body: bytes, known: Mapping[str, str]) -> Self:
        """Return the recipe of a comma-separated list of known variables, or raise a `WireError` for no such list."""
        names = tuple(name for name in body.decode("ascii", "replace").split(",") if name)
        if len(body) > MAX_NAMES or not body.isascii() or not names:
            raise WireError(f"a recipe must be 1 to {MAX_NAMES} bytes of names, got {len(body)} bytes")
        return cls(names, tuple(known.get(name, NOT_FOUND) for name in names))

    @cached_property
    def layout(self) -> struct.Struct:
        """The values on the wire, after the number of the recipe; all types have to be known."""
        return struct.Struct(">" + "".join(CODES[each] for each in self.types))

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """Return the values as bytes, numbers or tuples of them by name; one that is missing is zero."""
        numbers: list[Any] = []
        for name, kind in zip(self.names, self.types, strict=True):
            value = values.get(name, ZEROS[kind])
            numbers.extend(value if isinstance(value, Iterable) else (value,))
        return self.layout.pack(*numbers)

    def unpack(self, body: bytes) -> dict[str, Any]:
        """Return the value of each variable, or raise a `WireError` for another number of bytes."""
        if len(body) != self.layout.size:
            raise WireError(f"data of {self.names[0]} … must be {self.layout.size} bytes, got {len(body)}")
        numbers, sizes = iter(self.layout.unpack(body)), (len(ZEROS[kind]) for kind in self.types)
        taken = (tuple(islice(numbers, size)) for size in sizes)
        return {name: each if len(each) > 1 else each[0] for name, each in zip(self.names, taken, strict=True)}


def packet(kind: str, body: bytes) -> bytes:
    """Return a packet of a kind, one letter."""
    return struct.pack(">HB", 3 + len(body), ord(kind)) + body


async def read_packet(reader: asyncio.StreamReader) -> tuple[str, bytes] | None:
    """Return kind and body of the next packet, None at the end, or raise a `WireError` where it has no size or end."""
    try:
        size, kind = struct.unpack(">HB", await reader.readexactly(3))
        if size >= 3:
            return chr(kind), await reader.readexactly(size - 3)
    except asyncio.IncompleteReadError as error:
        if not error.partial and error.expected == 3:
            return None
        raise WireError(f"the stream ends within a packet, after {len(error.partial)} bytes") from None
    raise WireError(f"a packet must have at least 3 bytes, got a size of {size}")
