"""One interface to an instance of a co-simulation FMU for FMI 2 and FMI 3.

The libraries are called by ctypes with argument objects that are made once: a call then costs a third of a microsecond,
whereas converting lists at every call costs several.
"""

from __future__ import annotations

import ctypes
import logging
import platform
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from servobench.plant.checks import FloatArray
from servobench.plant.faults import FmuError
from servobench.plant.fmu.description import FmuDescription, Variable, total_size

logger = logging.getLogger("servobench.fmu")

Call: TypeAlias = Callable[[], None]
RawCall: TypeAlias = Callable[[], int]  # returns the status, which the caller has to check
STATUS_WORDS = ("ok", "warning", "discard", "error", "fatal", "pending")
OK, WARNING, DISCARD = 0, 1, 2
REMEMBERED_MESSAGES = 5
MIN_PROGRESS = 1e-9  # share of a step that a partial step must cover
STATUS_LEVELS = (logging.DEBUG, logging.WARNING, logging.WARNING, logging.ERROR, logging.ERROR, logging.DEBUG)


class Port:
    """Variables that are read or written together, with their buffer.

    Attributes:
        labels: a name for each number, for messages.
        values: (size,), the buffer.
        references: value references as ctypes array.
        count: how many references.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        """Prepare the buffer."""
        self.labels = tuple(label for variable in variables for label in variable.labels())
        self.values: FloatArray = np.zeros(total_size(variables))
        self.count = len(variables)
        self.references = (ctypes.c_uint32 * self.count)(*(variable.reference for variable in variables))

    @property
    def summary(self) -> str:
        """A few names, for messages."""
        return ", ".join(self.labels[:3]) + (", …" if len(self.labels) > 3 else "")

    @property
    def pointer(self) -> Any:  # noqa: ANN401 - a ctypes pointer
        """The buffer, for C."""
        return self.values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


class MessageLog:
    """Forwards an FMU's messages to the log and keeps the last ones for errors."""

    def __init__(self, name: str) -> None:
        """Start empty."""
        self._name = name
        self._last: deque[str] = deque(maxlen=REMEMBERED_MESSAGES)

    def add(self, status: int, message: str) -> None:
        """Take a message with its status."""
        text = " ".join(message.split())
        self._last.append(text)
        level = STATUS_LEVELS[status] if 0 <= status < len(STATUS_LEVELS) else logging.ERROR
        logger.log(level, "%s: %s", self._name, text)

    def failure(self, function: str, status: int) -> FmuError:
        """Return the error of a failed call with the last messages, and forget these."""
        word = STATUS_WORDS[status] if 0 <= status < len(STATUS_WORDS) else "nothing usable"
        said = f"; the FMU said: {' | '.join(self._last)}" if self._last else ""
        self._last.clear()
        return FmuError(f"{self._name}: {function} returned {word}{said}")


