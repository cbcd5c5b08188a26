"""Checksums of the files of a folder: `SHA256SUMS`, a line a file, as `sha256sum --check` reads it.

Results folders and entries of the cache have one. It only grows while files are written: a line is on the disk before
its file has its name, so that a file without a line was never written here, and a file with another content than its
lines say was changed since. A line without a file says nothing: the process was killed in between.
"""

import hashlib
import os
import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from servobench.plant.contract.files import Write, partial_path, sync, write_text

SUMS = "SHA256SUMS"
# Within the folder
LINE = re.compile(r"(?P<digest>[0-9a-f]{64})  (?P<name>(?!/|(.*/)?\.\.?(/|$))\S[^\0]*)")
TABLE_END = b"PAR1"  # the last bytes of a Parquet file

# The digests that a file may have, by its name within the folder
Sums = Mapping[str, frozenset[str]]


def write_vouched(folder: Path, files: Mapping[str, Write]) -> None:
    """Write files that belong together, and their lines before they have their names.

    Args:
        folder: of the files.
        files: by name within the folder, a function that writes the content to a path; they are named in this order.
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
    """Write lines to the end; the beginning of one that a killed process left becomes a line that is not read."""
    lines = "".join(f"{each}  {name}\n" for name, each in digests.items()).encode()
    with (folder / SUMS).open("a+b") as file:
        size = file.seek(0, os.SEEK_END)
        if size:
            file.seek(size - 1)
            if file.read(1) != b"\n":
                lines = b"\n" + lines
        file.write(lines)
        file.flush()
        os.fsync(file.fileno())
    if not size:  # The file is new.
        sync(folder)


def keep_sums(folder: Path, sums: Sums) -> None:
    """Write the file anew with these lines only."""
    kept = [f"{each}  {name}\n" for name, digests in sums.items() for each in sorted(digests)]
    write_text(folder / SUMS, "".join(kept))


def read_sums(folder: Path) -> Sums | None:
    """Return the lines of a folder, which are read once; None where it has no such file.

    Raises:
        OSError: the file cannot be read.
    """
    path = folder / SUMS
    try:
        return _read_sums(path, *_version(path))
    except FileNotFoundError:
        return None


@lru_cache(maxsize=8)
def _read_sums(path: Path, *_version: int) -> Sums:
    found: dict[str, frozenset[str]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").split("\n")[:-1]:
        match = LINE.fullmatch(line)
        if match:
            found[match["name"]] = found.get(match["name"], frozenset()) | {match["digest"]}
    return found


def fault(folder: Path, name: str, sums: Sums | None) -> str | None:
    """Return the fault of a file, as a predicate; None if it has the content that was written.

    Args:
        folder: of the file.
        name: of the file within the folder.
        sums: the folder's lines; None: there are none, and only an empty or missing file is wrong.
    """
    path = folder / name
    try:
        size = path.stat().st_size
        if not (path.is_file() or path.is_dir()):  # A pipe would be read without end.
            return "is no file"
        if sums is not None and name in sums and digest(path) in sums[name]:
            return None
        with path.open("rb") as file:
            file.seek(max(0, size - len(TABLE_END)))
            end = file.read()
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
    if name in sums:
        return "was changed since it was written"
    return f"is not listed in {SUMS}"


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, which is read once while it does not change."""
    return _digest(path, *_version(path))


@lru_cache(maxsize=4096)
def _digest(path: Path, *_version: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _version(path: Path) -> tuple[int, int, int, int]:
    """Return numbers that differ once a file was written again."""
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size, stat.st_ino
