"""A study behind tables and pictures of the pages, as `make results` carries it out, and the methods they compare."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import pandas as pd

from servobench.controllers.methods import METHODS
from servobench.controllers.methods import PUBLISHED as SUFFIX

Tables: TypeAlias = Mapping[str, pd.DataFrame]  # text cells, by name of the table
# Arguments of `servobench`, or a script of this project and its arguments
Words: TypeAlias = tuple[str, ...]
Command: TypeAlias = Words | Callable[[Path], Words]
REPRODUCTION: Final = "docs/reproduction.py"  # the script that answers the paper's claims
ENGINES: Final = ("bullet", "mujoco")
BETTER: Final = "regression_mfac"
FOUR: Final = ("rbfnn_mfac", "ukf_mfac", "ukf_mpc", "rbf_pid")  # those of the paper
FIVE: Final = (BETTER, *FOUR)
CALIBRATES: Final = "calibrating_mfac"
# Without any aid, the law as printed
PUBLISHED: Final = tuple(name for name in METHODS if name.endswith(SUFFIX))
# With all aids that help it
EQUIPPED: Final = tuple(name for name in METHODS if name not in PUBLISHED)
BOTH: Final = EQUIPPED + PUBLISHED
RENDERED: Final = (*FIVE, *(name for name in PUBLISHED if name.removesuffix(SUFFIX) in FIVE))


def nothing(_folder: Path) -> dict[str, Any]:
    """Return no table and no file."""
    return {}


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
    files: Callable[[Path], Mapping[str, bytes]] = nothing


def sweep(plants: str, controllers: Iterable[str], tasks: str, seeds: str, *options: str) -> Words:
    """Return the arguments of a sweep."""
    names = ",".join(controllers)
    return (
        "sweep",
        "--plants",
        plants,
        "--controllers",
        names,
        "--tasks",
        tasks,
        "--seeds",
        seeds,
        *options,
    )


def settings(assignments: Iterable[str]) -> Words:
    """Return the options that set `section.key=value` for each assignment."""
    return tuple(word for each in assignments for word in ("--set", each))


def on_engines(command: Callable[[str], Words]) -> dict[str, Words]:
    """Return a command for each physics engine, by the name of its plant.

    Table and floor are left out of the images: the observations are the same, bit for bit.
    """
    return {
        engine: (*command(engine), *settings([f"{engine}.scenery=false"])) for engine in ENGINES
    }
