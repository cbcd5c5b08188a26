"""One seed a run; every part draws from a stream of its own, spawned by name."""

from __future__ import annotations

import zlib

import numpy as np


def named_sequence(seed: int, name: str) -> np.random.SeedSequence:
    """Return the seed sequence of the part called `name` below the run's `seed`.

    Raises:
        ValueError: a negative seed.
    """
    if seed < 0:
        raise ValueError(f"seed must be a non-negative integer, got {seed}")
    return np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),))


def named_generator(seed: int, name: str) -> np.random.Generator:
    """Return the random generator of the part called `name` below the run's `seed`."""
    return np.random.default_rng(named_sequence(seed, name))


def named_seed(seed: int, name: str) -> int:
    """Return a 32-bit seed for the part called `name` below the run's `seed`."""
    return int(named_sequence(seed, name).generate_state(1)[0])
