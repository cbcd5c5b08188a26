"""The user's cache folder: entries with checksums, made once, and made again where they are damaged.

    <cache>/servobench/<kind>/<key>/files/...      the files
    <cache>/servobench/<kind>/<key>/SHA256SUMS     their checksums

An entry appears whole or not at all, also if several processes make it at once. A process verifies it once, so that a
flipped bit or a file cut short never reaches a run. Entries that were not used for long are removed.

Users may share data, as their umask says. Code is kept where no other user can write. Where the cache cannot be
written, a temporary folder of the user's own takes its place.
"""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import stat
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from platformdirs import user_cache_path

from servobench.plant.contract.checksums import SUMS, append_sums, digest, fault, read_sums
from servobench.plant.contract.files import Write
from servobench.plant.contract.settings import remark

FILES = "files"
UNFINISHED = ".unfinished-"
EXTRACTED = "extracted"  # kind of unpacked FMUs
BUILT = "fmus"  # kind of FMUs that were built here
COMPILED = "compiled"  # kind of controllers in C that were compiled here
CODE = (EXTRACTED, BUILT, COMPILED)  # kinds whose files are loaded as code
PRIVATE = 0o700  # mode of a folder that is for its owner only
# Errors of a folder that this user may not write
NOT_ALLOWED = (errno.EACCES, errno.EPERM, errno.EROFS)
# A path that reads the same in a URI, which an FMU gets
PLAIN = re.compile(r"[\w.~/-]*", re.ASCII)
LOCK_TIME = 10.0  # [s] for another process to move its entry
LOCK_PAUSE = 0.01  # [s] between two tries
# Also for a pipe, and the file of another user
LOCK_FLAGS = os.O_RDONLY | os.O_CREAT | os.O_NONBLOCK
MAX_ENTRIES = 32  # number of entries of a kind that are kept if they are older than `MIN_AGE`
MIN_AGE = 24 * 3600.0  # [s] since its last use, below which an entry is never removed
MAX_AGE = 90 * 24 * 3600.0  # [s] since its last use, above which an entry is removed

_unfinished = partial(tempfile.TemporaryDirectory, prefix=UNFINISHED, ignore_cleanup_errors=True)
_verified: set[Path] = set()


def cache_folder(kind: str) -> Path:
    """Return the folder in which new entries of a kind, such as "networks", are made."""
    folders = _folders(kind)
    return next(filter(_is_writable, folders), folders[0])


def cached(kind: str, key: str, make: Write) -> Path:
    """Return the folder with the files of an entry; they are made where they are missing or damaged.

    Args:
        kind: of the entry.
        key: a name for all that the files depend on.
        make: writes the files into an empty folder.

    Raises:
        ValueError: no cache folder can be written, or `make` raises it.
    """
    entries = [folder / key for folder in _folders(kind)]
    entry = next(filter(_is_there, entries), None)
    if entry is None:
        entry = _make_one(entries, make)
    if entry not in _verified:
        _verified.add(entry)
        with contextlib.suppress(OSError):  # The cache may be read-only.
            os.utime(entry)
    root = entry.parent.parent
    user = _user_cache()
    if root != user and (user is None or not _is_writable(user)):
        remark(
            f"no cache folder can be written; {root} takes its place: let XDG_CACHE_HOME name one that stays"
        )
    return entry / FILES


def key_of(*parts: object) -> str:
    """Return a key for the JSON values that an entry depends on."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _folders(kind: str) -> list[Path]:
    """Return the folders in which entries of a kind may be: that in the user's cache, and a temporary one.

    Raises:
        ValueError: other users can write all of them.
    """
    user = _user_cache()
    temporary = _temporary_cache()
    folders = []
    for root, may_be_shared in ((user, kind not in CODE), (temporary, False)):
        if root is not None and (may_be_shared or _is_private(root / kind)):
            folders.append(root / kind)
    if kind in CODE:
        folders.sort(
            key=lambda folder: forbids_code(folder) or PLAIN.fullmatch(str(folder)) is None
        )
    if not folders:
        raise ValueError(
            f"other users could write code into the cache folders {user} and {temporary}; let XDG_CACHE_HOME name a "
            "folder of your own"
        )
    return folders


def _user_cache() -> Path | None:
    """Return the folder of all kinds in the user's cache; None for a user without a home folder."""
    with contextlib.suppress(RuntimeError):  # The user has no name either.
        if os.environ.get("XDG_CACHE_HOME", "").strip() or Path.home().is_dir():
            return user_cache_path("servobench").absolute()
    return None


def _temporary_cache() -> Path | None:
    """Return the same in the temporary folder; None where there is none."""
    with contextlib.suppress(FileNotFoundError):
        return Path(tempfile.gettempdir(), f"servobench-{os.geteuid()}").absolute()
    return None


