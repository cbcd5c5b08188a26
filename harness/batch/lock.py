"""One process at a time in a results folder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from servobench.harness.config.settings import ConfigurationError

LOCK = ".lock"


@contextlib.contextmanager
def locked(folder: Path, *, new: bool = False) -> Iterator[None]:
    """Keep other processes from writing the same folder; the lock of a process that died does not count.

    Args:
        folder: made if needed.
        new: refuse a folder with anything in it.

    Raises:
        ConfigurationError: another process writes the folder, it has something in it, or it cannot be made.
    """
    if new:
        check_empty(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("a")
    except OSError as error:
        raise ConfigurationError(f"results folder {folder} cannot be made: {error.strerror}") from error
    with file:
        if not _lock(file.fileno()):
            raise ConfigurationError(f"results folder {folder} is being written by another process")
        try:
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)


def _lock(descriptor: int) -> bool:
    """Lock an open file as long as it is open; return whether that was possible."""
    try:
        import fcntl  # noqa: PLC0415 - not on Windows
    except ImportError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return os.fstat(descriptor).st_nlink > 0  # another process held this file and has removed it since


def check_empty(folder: Path, *, can_resume: bool = False) -> None:
    """Refuse a folder with anything in it.

    Args:
        folder: that is to be made.
        can_resume: whether the batch could go on in it.

    Raises:
        ConfigurationError: it has.
    """
    if folder.exists() and (not folder.is_dir() or any(path.name != LOCK for path in folder.iterdir())):
        resume = ", or continue its batch with --resume" if can_resume and folder.is_dir() else ""
        raise ConfigurationError(f"results folder {folder} exists already; name another one with --out{resume}")
