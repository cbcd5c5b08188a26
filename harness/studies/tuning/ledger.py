"""The scored points of one controller on one set of runs, in a file that a killed process leaves readable.

Each line is a JSON object. The first one holds all that scores depend on besides the settings, the others a point's
settings and the cost of every run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, final

from servobench.harness.config.settings import ConfigurationError

LEDGER: Final = ".jsonl"
SHOWN: Final = 60  # letters of wrong costs that a message holds


@final
class Ledger:
    """Costs by settings, each written down as soon as it is known."""

    def __init__(self, path: Path, fingerprint: Mapping[str, Any]) -> None:
        """Open a ledger, or prepare one where there is none; its file is made with the first point.

        Args:
            path: of the file.
            fingerprint: all that costs depend on besides the settings, as JSON has it.

        Raises:
            ConfigurationError: the file is no ledger, or that of something else.
        """
        self.path = path
        self._fingerprint = dict(fingerprint)
        self._costs: dict[str, list[float]] = {}
        if path.is_file():
            self._read()

    def _read(self) -> None:
        try:
            whole, _, _ = self.path.read_bytes().rpartition(b"\n")  # a killed process may leave half a line
            header, *records = [json.loads(line) for line in whole.splitlines()] or [self._fingerprint]
            self._costs = {_key(record["settings"]): _costs(record["costs"]) for record in records}
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise ConfigurationError(f"study {self.path} cannot be opened: {error}") from error
        parts = [key for key in self._fingerprint if not isinstance(header, dict)
                 or header.get(key) != self._fingerprint[key]]  # fmt: skip
        if parts:
            raise ConfigurationError(
                f"study {self.path} was made with other {', '.join(parts)}; name another folder with --out"
            )

    def __len__(self) -> int:
        """Return the number of scored points."""
        return len(self._costs)

    def best(self) -> float | None:
        """Return the least mean cost, or None while there is none."""
        return min((sum(costs) / len(costs) for costs in self._costs.values()), default=None)

    def costs(self, settings: Mapping[str, Any]) -> list[float] | None:
        """Return the costs of the runs under nested settings, or None if they are not known."""
        return self._costs.get(_key(settings))

    def add(self, settings: Mapping[str, Any], costs: Sequence[float]) -> None:
        """Write the costs of the runs under nested settings down."""
        record = json.dumps({"settings": settings, "costs": list(costs)}) + "\n"
        try:
            present = self.path.read_bytes() if self.path.is_file() else b""
            whole = present.rfind(b"\n") + 1
            with self.path.open("r+b" if present else "wb") as file:
                file.truncate(whole)
                file.seek(whole)
                file.write((record if whole else json.dumps(self._fingerprint) + "\n" + record).encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise ConfigurationError(f"study {self.path} cannot be written: {error.strerror}") from error
        self._costs[_key(settings)] = list(costs)


def _costs(given: object) -> list[float]:
    """Return the costs of a record.

    Raises:
        ValueError: they are no numbers.
    """
    if not isinstance(given, list) or not given or not all(type(each) in (int, float) for each in given):
        raise ValueError(f"costs must be a list of numbers, got {str(given)[:SHOWN]}")
    return [float(each) for each in given]


def _key(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True)
