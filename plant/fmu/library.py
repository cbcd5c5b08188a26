"""Loads the library of an FMU for this machine."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
from pathlib import Path
from typing import Any

from servobench.plant.fmu.description import FmuDescription

_fatal: set[int] = set()  # handles of libraries that may never be called again; they stay loaded


def condemn(library: Any) -> None:  # noqa: ANN401 - a ctypes library
    """Take note that an instance reported a fatal error: no instance of this library may be called again."""
    _fatal.add(library._handle)


def is_condemned(library: Any) -> bool:  # noqa: ANN401 - a ctypes library
    """Return whether no instance of a library may be called again."""
    return library._handle in _fatal


def load_library(description: FmuDescription, root: Path) -> Any:  # noqa: ANN401 - a ctypes library
    """Load the FMU's library for this machine.

    Raises:
        ValueError: there is none, or it cannot be loaded.
    """
    import fmpy  # noqa: PLC0415 - see parse_description

    wanted = f"{description.identifier}{fmpy.sharedLibraryExtension}"
    binaries = root / "binaries"
    for folder in (fmpy.platform_tuple, fmpy.platform)[: 2 if description.version == 2 else 1]:
        file = binaries / folder / wanted
        if file.is_file() and file.resolve().is_relative_to(root.resolve()):
            try:
                library = None if description.once_per_process else ctypes.CDLL(str(file))
                return _load_copy(file) if library is None or is_condemned(library) else library
            except OSError as error:
                raise ValueError(f"the library in {description.path.name} cannot be loaded: {error}") from error
        if file.parent.is_dir():
            there = ", ".join(sorted(each.name for each in file.parent.iterdir())) or "nothing"
            raise ValueError(
                f"fmu file {description.path} has no library for this machine; "
                f"wanted binaries/{folder}/{wanted}, it has there: {there}"
            )
    there = ", ".join(sorted(folder.name for folder in binaries.iterdir())) if binaries.is_dir() else ""
    raise ValueError(
        f"fmu file {description.path} has no library for this machine; "
        f"wanted {fmpy.platform_tuple}, it has: {there or 'none'}"
    )


def _load_copy(file: Path) -> ctypes.CDLL:
    """Load a copy of a library and of what lies beside it, so that it shares no variables with another instance."""
    with tempfile.TemporaryDirectory(prefix="servobench-", ignore_cleanup_errors=True) as folder:
        return ctypes.CDLL(str(shutil.copytree(file.parent, Path(folder) / "library") / file.name))


def unload_library(library: Any) -> None:  # noqa: ANN401 - a ctypes library
    """Give the library back to the system, unless it may never be called again, not even to unload it."""
    if is_condemned(library):
        return
    from fmpy import freeLibrary  # noqa: PLC0415 - see parse_description

    freeLibrary(library._handle)
