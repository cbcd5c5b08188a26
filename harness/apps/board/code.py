"""Code of a controller, in a file or in a wheel, which is unpacked and not installed."""

import atexit
import shutil
import tempfile
import zipfile
from importlib.metadata import EntryPoint, distributions
from pathlib import Path
from typing import NamedTuple

from servobench.harness.config.registry import CONTROLLER_REGISTRY
from servobench.harness.config.source import find_place
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import user_path

WHEEL = ".whl"
MAX_SIZE = 2**30  # [bytes] size of the files in a wheel


class Code(NamedTuple):
    """Where the code of a controller stands."""

    place: str  # `FILE.py`, `FILE.py:NAME`, or `MODULE:NAME` of an unpacked wheel
    file: Path  # the file or wheel
    folder: Path  # from which it is imported, and may read files


def find_code(given: str) -> Code:
    """Return the code of `FILE.py`, `FILE.py:NAME` or a wheel; the latter is unpacked until this process ends.

    Raises:
        ConfigurationError: there is no such file, or no such wheel.
    """
    found = find_place(given)
    text = given
    if found is not None and found["file"]:
        text = found["file"]
    file = user_path(text).absolute()
    if file.suffix not in (".py", WHEEL):
        raise ConfigurationError(f"{given} is no code: wanted a file .py, or a wheel")
    if not file.is_file():
        raise ConfigurationError(f"there is no file {given}")
    if file.suffix == WHEEL:
        folder = _unpack(file)
        return Code(_published(folder, file), file, folder)
    return Code(given.replace(text, str(file)), file, file.parent)


def _unpack(file: Path) -> Path:
    """Return a temporary folder with the files of a wheel, which is removed when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix="servobench-wheel-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(each.file_size for each in archive.infolist()) > MAX_SIZE:
                raise ConfigurationError(f"{file} holds more than {MAX_SIZE >> 20} MB")
            archive.extractall(folder)
    except (OSError, zipfile.BadZipFile, RuntimeError) as error:
        raise ConfigurationError(f"{file} is no wheel: {error}") from error
    return folder


def _published(folder: Path, file: Path) -> str:
    """Return the place `MODULE:NAME` of the controller that an unpacked wheel publishes."""
    points: list[EntryPoint] = []
    for distribution in distributions(path=[str(folder)]):
        points += distribution.entry_points.select(group=CONTROLLER_REGISTRY.group)
    if len(points) != 1:
        group = CONTROLLER_REGISTRY.group
        raise ConfigurationError(f"{file} publishes {len(points)} controllers in {group}, wanted 1")
    place: str = points[0].value
    return place
