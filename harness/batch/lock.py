"""One process at a time in a results folder, and who it is.

The lock is `flock` on the file `.lock`, which the system releases when the process ends. The file names its holder.
A file system without such locks (some network mounts) holds no results folder.
"""

import contextlib
import errno
import fcntl
import getpass
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from servobench.plant.contract.checksums import SUMS
from servobench.plant.contract.faults import ConfigurationError, one_line
from servobench.plant.contract.files import PARTIAL, accessing, harmless

LOCK = ".lock"
PARTS = "parts"
NAME_TIMEOUT = 1.0  # [s] for which a refused process waits until the holder has written its name
NAME_POLL = 0.01  # [s]


@dataclass(frozen=True)
class Holder:
    """The process that holds a lock."""

    owner: str  # name of the user
    host: str
    pid: int
    begun: str  # date and time at which it took the lock, UTC
    started: str  # start of the process, as the system counts; a later one with the same number differs here

    @classmethod
    def this_process(cls) -> Self:
        """Return the entry of this process in a lock."""
        try:
            owner = getpass.getuser()
        except (OSError, KeyError):  # a user without a name, as in a container
            owner = f"user {os.getuid()}"
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(owner, platform.node(), os.getpid(), now, _start_of(os.getpid()))

    @classmethod
    def read(cls, file: Path) -> Self | None:
        """Return the holder that a lock names; None where it names none."""
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            texts = (str(content[key])[:200] for key in ("owner", "host", "begun", "started"))
            owner, host, begun, started = map(one_line, texts)
            return cls(owner, host, int(content["pid"]), begun, started)
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None

    def __str__(self) -> str:
        """Return who it is in words."""
        return f"process {self.pid} of {self.owner} on {self.host}, since {self.begun}"

    @property
    def gone(self) -> bool:
        """Whether it is known to have ended; never for a process of another machine."""
        return self.host == platform.node() and self.started != _start_of(self.pid)


@dataclass(frozen=True)
class Lock:
    """A lock that this process holds."""

    file: Path
    descriptor: int  # descriptor of the open file
    stale: Holder | None  # the holder before, which ended without giving the lock back

    def check(self) -> None:
        """Refuse to go on in a folder that is another one by now.

        Raises:
            FileNotFoundError: the folder was removed, or removed and made again by another process.
        """
        if not _same(self.file, self.descriptor):
            raise FileNotFoundError(
                errno.ENOENT, "it was removed by another process", str(self.file.parent)
            )


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[Lock]:
    """Keep other processes from writing the same folder; the lock of a process that died does not count.

    Args:
        folder: made if needed.

    Raises:
        ConfigurationError: another process writes the folder, it cannot be made, or a link is in it.
    """
    path = folder / LOCK
    refuse_links(folder)
    with accessing(folder, "results folder"):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, stale = _acquire(path)
    try:
        with contextlib.suppress(OSError):  # a full disk does not keep the lock from being held
            if os.fstat(descriptor).st_nlink == 1:  # otherwise it is also a file elsewhere
                os.ftruncate(descriptor, 0)
                os.write(descriptor, json.dumps(asdict(Holder.this_process())).encode() + b"\n")
        yield Lock(path, descriptor, stale)
    finally:
        with contextlib.suppress(OSError):  # the folder may be gone, or read-only by now
            if _same(path, descriptor):
                path.unlink()
        os.close(descriptor)


def current_holder(folder: Path) -> Holder | None:
    """Return the process that writes a folder, as far as it can be told; None if none does.

    Raises:
        ConfigurationError: a link or pipe is in the folder.
    """
    refuse_links(folder)
    holder = Holder.read(folder / LOCK)
    if holder is None or holder.gone:
        return None
    return holder


def _acquire(path: Path) -> tuple[int, Holder | None]:
    """Return the descriptor of the locked file, and the holder whose process ended without giving it back."""
    before = None
    while True:
        before = Holder.read(path) or before
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _same(path, descriptor):
                return os.dup(descriptor), before  # a lock stays as long as any duplicate is open
        except BlockingIOError:
            holder = _wait_for_name(path, descriptor)
            # The holder may give the lock back while its name is awaited; then the lock is free again.
            if _same(path, descriptor):
                who = holder or before or "a process that did not write its name"
                raise ConfigurationError(
                    f"results folder {path.parent} is being written by {who}"
                ) from None
        except OSError as error:
            raise ConfigurationError(
                f"results folder {path.parent} lies on a file system without locks ({error.strerror}), as some "
                "network mounts are; name a local folder and copy it afterwards"
            ) from error
        finally:
            os.close(descriptor)


def _wait_for_name(path: Path, descriptor: int) -> Holder | None:
    """Return the process that holds a lock, which writes its name after it took the lock.

    Returns:
        None where it gives the lock back, or does not write its name within `NAME_TIMEOUT`.
    """
    deadline = time.monotonic() + NAME_TIMEOUT
    while _same(path, descriptor):
        holder = Holder.read(path)
        if holder is not None and not holder.gone:
            return holder
        if time.monotonic() > deadline:
            return None
        time.sleep(NAME_POLL)
    return None


def _same(path: Path, descriptor: int) -> bool:
    """Return whether an open file still has its name."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except OSError:
        return False


def _start_of(pid: int) -> str:
    """Return when a process of this machine started, in the system's own count; empty where it does not say."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError, UnicodeDecodeError):
        return ""


def check_empty(folder: Path, *, can_resume: bool = False) -> None:
    """Refuse a folder with anything in it but the remains of a batch that could not begin.

    Args:
        folder: that is to be made.
        can_resume: whether the batch could go on in it.

    Raises:
        ConfigurationError: it has, it cannot be read, or its name is no text, of which Parquet could read no file.
    """
    if any("\ud800" <= letter <= "\udfff" for letter in str(folder)):
        encoding = sys.getfilesystemencoding()
        raise ConfigurationError(
            f"results folder {folder}: its name is no {encoding}; give another one as `out`"
        )
    with accessing(folder, "results folder"):
        taken = not is_unused(folder)
    if taken:
        resume = ", or continue its batch with `resume`" if can_resume and folder.is_dir() else ""
        raise ConfigurationError(
            f"results folder {folder} exists already; give another one as `out`{resume}"
        )


def refuse_links(folder: Path) -> None:
    """Refuse a folder that holds anything but files and folders: by a link, files elsewhere would be read or written.

    Raises:
        ConfigurationError: names the link, pipe, socket or device.
    """
    waiting = [os.fspath(folder)]
    while waiting:
        with contextlib.suppress(OSError), os.scandir(waiting.pop()) as inside:
            for entry in inside:
                if harmless(entry.name) != entry.name or "\n" in entry.name:
                    raise ConfigurationError(
                        f"{folder} holds a file whose name cannot be printed, {entry.name!a}"
                    )
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                elif not entry.is_file(follow_symlinks=False):
                    raise ConfigurationError(
                        f"{entry.path} is {'a link' if entry.is_symlink() else 'no file'}, and a results "
                        "folder holds files only; put a copy in its place"
                    )


def is_unused(folder: Path) -> bool:
    """Return whether a folder is missing, empty, or of a batch that ended before its first run."""
    if not folder.is_dir():
        return not folder.exists()
    parts = folder / PARTS
    try:
        left = {path for path in folder.iterdir() if path.name not in (LOCK, SUMS)}
        if parts.is_dir():
            left = left - {parts} | set(parts.iterdir())
    except FileNotFoundError:  # another process has just put its parts together
        return False
    return all(PARTIAL.fullmatch(path.name) for path in left)
