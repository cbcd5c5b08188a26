"""What vouches for the files of a results folder: `SHA256SUMS`, a line a file, as `sha256sum --check` reads it.

While a batch is under way the file only grows. A line is on the disk before the file that it is about has its name, so
that a file without a line was never written by a batch, and one with another content than its line says was changed
since. A line of a file that is not there says nothing: the process was killed in between.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

from servobench.harness.config.settings import ConfigurationError
from servobench.plant.contract.files import partial_path, sync, write_atomically

SUMS: Final = "SHA256SUMS"
LINE: Final = re.compile(r"(?P<digest>[0-9a-f]{64})  (?P<name>[^\s/]+(/[^\s/]+)?)")
TABLE_END: Final = b"PAR1"  # the last bytes of a Parquet file

Sums = Mapping[str, frozenset[str]]  # the digests that a file may have, by its name within the folder


class DamagedFile(ConfigurationError):
    """A file of a results folder is not what was written."""

    def __init__(self, folder: Path, name: str, what: str) -> None:
        """Say what is wrong, and what to type."""
        self.what = what
        remedy = f"repeat the command that made the folder with --resume, or type: servobench verify {folder}"
        super().__init__(f"{folder / name} {what}; {remedy}")


class UnwritableFolder(OSError):
    """The results folder takes no more files."""


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Name the results folder where the system refuses to write.

    Raises:
        UnwritableFolder: it did.
    """
    try:
        yield
    except UnwritableFolder:
        raise
    except OSError as error:
        why = error.strerror or str(error) or type(error).__name__
        if error.errno == errno.ENOENT and not folder.is_dir():
            why = "it was removed"
        raise UnwritableFolder(error.errno, f"results folder {folder} cannot be written: {why}") from error


def write_vouched(folder: Path, files: Mapping[str, Callable[[Path], object]]) -> None:
    """Write files of a results folder that belong together, and their lines before they have their names.

    Args:
        folder: a results folder.
        files: by name within the folder, what writes the content to a path; they get their names in this order.
    """
    partials = {name: partial_path(folder / name) for name in files}
    try:
        for name, write in files.items():
            write(partials[name])
            sync(partials[name])
        append_sums(folder, {name: digest(path) for name, path in partials.items()})
        for name, path in partials.items():
            path.replace(folder / name)
        for parent in {path.parent for path in partials.values()}:
            sync(parent)
    finally:
        for path in partials.values():
            path.unlink(missing_ok=True)


def append_sums(folder: Path, digests: Mapping[str, str]) -> None:
    """Write lines to the end; what a killed process left of one becomes a line that is not read."""
    lines = "".join(f"{each}  {name}\n" for name, each in digests.items()).encode()
    created = not (folder / SUMS).exists()
    with (folder / SUMS).open("a+b") as file:
        size = file.seek(0, os.SEEK_END)
        if size:
            file.seek(size - 1)
            lines = lines if file.read(1) == b"\n" else b"\n" + lines
        file.write(lines)
        file.flush()
        os.fsync(file.fileno())
    if created:
        sync(folder)


def keep_sums(folder: Path, sums: Sums, names: Collection[str]) -> None:
    """Write the file anew with the lines of some names only."""
    kept = [f"{each}  {name}\n" for name in names for each in sorted(sums.get(name, ()))]
    write_atomically(folder / SUMS, lambda file: file.write_text("".join(kept), encoding="utf-8"))


def read_sums(folder: Path) -> Sums | None:
    """Return the lines of a folder; None where it has no such file, as one of an earlier version.

    Raises:
        ConfigurationError: the file cannot be read.
    """
    try:
        text = (folder / SUMS).read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigurationError(f"{folder / SUMS} cannot be read: {error.strerror}") from error
    found: dict[str, frozenset[str]] = {}
    for line in text.split("\n")[:-1]:
        match = LINE.fullmatch(line)
        if match:
            found[match["name"]] = found.get(match["name"], frozenset()) | {match["digest"]}
    return found


def fault(folder: Path, name: str, sums: Sums | None) -> str | None:
    """Return what is wrong with a file, as a predicate; None if it is what was written.

    Args:
        folder: a results folder.
        name: of the file within the folder.
        sums: the folder's lines; None: there are none, and only an empty or missing file is wrong.
    """
    path = folder / name
    try:
        size = path.stat().st_size
        if sums is not None and name in sums and digest(path) in sums[name]:
            return None
        end = _end(path)
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if size == 0:
        return "is empty"
    if path.suffix == ".parquet" and end != TABLE_END:
        return "is cut off"
    if sums is None:
        return None
    return "was changed since it was written" if name in sums else f"is not listed in {SUMS}"


def digest(path: Path) -> str:
    """Return the SHA-256 of a file; of one that has not changed since, it is known."""
    stat = path.stat()
    return _digest(path, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size, stat.st_ino)


@lru_cache(maxsize=64)
def _digest(path: Path, *_version: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _end(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - len(TABLE_END)))
        return file.read()
