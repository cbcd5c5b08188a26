"""RTDE packets: the variables of a UR's controller, recipes of them, and the bytes on the socket.

A packet is big-endian: u16 size of the whole, u8 kind, body. A recipe is a list of variables that travel together.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol versions 1 and 2; the omissions of version 1
agree with Universal Robots' client library.

No request of HTTP begins a packet: its first byte is a printable character or the end of a line, and so is its second
one, which as a size is above that of any packet. A TLS record begins with 0x16, likewise too large.
"""

import asyncio
import re
import struct
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, Self, TypeAlias

from servobench.plant.contract.facts import read_beside
from servobench.plant.contract.files import Record

CONTROLLER = read_beside(__file__, "controller.toml")
MAX_NAMES = 2048  # bytes of a list of names, by the guide
# Bytes of a packet of a client: a list of names with its frequency
MAX_PACKET = 3 + 8 + MAX_NAMES
SIZES = {"V": 5, "v": 3, "S": 3, "P": 3}  # bytes of the packets that have one size only
KINDS = {*SIZES, "O", "I", "U", "M"}  # those that a client sends
MAX_LINE = 4096  # bytes
# HTTP, or bytes that are no text
FOREIGN = re.compile(rb"[A-Z]+ |.*(?i:http)/\d|.*[\x00-\x08\x0b\x0c\x0e-\x1f]")
NOT_FOUND = "NOT_FOUND"
Say: TypeAlias = Callable[[str], None]  # prints a line for the user
CODES = CONTROLLER["codes"]  # type -> layout of struct
ZEROS = {kind: (0,) * int(code[:-1] or 1) for kind, code in CODES.items()}
REGISTERS = {"int": "INT32", "double": "DOUBLE"}


def _types(way: str) -> dict[str, str]:
    """Return the type of each variable that travels one way, `input` or `output`."""
    registers = {
        f"{way}_{word}_register_{k}": kind for word, kind in REGISTERS.items() for k in range(48)
    }
    return {
        name: kind for kind, names in CONTROLLER[f"{way}s"].items() for name in names.split()
    } | registers


OUTPUTS = _types("output")
INPUTS = _types("input")


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
        """Return the recipe of a comma-separated list of known variables, or raise a `WireError` for no such list.

        A list without names has one that is not found.
        """
        names = tuple(name for name in body.decode("ascii", "replace").split(",") if name)
        if len(body) > MAX_NAMES or not body.isascii():
            raise WireError(
                f"a recipe must be at most {MAX_NAMES} bytes of names, got {len(body)}, {body[:20]!r}"
            )
        names = names or ("",)
        return cls(names, tuple(known.get(name, NOT_FOUND) for name in names))

    @cached_property
    def layout(self) -> struct.Struct:
        """The values on the wire, after the number of the recipe; all types have to be known."""
        return struct.Struct(">" + "".join(CODES[each] for each in self.types))

    def pack(self, values: Record) -> bytes:
        """Return the values as bytes, numbers or tuples of them by name; one that is missing is zero."""
        numbers: list[Any] = []
        for name, kind in zip(self.names, self.types, strict=True):
            value = values.get(name, ZEROS[kind])
            numbers.extend(value if isinstance(value, Iterable) else (value,))
        return self.layout.pack(*numbers)

    def unpack(self, body: bytes) -> Record:
        """Return the value of each variable, or raise a `WireError` for another number of bytes."""
        if len(body) != self.layout.size:
            raise WireError(
                f"data of {self.names[0]} … must be {self.layout.size} bytes, got {len(body)}"
            )
        numbers = iter(self.layout.unpack(body))
        values = {}
        for name, kind in zip(self.names, self.types, strict=True):
            size = len(ZEROS[kind])
            first, *others = islice(numbers, size)
            values[name] = (first, *others) if others else first
        return values


def packet(kind: str, body: bytes) -> bytes:
    """Return a packet of a kind, one letter."""
    return struct.pack(">HB", 3 + len(body), ord(kind)) + body


async def read_packet(reader: asyncio.StreamReader) -> tuple[str, bytes] | None:
    """Return kind and body of the next packet, None at the end, or raise a `WireError` where it has no size or end.

    Kind and size are judged before the body is awaited.
    """
    try:
        head = await reader.readexactly(3)
        kind = chr(head[2])
        size = int.from_bytes(head[:2])
        check_head(kind, size)
        return kind, await reader.readexactly(size - 3)
    except asyncio.IncompleteReadError as error:
        if not error.partial and error.expected == 3:
            return None
        raise WireError(
            f"the stream ends within a packet, after {len(error.partial)} bytes"
        ) from None


def check_head(kind: str, size: int) -> None:
    """Raise a `WireError` where no client sends a packet of this kind and size."""
    if not 3 <= size <= MAX_PACKET:
        start = size.to_bytes(2)
        raise WireError(
            f"a packet must have 3 to {MAX_PACKET} bytes, got a size of {size} ({start!r})"
        )
    if kind not in KINDS:
        raise WireError(f"kind {kind!r} of packet is none that a client sends")
    if size != SIZES.get(kind, size):
        raise WireError(
            f"a packet of kind {kind!r} must have {SIZES[kind]} bytes, got a size of {size}"
        )


def read_message(body: bytes, version: int) -> str:
    """Return the text of a message, or raise a `WireError` where its parts do not fill it.

    Version 1 sends level and text, version 2 length, text, length, source and level.
    """
    end = len(body)
    whole = end > 0
    if version == 2:
        try:
            end = 1 + body[0]
            whole = len(body) == end + body[end] + 2
        except IndexError:
            whole = False
    if not whole:
        raise WireError(f"a text message must be as long as its parts say, got {len(body)} bytes")
    return body[1:end].decode("ascii", "replace")


async def read_lines(reader: asyncio.StreamReader) -> AsyncIterator[str]:
    """Yield lines without their ends, or raise a `WireError` as soon as one is too long, HTTP or no text."""
    rest = b""
    while data := await reader.read(MAX_LINE):
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            yield _read_line(line)
        _read_line(rest)
    if rest:
        yield _read_line(rest)


def _read_line(line: bytes) -> str:
    if len(line) > MAX_LINE:
        raise WireError(f"a line must have at most {MAX_LINE} bytes")
    if FOREIGN.match(line):
        raise WireError(f"{line[:20]!r} is HTTP, TLS or no text")
    return line.decode("ascii", "replace").strip()
