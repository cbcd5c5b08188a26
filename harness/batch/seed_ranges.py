"""Seed ranges by name: methods are tuned on some seeds and judged on all others, and never the other way round.

A run's seed decides its true robot, its task and its noise, so disjoint seeds are disjoint plants.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from servobench.harness.config.settings import ConfigurationError

TUNING: Final = range(10_000, 20_000)  # `servobench tune` draws from these alone; all other seeds are for judging


def tuning_seeds(count: int, offset: int = 0) -> tuple[int, ...]:
    """Return `count` seeds of the tuning range that begin `offset` after its first.

    Raises:
        ConfigurationError: fewer than one, or some of them outside the range.
    """
    if count < 1:
        raise ConfigurationError(f"the number of tuning seeds must be at least 1, got {count}")
    if offset < 0 or offset + count > len(TUNING):
        raise ConfigurationError(
            f"{count} seeds from {TUNING.start + offset} on leave the tuning range {_words()}; "
            f"count and offset must not be negative and together at most {len(TUNING)}"
        )
    return tuple(TUNING[offset : offset + count])


def refuse_tuning_seeds(seeds: Iterable[int]) -> None:
    """Refuse to judge methods by plants on which they were tuned.

    Raises:
        ConfigurationError: names the first seed of the tuning range and says what to take instead.
    """
    found = [seed for seed in seeds if seed in TUNING]
    if found:
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        raise ConfigurationError(
            f"seed {found[0]}{more} cannot be used to judge: {_words()} are kept for tuning; "
            f"take seeds below {TUNING.start} or from {TUNING.stop} on"
        )


def _words() -> str:
    return f"{TUNING.start}:{TUNING.stop}"
