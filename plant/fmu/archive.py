"""Extracts an .fmu archive once: into a folder of the user's cache that is named by the archive's content.

All processes share the folder, nobody writes into it, and a second plant of the same FMU only looks it up.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import zipfile
from functools import lru_cache
from pathlib import Path, PurePosixPath

from platformdirs import user_cache_dir


def extract_fmu(path: Path) -> Path:
    """Return the folder that holds the extracted FMU at `path`.

    Raises:
        ValueError: no such file, not a zip archive, an archive that is damaged or climbs out of its folder, or one
            without a model description.
    """
    if not path.is_file():
        raise ValueError(f"fmu file {path} does not exist")
    status = path.stat()
    digest = _digest(path.resolve(), status.st_mtime_ns, status.st_size)
    folder = Path(user_cache_dir("servobench")) / "extracted" / digest
    if not folder.is_dir():
        _extract(path, folder)
    return folder


@lru_cache(maxsize=64)
def _digest(path: Path, _modified: int, _size: int) -> str:
    """Return the first half of the SHA-256 of a file; time and size make a changed file another key."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:32]


def _extract(path: Path, folder: Path) -> None:
    """Extract beside `folder` and move the result there, so that no process meets half an FMU."""
    with _open(path) as archive:
        _check_names(path, archive)
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(dir=folder.parent))
        try:
            archive.extractall(fresh)
            fresh.rename(folder)
        except (zipfile.BadZipFile, OSError, NotImplementedError, RuntimeError) as error:
            shutil.rmtree(fresh, ignore_errors=True)
            if not folder.is_dir():  # else another process was faster
                raise ValueError(f"fmu file {path} cannot be extracted: {error}") from error


def _open(path: Path) -> zipfile.ZipFile:
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
