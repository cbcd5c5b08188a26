"""The files that a batch reads because a user named them: robots, calibrations, FMUs, tasks and code."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from servobench.harness.batch.checksums import digest
from servobench.harness.batch.plan import Survey
from servobench.harness.config.registry import MAPPED, Offer
from servobench.harness.config.robots import sensing_file, sensing_place
from servobench.harness.config.source import PLACE, neighbours
from servobench.plant.contract.files import read_toml, user_path
from servobench.plant.robot.mismatch import Mismatch

MAPPING: Final = ".toml"
SETTING: Final = "file"  # what the settings that name a file are called


def named_files(
    runs: Survey, configuration: Mapping[str, Mapping[str, Any]], own: Iterable[Offer] = ()
) -> dict[str, str]:
    """Return the SHA-256 of each file by its name, as the user wrote it.

    Args:
        runs: what was asked for.
        configuration: settings by section and key.
        own: controllers and plants of the user. A module that their file imports from its own folder is named as if the
            user had written it.
    """
    found = {name: user_path(name) for name in _names(runs, configuration)}
    for each in own:
        found |= {} if each.given or not each.file else _code(each.place, Path(each.file))
    for word in runs.sensings:
        source = sensing_file(word)
        found |= {} if source is None else _code(sensing_place(word), source.path)
    return {name: digest(path) for name, path in found.items() if path.is_file()}


def _names(runs: Survey, configuration: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield the names that may be those of files without code."""
    yield from (name.partition("#")[0] for name in runs.robots)
    yield from filter(None, (Mismatch.parse(text).calibration for text in runs.mismatches))
    for values in configuration.values():
        yield from (str(value) for key, value in values.items() if key.split(".")[-1] == SETTING and value)
    for name in (*runs.plants, *runs.controllers):
        if name.startswith(MAPPED):
            path = name.removeprefix(MAPPED)
            yield path
            if path.endswith(MAPPING):
                yield str(Path(path).parent / str(read_toml("mapping", user_path(path)).get("file", "")))


def _code(place: str, file: Path) -> dict[str, Path]:
    """Return a file of code and what it imports from its own folder, by the names that they have from its place."""
    found = PLACE.fullmatch(place)
    if found is not None and found["module"]:
        deep = found["module"].count(".") + (file.name == "__init__.py")
        root, begin = file.parents[min(deep, len(file.parents) - 1)], Path()
    else:
        root, begin = file.parent, Path(found["file"]).parent if found is not None else Path()
    return {str(begin / path.relative_to(root)): path for path in [file, *neighbours(file, root)]}
