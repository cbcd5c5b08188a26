"""A study behind tables and pictures of the pages, as `make results` carries it out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pandas as pd

Tables: TypeAlias = Mapping[str, pd.DataFrame]  # text cells, by name of the table
Words: TypeAlias = tuple[str, ...]  # arguments of `servobench`, or a script of this project and its arguments
Command: TypeAlias = Words | Callable[[Path], Words]


def nothing(_folder: Path) -> dict[str, pd.DataFrame]:
    """Return no table."""
    return {}


def no_files(_folder: Path) -> Iterable[tuple[str, bytes]]:
    """Return no file."""
    return ()


@dataclass(frozen=True)
class Study:
    """Runs, and how they become tables and pictures.

    Attributes:
        name: the word in `make results ONLY=name`, of the folder and of the first table.
        purpose: what it measures, for the page.
        minutes: how long it takes on two processors, about.
        commands: name of a part -> its command without `--out`, or a function that makes it from the folder of the
            study when the parts before are complete; an empty command leaves the part out.
        tables: what is stored in docs/tables, made from the folder of the study, which holds a folder a part.
        files: further files below docs, such as pictures, by path with their content.
    """

    name: str
    purpose: str
    minutes: float
    commands: Mapping[str, Command]
    tables: Callable[[Path], Tables] = nothing
    files: Callable[[Path], Iterable[tuple[str, bytes]]] = no_files


def sweep(plants: str, controllers: Iterable[str], tasks: str, seeds: str, *options: str) -> Words:
    """Return the arguments of a sweep."""
    names = ",".join(controllers)
    return ("sweep", "--plants", plants, "--controllers", names, "--tasks", tasks, "--seeds", seeds, *options)
