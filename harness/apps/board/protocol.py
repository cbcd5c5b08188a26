"""The protocol of submissions: what `protocol.toml` says, and the robots that a pack draws."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from servobench.harness.apps.studies.challenge import Challenge, find_challenge
from servobench.harness.batch.plan import Cell
from servobench.harness.config.settings import Settings
from servobench.plant.contract.checksums import digest
from servobench.plant.contract.facts import read_beside
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import suggest

_PROTOCOL = read_beside(__file__, "protocol.toml")
VERSION: str = _PROTOCOL["version"]
ROBOTS: int = _PROTOCOL["robots"]
KINDS: Mapping[str, Sequence[str]] = _PROTOCOL["kinds"]
CLAUSES: Mapping[str, str] = _PROTOCOL["clauses"]
COLUMNS: Mapping[str, str] = _PROTOCOL["columns"]
SETTINGS = Settings(_PROTOCOL["settings"])
SEED_BYTES = 6  # too many seeds to try them all, also for a controller that knows its own

Verdict: TypeAlias = Literal["ok", "failed", "unknown"]
"""the last where something is neither shown nor refuted"""


class Finding(NamedTuple):
    """A finding about a clause of docs/protocol.md."""

    clause: str  # its number
    verdict: Verdict
    text: str  # what was found, and where


Hear: TypeAlias = Callable[[Finding], None]  # receives findings as they come


def pack_digest(folder: Path) -> str:
    """Return the SHA-256 of a pack: of the version and of the names and contents of its files."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{digest(path)}  {path.relative_to(folder).as_posix()}" for path in files]
    return hashlib.sha256("\n".join([VERSION, *lines]).encode()).hexdigest()


def judged_seeds(pack: Path) -> tuple[int, ...]:
    """Return the seeds of the robots on which a pack is judged; none is one for tuning."""
    text = pack_digest(pack)
    drawn = (hashlib.sha256(f"{text} {number}".encode()).digest() for number in range(ROBOTS))
    return tuple(2**32 + int.from_bytes(each[:SEED_BYTES]) for each in drawn)


def worlds_of(kinds: Sequence[str]) -> list[Challenge]:
    """Return the worlds of some kinds.

    Raises:
        ConfigurationError: an unknown kind.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise ConfigurationError(f"--kinds: unknown {kind!r}: {suggest(kind, KINDS)}")
    return [find_challenge(name) for kind in KINDS if kind in kinds for name in KINDS[kind]]


def planned(world: Challenge, method: str, pack: Path) -> list[Cell]:
    """Return the judged runs of a method in a world, and those of the ceilings on the same robots."""
    return world.cells((), (method,), judged_seeds(pack), ROBOTS)