def _existing(folder: Path) -> Path:
    """Return a folder, or the nearest one around it that exists."""
    return next(each for each in (folder, *folder.parents) if os.path.lexists(each))


def _is_writable(folder: Path) -> bool:
    return os.access(_existing(folder), os.W_OK | os.X_OK)


def _is_private(folder: Path) -> bool:
    """Return whether no other user can write or replace a folder of a kind; a group that is the user's alone may."""
    for each in (folder, *folder.parents[:2]):
        try:
            found = each.stat()
        except OSError:  # It is made as the user's own.
            continue
        if found.st_uid not in (os.geteuid(), 0):
            return False
        writers = stat.S_IWOTH
        if found.st_gid != found.st_uid:
            writers |= stat.S_IWGRP
        # As in /tmp: entries stay their owners'
        kept_apart = each != folder and found.st_mode & stat.S_ISVTX
        if found.st_mode & writers and not kept_apart:
            return False
    return True


def forbids_code(folder: Path) -> bool:
    """Return whether a folder lies on a file system that is mounted noexec."""
    return bool(os.statvfs(_existing(folder)).f_flag & getattr(os, "ST_NOEXEC", 0))


def _is_there(entry: Path) -> bool:
    """Return whether an entry is whole, which a process finds out once."""
    return (entry in _verified and entry.is_dir()) or is_whole(entry)


def is_whole(entry: Path) -> bool:
    """Return whether the files of an entry are there as they were made; additional files do not matter."""
    with contextlib.suppress(OSError):
        if not (entry / SUMS).is_file():  # A pipe would be read forever.
            return False
        sums = read_sums(entry) or {}
        return bool(sums) and all(fault(entry, name, sums) is None for name in sums)
    return False


def _make_one(entries: list[Path], make: Write) -> Path:
    """Make the first of several entries whose folder this user may write, and return it."""
    for entry in entries:
        try:
            _make(entry, make)
        except OSError as error:
            if error.errno not in NOT_ALLOWED or entry == entries[-1]:
                raise ValueError(
                    f"cache folder {entry.parent} cannot be written: {error.strerror or error}; make room there, "
                    "or let XDG_CACHE_HOME name another place"
                ) from error
        else:
            break
    return entry


def _make(entry: Path, make: Write) -> None:
    """Make an entry in a temporary folder and move it to its place; nothing is left where that fails."""
    kind = entry.parent
    if kind.parent == _temporary_cache():
        kind.parent.mkdir(mode=PRIVATE, exist_ok=True)
    kind.mkdir(parents=True, exist_ok=True)
    if kind.name in CODE and not _is_private(kind):  # Another user was faster.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(kind))
    with _unfinished(dir=kind) as name:
        fresh = Path(name) / entry.name
        fresh.mkdir()  # Its mode is that of the umask.
        if kind.name in CODE:
            fresh.chmod(PRIVATE)
        (fresh / FILES).mkdir()
        make(fresh / FILES)
        files = [path for path in sorted((fresh / FILES).rglob("*")) if path.is_file()]
        append_sums(fresh, {path.relative_to(fresh).as_posix(): digest(path) for path in files})
        with _alone(kind):
            if not is_whole(entry):  # Otherwise another process was faster.
                _remove(entry)
                fresh.rename(entry)
            _prune(kind)


def _remove(entry: Path) -> None:
    """Remove an entry in one step, so that no process finds a part of it under its name."""
    if os.path.lexists(entry):
        with _unfinished(dir=entry.parent) as aside, contextlib.suppress(FileNotFoundError):
            entry.rename(Path(aside) / entry.name)


def _prune(kind: Path) -> None:
    """Remove entries that were not used for long, and unfinished ones of processes that were killed."""
    now = time.time()
    ages = {}
    for path in kind.iterdir():
        with contextlib.suppress(OSError):
            ages[path] = now - path.stat().st_mtime
    entries = sorted((path for path in ages if path.is_dir()), key=lambda path: ages[path])
    for place, entry in enumerate(entries):
        age = ages[entry]
        unfinished = entry.name.startswith(UNFINISHED)
        superfluous = age > MIN_AGE and (unfinished or place >= MAX_ENTRIES)
        if age > MAX_AGE or superfluous:
            with contextlib.suppress(OSError):  # It may be another user's.
                _remove(entry)


@contextlib.contextmanager
def _alone(kind: Path) -> Iterator[None]:
    """Hold a lock against other processes that move entries of a kind, where the file system has such locks."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            descriptor = os.open(kind / ".lock", LOCK_FLAGS, 0o666)
            stack.callback(os.close, descriptor)
            _wait_for_lock(descriptor)
        yield


def _wait_for_lock(descriptor: int) -> None:
    """Take a lock, for which a process waits a while: another user could hold it without end."""
    deadline = time.monotonic() + LOCK_TIME
    while time.monotonic() < deadline:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(LOCK_PAUSE)
