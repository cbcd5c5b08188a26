"""Opens an .fmu archive: checks it, extracts it where nothing else lives, and leaves nothing behind.

Each archive gets a folder of its own below the system's folder for temporary files. It goes away when it is closed,
when it is garbage-collected and when the interpreter ends; the folder of a process that was killed is removed by the
next one that opens an FMU, which it can tell by a lock that dies with its holder.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import weakref
import zipfile
from pathlib import Path, PurePosixPath

if sys.platform != "win32":
    import fcntl

PREFIX = "servobench-fmu-"
LOCK = "lock"


class FmuFolder:
    """An extracted FMU."""

    def __init__(self, path: Path) -> None:
        """Extract the FMU at `path`.

        Raises:
            ValueError: no such file, not a zip archive, an archive that is damaged or climbs out of its folder, or one
                without a model description.
        """
        with _open(path) as archive:
            _check_names(path, archive)
            sweep_stale_folders()
            folder = Path(tempfile.mkdtemp(prefix=PREFIX))
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT)
            _try_lock(lock)
            self._finalizer = weakref.finalize(self, _remove, folder, lock)
            self.root = folder / "fmu"
            try:
                archive.extractall(self.root)
            except (zipfile.BadZipFile, OSError, NotImplementedError, RuntimeError) as error:
                self.close()
                raise ValueError(f"fmu file {path} cannot be extracted: {error}") from error

    def close(self) -> None:
        """Remove the folder; calling it twice is allowed."""
        self._finalizer()


def sweep_stale_folders() -> None:
    """Remove the folders of processes that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            lock = os.open(folder / LOCK, os.O_RDWR)
            try:
                if _try_lock(lock):
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def _open(path: Path) -> zipfile.ZipFile:
    if not path.is_file():
        raise ValueError(f"fmu file {path} does not exist")
    try:
        return zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise ValueError(f"fmu file {path} is not a zip archive: {error}") from error


def _check_names(path: Path, archive: zipfile.ZipFile) -> None:
    names = [entry.orig_filename for entry in archive.infolist()]
    for name in names:
        parts = PurePosixPath(name.replace("\\", "/"))
        if "\\" in name or ":" in name or parts.is_absolute() or ".." in parts.parts:
            raise ValueError(f"fmu file {path} holds {name!r}, which would climb out of the folder it is extracted to")
    if "modelDescription.xml" not in names:
        raise ValueError(f"fmu file {path} holds no modelDescription.xml, so it is not an FMU")


def _try_lock(lock: int) -> bool:
    """Take the lock if nobody holds it; where there are no such locks, open files cannot be removed either."""
    if sys.platform == "win32":
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove(folder: Path, lock: int) -> None:
    os.close(lock)
    shutil.rmtree(folder, ignore_errors=True)
