"""The user's cache folder: entries with checksums, made once, and made again where they are damaged.

    <cache>/servobench/<kind>/<key>/files/...      the files
    <cache>/servobench/<kind>/<key>/SHA256SUMS     their checksums

An entry appears whole or not at all, also if several processes make it at once. A process verifies it once, so that a
flipped bit or a file cut short never reaches a run. Entries that were not used for long are removed.
"""

import contextlib
import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from platformdirs import user_cache_path

from servobench.plant.contract.checksums import append_sums, digest, fault, read_sums

FILES: Final = "files"
UNFINISHED: Final = ".unfinished-"
MAX_ENTRIES: Final = 32  # number of entries of a kind that are kept if they are older than `MIN_AGE`
MIN_AGE: Final = 24 * 3600.0  # [s] since its last use, below which an entry is never removed
MAX_AGE: Final = 90 * 24 * 3600.0  # [s] since its last use, above which an entry is removed

_unfinished = partial(tempfile.TemporaryDirectory, prefix=UNFINISHED, ignore_cleanup_errors=True)
_verified: set[Path] = set()


def cache_folder(kind: str) -> Path:
    """Return the folder of all entries of a kind, such as "networks"."""
    return user_cache_path("servobench") / kind


def cached(kind: str, key: str, make: Callable[[Path], object]) -> Path:
    """Return the folder with the files of an entry; they are made where they are missing or damaged.

    Args:
        kind: of the entry.
        key: a name for all that the files depend on.
        make: writes the files into an empty folder.

    Raises:
        ValueError: the cache folder cannot be written, or `make` raises it.
    """
    entry = cache_folder(kind) / key
    if entry not in _verified or not entry.is_dir():
        if not is_whole(entry):
            _make(entry, make)
        _verified.add(entry)
        with contextlib.suppress(OSError):  # The cache may be read-only.
            os.utime(entry)
    return entry / FILES


def is_whole(entry: Path) -> bool:
    """Return whether the files of an entry are there as they were made; additional files do not matter."""
    with contextlib.suppress(OSError):
        sums = read_sums(entry) or {}
        return bool(sums) and all(fault(entry, name, sums) is None for name in sums)
    return False


def _make(entry: Path, make: Callable[[Path], object]) -> None:
    """Make an entry in a temporary folder and move it to its place; nothing is left where that fails."""
    kind = entry.parent
    try:
        kind.mkdir(parents=True, exist_ok=True)
        with _unfinished(dir=kind) as name:
            fresh = Path(name)
            (fresh / FILES).mkdir()
            make(fresh / FILES)
            files = [path for path in sorted((fresh / FILES).rglob("*")) if path.is_file()]
            append_sums(fresh, {path.relative_to(fresh).as_posix(): digest(path) for path in files})
            with _alone(kind):
                if not is_whole(entry):  # Otherwise another process was faster.
                    _remove(entry)
                    fresh.rename(entry)
                _prune(kind)
    except OSError as error:
        raise ValueError(
            f"cache folder {kind} cannot be written: {error.strerror or error}; make room there, "
            "or let XDG_CACHE_HOME name another place"
        ) from error


def _remove(entry: Path) -> None:
    """Remove an entry in one step, so that no process finds a part of it under its name."""
    if entry.exists():
        with _unfinished(dir=entry.parent) as aside, contextlib.suppress(FileNotFoundError):
            entry.rename(Path(aside) / entry.name)


def _prune(kind: Path) -> None:
    """Remove entries that were not used for long, and unfinished ones of processes that were killed."""
    now, ages = time.time(), dict[Path, float]()
    for path in kind.iterdir():
        with contextlib.suppress(FileNotFoundError):
            ages[path] = now - path.stat().st_mtime
    entries = sorted((path for path in ages if path.is_dir()), key=lambda path: ages[path])
    for place, entry in enumerate(entries):
        unfinished = entry.name.startswith(UNFINISHED)
        if ages[entry] > MAX_AGE or (ages[entry] > MIN_AGE and (unfinished or place >= MAX_ENTRIES)):
            _remove(entry)


@contextlib.contextmanager
def _alone(kind: Path) -> Iterator[None]:
    """Hold a lock, until its file is closed, against other processes that move entries of a kind."""
    with (kind / ".lock").open("a") as file:
        with contextlib.suppress(OSError):  # not all file systems have such locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
