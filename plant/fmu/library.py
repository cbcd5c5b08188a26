"""The library of an FMU: loading it for this machine, and the messages and status words of its instances."""

import ctypes
import logging
import os
import shutil
import tempfile
from collections import deque
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from servobench.plant.contract.cache import EXTRACTED, UNFINISHED, cache_folder, forbids_code
from servobench.plant.contract.faults import FmuError, one_line
from servobench.plant.contract.files import accessing
from servobench.plant.fmu.description import FmuDescription

NOEXEC_REMEDY = (
    "; it lies on a file system that is mounted noexec, so no code is loaded from it: let TMPDIR and XDG_CACHE_HOME "
    "name folders elsewhere"
)
_fatal: set[int] = set()  # handles of libraries that may never be called again; they stay loaded


class Library:
    """An instance's access to the library of its FMU, which the operating system loads once for all instances."""

    def __init__(self, description: FmuDescription) -> None:
        """Load the library, or a copy of it where it bears one instance only or an earlier one failed fatally.

        Raises:
            ValueError: there is none for this machine, or it cannot be loaded.
        """
        import fmpy  # noqa: PLC0415 - see parse_description

        self.loaded: Any = None  # as after `unload`
        root = description.root
        binaries = root / "binaries"
        wanted = f"{description.identifier}{fmpy.sharedLibraryExtension}"
        lacking = f"fmu file {description.path} has no library for this machine; wanted"
        # Many FMUs of FMI 2 bear the names of platforms of FMI 3.
        folders = [fmpy.platform_tuple]
        if description.dialect.system_folders:
            folders.append(fmpy.platform)
        for folder in folders:
            file = binaries / folder / wanted
            if file.is_file() and file.resolve().is_relative_to(root.resolve()):
                try:
                    self.loaded = _load(file, shared=not description.once_per_process)
                except OSError as error:
                    remedy = ""
                    if forbids_code(file):
                        remedy = NOEXEC_REMEDY
                    raise ValueError(
                        f"the library in {description.path.name} cannot be loaded: {error}{remedy}"
                    ) from error
                return
            if file.parent.is_dir():
                there = _names_in(file.parent) or "nothing"
                raise ValueError(f"{lacking} binaries/{folder}/{wanted}, it has there: {there}")
        there = _names_in(binaries) or "none"
        raise ValueError(f"{lacking} {fmpy.platform_tuple}, it has: {there}")

    @property
    def condemned(self) -> bool:
        """Whether an instance reported a fatal error, after which none may be called."""
        return self.loaded is not None and self.loaded._handle in _fatal

    def condemn(self) -> None:
        """Record a fatal error of an instance."""
        _fatal.add(self.loaded._handle)

    def unload(self) -> None:
        """Unload the library, unless a fatal error forbids any further call; calling it twice is allowed."""
        from fmpy import freeLibrary  # noqa: PLC0415 - see parse_description

        if self.loaded is not None and not self.condemned:
            freeLibrary(self.loaded._handle)
        self.loaded = None


def _names_in(folder: Path) -> str:
    """Return the names in a folder; none in one that is not there."""
    return ", ".join(sorted(path.name for path in folder.glob("*")))


def _load(file: Path, *, shared: bool) -> ctypes.CDLL:
    """Load a library that may be shared by several instances.

    Where it may not, or never again, it is a copy of it and of its folder, which shares no variables with another one.
    """
    if shared:
        library = ctypes.CDLL(str(file))
        if library._handle not in _fatal:
            return library
    # The first folder from which code may be loaded; a truth value of False comes first.
    candidates = (Path(tempfile.gettempdir()), cache_folder(EXTRACTED))
    place = min(candidates, key=forbids_code)
    place.mkdir(parents=True, exist_ok=True)
    prefix = f"{UNFINISHED}servobench-"
    with tempfile.TemporaryDirectory(
        prefix=prefix, dir=place, ignore_cleanup_errors=True
    ) as folder:
        copied = shutil.copytree(file.parent, Path(folder) / "library")
        return ctypes.CDLL(str(copied / file.name))


@cache
def plain_root(root: Path) -> Path:
    """Return a path to an extracted FMU without letters that a URI encodes, which many FMUs do not decode.

    It is valid as long as this process lives; where the system has none, it is `root`.
    """
    if root.as_uri() != f"file://{root}":
        descriptor = os.open(root, os.O_RDONLY)
        plain = Path(f"/proc/{os.getpid()}/fd/{descriptor}")
        if plain.is_dir():
            return plain
    return root


logger = logging.getLogger("servobench.fmu")

STATUS_WORDS = dict(enumerate(("ok", "warning", "discard", "error", "fatal", "pending")))
STATUS_LEVELS = (
    logging.DEBUG,
    logging.WARNING,
    logging.WARNING,
    logging.ERROR,
    logging.ERROR,
    logging.DEBUG,
)
REMEMBERED_MESSAGES = 5


class MessageLog:
    """Forwards an FMU's messages to the log and keeps the last ones for errors."""

    def __init__(self, name: str, file: Path | None = None) -> None:
        """Start empty; messages are also appended to `file`, if one is given.

        Raises:
            ValueError: the file cannot be written.
        """
        self._name = name
        self._file = file
        with accessing(file, "debug_log"):
            self._append(f"an instance of {name}")
        self._last: deque[str] = deque(maxlen=REMEMBERED_MESSAGES)

    def add(self, status: int, message: bytes | None) -> None:
        """Take a message of C with its status."""
        words = (message or b"").decode("utf-8", errors="replace")
        text = one_line(words)
        self._last.append(text)
        level = STATUS_LEVELS[status] if 0 <= status < len(STATUS_LEVELS) else logging.ERROR
        logger.log(level, "%s: %s", self._name, text)
        with suppress(OSError):  # No exception may pass through the FMU that calls this.
            self._append(f"{STATUS_WORDS.get(status, f'status {status}')}: {text}")

    def _append(self, line: str) -> None:
        """Write a line to the file, if there is one."""
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as file:
                file.write(f"{line}\n")

    def failure(self, function: str, outcome: int | str) -> FmuError:
        """Return the error of a failed call, with its status or another outcome in words, and the last messages.

        The messages are forgotten.
        """
        word = STATUS_WORDS.get(outcome, "nothing usable") if isinstance(outcome, int) else outcome
        text = f"{self._name}: {function} returned {word}"
        if self._last:
            text += f"; the FMU said: {' | '.join(self._last)}"
        self._last.clear()
        return FmuError(text)
