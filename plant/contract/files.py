"""Atomic writing of files, and reading of TOML with errors of one line."""

import os
import re
import threading
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

FORMULA: Final = ("=", "+", "-", "@", "\t", "\r")  # with which a cell begins that a spreadsheet runs
CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
PARTIAL: Final = re.compile(r"\..+-\d+-\d+")  # name of a file that is being written, or whose process was killed


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name in the same folder, then rename it.

    Args:
        path: the file; an old one is replaced.
        write: writes the content to the path that it is given.
    """
    partial = partial_path(path)
    try:
        write(partial)
        sync(partial)
        partial.replace(path)
        sync(path.parent)
    except OSError as error:
        if error.errno is not None:
            error.filename = str(path)  # that of the user: a full disk names no file, other errors the partial one
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_csv(table: Any, path: Path) -> None:  # noqa: ANN401 - pandas need not be imported here
    """Write a DataFrame as CSV, atomically; a text that a spreadsheet would run as a formula gets an apostrophe."""

    def quoted(cell: Any) -> Any:  # noqa: ANN401 - a cell of any kind
        return f"'{cell}" if isinstance(cell, str) and cell.startswith(FORMULA) else cell

    texts = {str(name): column.map(quoted) for name, column in table.items() if column.dtype.kind not in "biufM"}
    safe = table.assign(**texts).rename(columns=quoted)
    write_atomically(path, lambda partial: safe.to_csv(partial, index=False))


def read_toml(kind: str, path: Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Args:
        kind: of the file, for error messages, such as "mapping".
        path: the file.

    Raises:
        ValueError: it cannot be read, or is not valid TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{kind} {path} cannot be read: {reason(error)}") from error
    except (ValueError, RecursionError) as error:  # ValueError: no TOML, or a number of thousands of digits
        raise ValueError(f"{kind} {path} is not valid TOML: {error}") from error


def harmless(text: str) -> str:
    """Return a text in which signs that a terminal obeys, or cannot print, are written by their number."""
    return CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def reason(error: Exception) -> str:
    """Return the reason of an error about a file; for an error of the system without its number and path."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def user_path(text: str) -> Path:
    """Return a path as written by a user, in which ~ stands for a home folder.

    Raises:
        ValueError: there is no such home folder.
    """
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise ValueError(f"path {text!r} names a home folder that is not known") from error


def partial_path(path: Path) -> Path:
    """Return the name under which this thread writes a file."""
    return path.with_name(f".{path.name}-{os.getpid()}-{threading.get_ident()}")


def sync(path: Path) -> None:
    """Wait until the content of a file, or the list of files of a folder, is on the disk.

    Without it a file may have its name before it has its content, so that a power cut leaves an empty one.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def point_latest(folder: Path) -> None:
    """Point the link `latest` in the parent folder at `folder`; where links cannot be made, nothing happens."""
    link = folder.parent / "latest"
    partial = folder.parent / f".latest-{os.getpid()}"
    if link.exists() and not link.is_symlink():
        return
    try:
        partial.symlink_to(folder.name, target_is_directory=True)
        partial.replace(link)
    except OSError:
        partial.unlink(missing_ok=True)
