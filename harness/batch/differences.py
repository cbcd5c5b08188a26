"""In what two batches differ, by their manifests: in runs and settings, in files of users, in versions."""

import json
from collections.abc import Callable

from servobench.harness.batch.manifest import OWN
from servobench.harness.batch.results import Manifest, ResultsFolder
from servobench.harness.batch.schema import encode
from servobench.harness.config.settings import flatten
from servobench.plant.contract.faults import ConfigurationError

# Entries of a manifest that identify its runs
NAMES = ("plants", "controllers", "tasks", "mismatches", "seeds")
SOURCES = (*OWN.values(), "plugins")  # entries that have the hash of code by its name
# Entries that may change the figures of later runs, and what they are called.
VERSIONS = {
    "git_commit": "commit",
    "packages": "packages",
    "engines": "engines",
    "blas": "BLAS",
    "fingerprint": "arithmetic",
}
SHOWN = 60  # letters of a value that a message holds


def check_same_batch(
    folder: ResultsFolder, manifest: Manifest, note: Callable[[str], None], remedy: str
) -> None:
    """Refuse a folder of another batch than that of a manifest; `note` gets a line for each difference that may matter.

    Raises:
        ConfigurationError: other runs or settings, or another version of a file of the user's.
    """
    there = folder.manifest
    if there.get("campaign") != manifest.get("campaign"):
        other = difference(there, manifest)
        raise ConfigurationError(
            f"{folder.path} holds results of other runs or settings: {other}; {remedy}"
        )
    if changed := changed_source(there, manifest):
        raise ConfigurationError(
            f"{folder.path} was begun with another version of {changed}; {remedy}, or bring the former one back"
        )
    for key, things in VERSIONS.items():
        if there.get(key) != manifest.get(key):
            note(f"note: {folder.path} was begun with other {things}; later runs may differ")


def difference(there: Manifest, here: Manifest) -> str:
    """Return in which names or settings two batches differ that are not the same.

    Args:
        there: manifest of the folder.
        here: manifest of the new batch.
    """
    here = json.loads(encode(here))
    old = {key: there.get(key) for key in NAMES} | flatten(there.get("configuration", {}))
    new = {key: here[key] for key in NAMES} | flatten(here["configuration"])
    for key in dict.fromkeys([*old, *new]):
        if old.get(key) != new.get(key):
            before = _short(old.get(key, "unknown"))
            now = _short(new.get(key, "unknown"))
            return f"{key} {before} there, {now} here"
    # A manifest has only a digest of these.
    return "the settings or axes that are varied, or the command"


def changed_source(there: Manifest, here: Manifest) -> str:
    """Return the file of users that differs between two batches; empty if none does.

    Args:
        there: manifest of the folder; a file that it does not mention counts as unchanged.
        here: manifest of the new batch, or of another folder.
    """
    for name, digest in here.get("files", {}).items():
        if there.get("files", {}).get(name, digest) != digest:
            return str(name)
    for key in SOURCES:
        for name, record in here.get(key, {}).items():
            former = there.get(key, {}).get(name, record)
            if record.get("sha256") != former.get("sha256"):
                return str(record.get("place", name))
    return ""


def _short(value: object) -> str:
    """Return a value in one line, or the beginning of it."""
    text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    if len(text) <= SHOWN:
        return text
    return f"{text[: SHOWN - 1]}…"
