"""Which engine computes or renders a plant, for tables and manifests."""

from __future__ import annotations

from functools import cache

from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import ConfigurationError
from servobench.plant.plant import PlantEntry


def engine_of(name: str) -> str:
    """Return which engine computes or renders a plant, in a line; empty where there is none, or no such plant here."""
    try:
        return _told(find_plant(name))
    except (ConfigurationError, ImportError):
        return ""


@cache
def _told(entry: PlantEntry) -> str:
    return entry.engine() if entry.engine is not None else ""
