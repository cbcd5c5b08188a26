"""Options that several commands share, and lists of names."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from harness.configuration import ConfigurationError

MAX_DEFAULT_WORKERS = 8

ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file with settings, a [section] a name.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="One setting, such as kinematic.lag=0.1.")
]


def default_workers() -> int:
    """Return how many worker processes there are unless the user says otherwise."""
    return min(MAX_DEFAULT_WORKERS, len(os.sched_getaffinity(0)))


def split_names(kind: str, text: str, known: list[str], find: Callable[[str], Any]) -> tuple[str, ...]:
    """Return the names in a list by comma, each of which `find` knows."""
    if text.strip() == "all":
        return tuple(known)
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if not names:
        raise ConfigurationError(f"--{kind} is empty; valid: {', '.join(known)}")
    for name in names:
        find(name)
    return names
