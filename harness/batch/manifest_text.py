"""The text of a manifest: JSON of one schema, in which every entry has its type."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from servobench.harness.batch.checksums import DamagedFile
from servobench.harness.config.settings import ConfigurationError

SCHEMA_VERSION = "4"
CHANGES: Final = {"3": "; the column latency_periods [periods] is now latency_s [s]"}  # since an earlier schema
ENTRIES: Final[dict[str, tuple[type, ...]]] = {  # of a manifest: its type, and that of its elements
    "created": (str,), "python": (str,), "platform": (str,), "campaign": (str,), "seeds": (str,), "run_count": (int,),
    "plants": (list, str), "controllers": (list, str), "tasks": (list, str), "mismatches": (list, str),
    "robots": (list, dict), "configuration": (dict, dict), "own_controllers": (dict, dict), "packages": (dict,),
    "engines": (dict,), "files": (dict, str), "side_by_side": (dict, list),
}  # fmt: skip
WORDS: Final = {str: "text", int: "a whole number", list: "a list", dict: "an object"}
SHOWN: Final = 60  # letters of a wrong value that a message holds


def encode(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as text; JSON has no infinity, so a setting without limit reads "inf"."""
    return json.dumps(_in_json({"schema_version": SCHEMA_VERSION, **manifest}), indent=2) + "\n"


def decode(folder: Path, name: str, text: str) -> dict[str, Any]:
    """Return what a manifest says.

    Args:
        folder: the results folder, for the message.
        name: of the file within the folder, likewise.
        text: of the file.

    Raises:
        ConfigurationError: not a manifest of this schema.
        DamagedFile: an entry has another type than it should.
    """
    try:
        manifest = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{folder} is not a results folder: its {name} cannot be read") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise ConfigurationError(
            f"{folder} has results of schema {version!r}; this servobench reads {SCHEMA_VERSION!r}"
            f"{CHANGES.get(str(version), '')}"
        )
    for key, types in ENTRIES.items():
        if key in manifest and not _has_type(manifest[key], *types):
            wanted = " of ".join(WORDS[each] for each in types)
            raise DamagedFile(folder, name, f"is damaged: {key} must be {wanted}, got {str(manifest[key])[:SHOWN]!r}")
    return dict(manifest)


def _in_json(value: Any) -> Any:  # noqa: ANN401 - whatever a manifest holds
    if isinstance(value, dict):
        return {key: _in_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_in_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _has_type(value: Any, kind: type, inner: type | None = None) -> bool:  # noqa: ANN401 - whatever JSON holds
    elements = value.values() if isinstance(value, dict) else value
    return type(value) is kind and (inner is None or all(type(each) is inner for each in elements))
