"""The measured tables of the pages as small files: text cells below a stamp that says how they were made.

A file of docs/tables is CSV after lines that begin with `#`:

    # study: held_out
    # commit: 1aaab0a…
    # date: 2026-11-22
    # version: 0.2.0
    # command: servobench sweep --plants fmu …
    method,"settled, %",…
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import pandas as pd

FOLDER: Final = Path(__file__).parent / "tables"
NUMBER: Final = re.compile(r"(?<![\w.])[-−]?\d+(?:\.(\d+))?(?:e([-+]\d+))?(?![\w.])")
RELATIVE: Final = 0.1  # share by which a number may differ from the stored one
LAST_DIGITS: Final = 5.1  # units of the last digit by which it may differ: a period of 0.05 s
ONE: Final = 1.0  # by which a whole number may: a robot


class Stored(NamedTuple):
    """A table with its stamp."""

    stamp: dict[str, str]  # study, commit, date, version, command
    table: pd.DataFrame  # text


def write(path: Path, stored: Stored) -> None:
    """Write a table into a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stamp = "".join(
        f"# {key}: {line}\n" for key, text in stored.stamp.items() for line in text.splitlines()
    )
    path.write_text(stamp + stored.table.to_csv(index=False), encoding="utf-8")


def read(path: Path) -> Stored:
    """Return the table in a file."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    stamped = [
        line.removeprefix("# ").rstrip("\n").split(": ", 1)
        for line in lines
        if line.startswith("# ")
    ]
    stamp: dict[str, str] = {}
    for key, text in stamped:
        stamp[key] = f"{stamp[key]}\n{text}" if key in stamp else text
    table = pd.read_csv(
        io.StringIO("".join(lines[len(stamped) :])), dtype=str, keep_default_na=False
    )
    return Stored(stamp, table)


def differences(found: pd.DataFrame, wanted: pd.DataFrame) -> Iterator[str]:
    """Yield a line for each cell that is not the stored one; numbers may differ as another processor makes them."""
    if list(found.columns) != list(wanted.columns) or len(found) != len(wanted):
        now, stored = (f"{len(each)} rows of {', '.join(each.columns)}" for each in (found, wanted))
        yield f"{now}; stored are {stored}"
        return
    for (_, now), (_, stored) in zip(found.iterrows(), wanted.iterrows(), strict=True):
        for column in found.columns:
            if not alike(str(now[column]), str(stored[column])):
                yield f"{stored.iloc[0]}, {column}: {now[column]}, stored is {stored[column]}"


def alike(found: str, wanted: str) -> bool:
    """Return whether two cells have the same words and numbers that differ by little."""
    if NUMBER.sub("", found) != NUMBER.sub("", wanted):
        return False
    for ours, theirs in zip(NUMBER.finditer(found), NUMBER.finditer(wanted), strict=True):
        a, b = (float(match[0].replace("−", "-")) for match in (ours, theirs))
        least = ONE
        if theirs[1] or theirs[2]:
            least = LAST_DIGITS * 10.0 ** (int(theirs[2] or 0) - len(theirs[1] or ""))
        if abs(a - b) > max(RELATIVE * abs(b), least):
            return False
    return True
