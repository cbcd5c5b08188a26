"""The schema of `manifest.json`: its version, its entries and their types; written as text, and read."""

import json
from pathlib import Path
from typing import Any, TypeAlias

from servobench.harness.batch.tables import DamagedFile
from servobench.harness.config.description import plain
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import Record

Manifest: TypeAlias = Record  # its entries by name
MANIFEST = "manifest.json"
SCHEMA_VERSION = "4"
# Since an earlier schema
CHANGES = {"3": "; the column latency_periods [periods] is now latency_s [s]"}
# Types of entries, and of their elements -> the keys of such entries
ENTRIES: dict[tuple[type, ...], tuple[str, ...]] = {
    (str,): ("created", "libm", "python", "platform", "campaign", "seeds"),
    (int,): ("run_count",),
    (dict,): ("changed", "packages", "engines", "until_decided"),
    (list, str): ("plants", "controllers", "tasks", "mismatches"),
    (list, dict): ("robots", "blas"),
    (dict, str): ("files", "fingerprint"),
    (dict, list): ("side_by_side",),
    (dict, dict): ("configuration", "own_controllers", "own_plants", "own_tasks", "own_metrics", "plugins", "tuned"),
}  # fmt: skip
WORDS = {str: "text", int: "a whole number", list: "a list", dict: "an object"}
SHOWN = 60  # letters of a wrong value that a message holds


class OtherSchema(ConfigurationError):
    """A results folder is of another version of this package."""


def encode(manifest: Manifest) -> str:
    """Return a manifest as text; JSON has no infinity, so a setting without limit reads "inf"."""
    return json.dumps(plain({"schema_version": SCHEMA_VERSION, **manifest}), indent=2) + "\n"


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a folder.

    Raises:
        ConfigurationError: there is none, or none that can be read.
        OtherSchema: it is of another schema.
        DamagedFile: an entry has another type than it should.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        why = _why_unreadable(folder)
        raise ConfigurationError(f"{folder} is not a results folder: {why}") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise OtherSchema(
            f"{folder} has results of schema {version!r}; this servobench reads {SCHEMA_VERSION!r}"
            f"{CHANGES.get(str(version), '')}; read it with the servobench that wrote it"
        )
    for types, keys in ENTRIES.items():
        wanted = " of ".join(WORDS[each] for each in types)
        for key in manifest.keys() & keys:
            if not _has_type(manifest[key], *types):
                raise DamagedFile(
                    folder,
                    MANIFEST,
                    f"is damaged: {key} must be {wanted}, got {str(manifest[key])[:SHOWN]!r}",
                )
    return dict(manifest)


def _why_unreadable(folder: Path) -> str:
    """Return why a manifest cannot be read, or a results folder within the folder that may be meant."""
    if not (folder / MANIFEST).exists():
        inside = sorted(folder.glob(f"*/{MANIFEST}"))
        if inside:
            return f"take one that is in it, such as {inside[0].parent}"
    if not folder.exists():
        return "it does not exist"
    return f"its {MANIFEST} cannot be read"


def _has_type(value: Any, kind: type, inner: type | None = None) -> bool:  # noqa: ANN401 - any JSON
    elements = value.values() if isinstance(value, dict) else value
    return type(value) is kind and (inner is None or all(type(each) is inner for each in elements))