class Instance(ABC):
    """One instance of a co-simulation FMU."""

    def __init__(self, description: FmuDescription, root: Path) -> None:
        """Load the library and make an instance.

        Raises:
            ValueError: no library for this machine, or one that cannot be loaded.
            FmuError: the FMU refused to make an instance.
        """
        self.description = description
        self.root = root
        self.log = MessageLog(description.path.name)
        self._library = load_library(description, root)
        self._component = ctypes.c_void_p()
        try:
            self._component = ctypes.c_void_p(self._instantiate())
        except BaseException:
            self.close()
            raise
        if not self._component.value:
            self.close()
            raise self.log.failure(f"instantiation of {description.model_name!r}", -1)

    @abstractmethod
    def _instantiate(self) -> int | None:
        """Make an instance and return its address."""

    @abstractmethod
    def start(self, time: float) -> None:
        """Go through initialisation, to begin at `time`."""

    @abstractmethod
    def reset(self) -> None:
        """Return to the state after instantiation."""

    @abstractmethod
    def raw_reader(self, port: Port) -> RawCall:
        """Return a function that reads the port's variables into its buffer, for the inner loop."""

    @abstractmethod
    def raw_writer(self, port: Port) -> RawCall:
        """Return a function that writes the port's buffer into its variables, for the inner loop."""

    @abstractmethod
    def stepper(self, step: float) -> Callable[[float], None]:
        """Return a function that advances from the time it is given, s, by `step`, s; it raises FmuError."""

    def reader(self, port: Port) -> Call:
        """Return a function that reads the port's variables into its buffer and checks the status."""
        return self._checked(f"reading {port.summary}", self.raw_reader(port))

    def writer(self, port: Port) -> Call:
        """Return a function that writes the port's buffer into its variables and checks the status."""
        return self._checked(f"writing {port.summary}", self.raw_writer(port))

    def _checked(self, what: str, call: RawCall) -> Call:
        return lambda: self.check(what, call())

    @abstractmethod
    def save(self) -> ctypes.c_void_p:
        """Return the present state; it has to be given to `free`."""

    @abstractmethod
    def restore(self, state: ctypes.c_void_p) -> None:
        """Return to a saved state."""

    @abstractmethod
    def free(self, state: ctypes.c_void_p) -> None:
        """Free a saved state."""

    @abstractmethod
    def to_bytes(self, state: ctypes.c_void_p) -> bytes:
        """Return a saved state as bytes that another process understands."""

    @abstractmethod
    def from_bytes(self, content: bytes) -> ctypes.c_void_p:
        """Return a state from bytes; it has to be given to `free`."""

    @abstractmethod
    def derivative(self, unknowns: Port, knowns: Port) -> None:
        """Turn the seed in the buffer of `knowns` into the sensitivity in the buffer of `unknowns`."""

    @abstractmethod
    def _free_instance(self) -> None:
        """Free the instance."""

    def close(self) -> None:
        """Free the instance and unload the library; calling it twice is allowed."""
        if self._component.value:
            self._free_instance()
            self._component = ctypes.c_void_p()
        if self._library is not None:
            unload_library(self._library)
            self._library = None

    def check(self, function: str, status: int) -> None:
        """Raise unless `status` is good.

        Raises:
            FmuError: it is not.
        """
        if status > WARNING or status < OK:
            raise self.log.failure(function, status)

    def call(self, function: str, *arguments: Any) -> None:  # noqa: ANN401 - what C takes
        """Call a function of the library on the instance and check its status; not for the inner loop."""
        self.check(function, self.function(function)(self._component, *arguments))

    def function(self, name: str) -> Any:  # noqa: ANN401 - a ctypes function
        """Return a function of the library.

        Raises:
            ValueError: the library does not have it.
        """
        try:
            return getattr(self._library, name)
        except AttributeError as error:
            raise ValueError(f"the library in {self.description.path.name} does not export {name}") from error

    def prebuilt(self, name: str, *arguments: Any) -> RawCall:  # noqa: ANN401 - what C takes
        """Return a function that calls `name` on the instance with arguments that are converted now."""
        return partial(self.function(name), self._component, *arguments)


def library_folders(version: int) -> tuple[str, ...]:
    """Return the folders below binaries/ in which a library for this machine may be, by FMI version."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    old = {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}.get(system, system)
    return (f"{machine}-{system}", old) if version == 2 else (f"{machine}-{system}",)


def load_library(description: FmuDescription, root: Path) -> Any:  # noqa: ANN401 - a ctypes library
    """Load the FMU's library for this machine.

    Raises:
        ValueError: there is none, or it cannot be loaded.
    """
    suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    for folder in library_folders(description.version):
        file = root / "binaries" / folder / f"{description.identifier}{suffix}"
        if file.is_file():
            try:
                return ctypes.CDLL(str(file))
            except OSError as error:
                raise ValueError(f"the library in {description.path.name} cannot be loaded: {error}") from error
    binaries = root / "binaries"
    there = sorted(folder.name for folder in binaries.iterdir()) if binaries.is_dir() else []
    raise ValueError(
        f"fmu file {description.path} has no library for this machine; "
        f"wanted {library_folders(description.version)[0]}, it has: {', '.join(there) or 'none'}"
    )


def unload_library(library: Any) -> None:  # noqa: ANN401 - a ctypes library
    """Give the library back to the system."""
    from fmpy import freeLibrary  # noqa: PLC0415 - see read_description

    freeLibrary(library._handle)
