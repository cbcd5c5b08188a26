"""Extracts an .fmu archive once: into the user's cache, under a name that is a hash of the archive's content.

All processes share the folder and none writes into it; a second plant of the same FMU finds it there. An archive
is judged by its table of contents before a byte is unpacked; Python's reader never unpacks more than that says.
"""

import contextlib
import errno
import lzma
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from servobench.plant.contract.cache import EXTRACTED, cached
from servobench.plant.contract.checksums import digest
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.files import accessing

DESCRIPTION = "modelDescription.xml"
MAX_FILES = 20_000  # number of files in an archive
MAX_UNPACKED = 2_000_000_000  # [bytes] size of all files together
MAX_DESCRIPTION = 32_000_000  # [bytes] size of the model description, which is read into memory
MAX_RATIO = 100.0  # unpacked size over that of the archive; libraries reach 5, tables of numbers 20
SMALL = 16_000_000  # [bytes] unpacked, below which the ratio does not matter
USUAL_ENCODING = "cp437"  # in which Python's reader takes names without a mark
UTF8_MARK = 0x800
# Errors of the disk, not of the archive.
DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES)
DAMAGES = (  # raised by Python's reader of archives
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, OSError, OverflowError,
    RuntimeError, ValueError,
)  # fmt: skip


def extract_fmu(path: Path) -> Path:
    """Return the folder that holds the extracted FMU at `path`.

    Raises:
        ValueError: no such file, not a zip archive, an archive that is damaged, climbs out of its folder, or unpacks to
            more than the limits of this module, or one without a model description.
    """
    with accessing(path, "fmu file", "read"):
        if not path.is_file():
            found = "is a directory" if path.is_dir() else "does not exist"
            raise ValueError(f"fmu file {path} {found}")
        key = digest(path)[:32]
    return cached(EXTRACTED, key, lambda folder: _extract(path, folder))


def _extract(path: Path, folder: Path) -> None:
    """Unpack the archive at `path` into a folder, unless it is refused; see `extract_fmu`."""
    with configuration_errors(f"fmu file {path} is not a zip archive: ", *DAMAGES):
        archive = zipfile.ZipFile(path)
    with archive:
        entries = archive.infolist()
        for entry in entries:
            # Folders end with `/`, and letters may be in UTF-8 without a mark.
            if not entry.flag_bits & UTF8_MARK:
                with contextlib.suppress(UnicodeError):
                    entry.filename = entry.filename.encode(USUAL_ENCODING).decode("utf-8")
            entry.filename = entry.filename.replace("\\", "/")
        _check_names(path, entries)
        _check_sizes(path, entries)
        for entry in entries:
            try:
                archive.extract(entry, folder)
            except DAMAGES as error:
                if isinstance(error, OSError) and error.errno in DISK:
                    raise
                raise ValueError(
                    f"fmu file {path} cannot be extracted: {entry.filename!r}: {error}"
                ) from error


def _check_names(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse an archive that climbs out of its folder, holds a file twice, or holds no model description."""
    written = {entry.orig_filename for entry in entries}
    places = {entry.filename for entry in entries}
    for entry in entries:
        parts = PurePosixPath(entry.filename)
        if ":" in entry.filename or parts.is_absolute() or ".." in parts.parts:
            name = repr(entry.orig_filename)
            raise ValueError(
                f"fmu file {path} holds {name}, which would climb out of the folder it is extracted to"
            )
    if len(places) < len(written):
        raise ValueError(f"fmu file {path} holds a file twice, with '/' and with '\\' in its name")
    if DESCRIPTION not in places:
        raise ValueError(f"fmu file {path} holds no {DESCRIPTION}, so it is not an FMU")


def _check_sizes(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse an archive that would fill the disk or the memory."""
    if len(entries) > MAX_FILES:
        raise ValueError(
            f"fmu file {path} holds {len(entries)} files; at most {MAX_FILES} are unpacked"
        )
    description = max(entry.file_size for entry in entries if entry.filename == DESCRIPTION)
    if description > MAX_DESCRIPTION:
        raise ValueError(
            f"fmu file {path} has a {DESCRIPTION} of {_megabytes(description)}; at most {_megabytes(MAX_DESCRIPTION)} "
            "are read: export the FMU with fewer variables"
        )
    unpacked = sum(entry.file_size for entry in entries)
    packed = path.stat().st_size
    if unpacked > MAX_UNPACKED:
        raise ValueError(
            f"fmu file {path} unpacks to {_megabytes(unpacked)}; at most {_megabytes(MAX_UNPACKED)} are unpacked: "
            "keep large files of its resources outside of it"
        )
    if unpacked > max(SMALL, MAX_RATIO * packed):
        raise ValueError(
            f"fmu file {path} unpacks to {_megabytes(unpacked)}, {unpacked / packed:.0f} times its own size; at most "
            f"{MAX_RATIO:.0f} times is allowed, since archives beyond are made to fill a disk: if you trust it, "
            "unpack it and pack it again without compression (zip -0 -r)"
        )


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.0f} MB"
