"""One seed a run; every part draws from a stream of its own, spawned by name."""

import zlib
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from servobench.plant.contract.checks import FloatArray, IntArray, Shape

Draw: TypeAlias = Callable[[np.random.Generator, Shape], FloatArray]
Seeds: TypeAlias = int | Sequence[int]
"""The seed of a single run, or one for each of the runs side by side."""

BLOCK = 64  # number of draws of a stream at once


def check_seed(seed: int) -> None:
    """Check a seed.

    Raises:
        ValueError: it is negative.
    """
    if seed < 0:
        raise ValueError(f"seed must be a non-negative integer, got {seed}")


def named_sequence(seed: int, name: str, *numbers: int) -> np.random.SeedSequence:
    """Return the seed sequence of the part called `name` below the run's `seed`.

    Args:
        seed: of the run.
        name: of the part.
        numbers: of a frame and a camera, say, each of which has a sequence of its own.

    Raises:
        ValueError: a negative seed.
    """
    check_seed(seed)
    return np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()), *numbers))


def named_generator(seed: int, name: str, *numbers: int) -> np.random.Generator:
    """Return the random generator of a part; see `named_sequence`."""
    return np.random.default_rng(named_sequence(seed, name, *numbers))


def named_seed(seed: int, name: str) -> int:
    """Return a 32-bit seed for the part called `name` below the run's `seed`."""
    return int(named_sequence(seed, name).generate_state(1)[0])


class Stream:
    """Random numbers of a part, drawn in advance: each run gets the numbers of its own named generator in order.

    It can be copied and pickled.
    """

    def __init__(
        self,
        seeds: Seeds,
        name: str,
        draw: Draw,
        shape: Shape = (),
        factor: float = 1.0,
    ) -> None:
        """Begin all streams.

        Args:
            seeds: one, or one for each of the runs side by side, which gives every draw a leading axis.
            name: of the part.
            draw: function of a generator and a shape, such as `numpy.random.Generator.random`.
            shape: of a draw of one run.
            factor: on all numbers.

        Raises:
            ValueError: a negative seed.
        """
        self._single = isinstance(seeds, int | np.integer)
        self._seeds = [seeds] if isinstance(seeds, int | np.integer) else list(seeds)
        for seed in self._seeds:
            check_seed(seed)
        # Generators are made with the first block, as many streams are never used.
        self._generators: list[np.random.Generator] = []
        self._name = name
        self._draw = draw
        self._shape = (BLOCK, *shape)
        self._factor = factor
        self._block: FloatArray = np.empty(0)
        self._used = BLOCK

    def next(self) -> FloatArray:
        """Return the next draw of each run, (..., *shape)."""
        if self._used == BLOCK:
            self._generators = self._generators or [
                named_generator(seed, self._name) for seed in self._seeds
            ]
            drawn = [self._draw(generator, self._shape) for generator in self._generators]
            self._block = self._factor * (drawn[0] if self._single else np.stack(drawn, axis=1))
            self._used = 0
        self._used += 1
        return self._block[self._used - 1]

    def keep(self, lanes: IntArray) -> None:
        """Drop the streams of all other lanes."""
        self._seeds = [self._seeds[lane] for lane in lanes]
        if self._generators:
            self._generators = [self._generators[lane] for lane in lanes]
            self._block = self._block[:, lanes]
