"""Batches that end as soon as they are decided: their runs in the order of looks, and which of them go on.

A look comes after some seeds, in ascending order. The rule by which a batch ends is a function of the table of
runs alone, so that a batch that is resumed or put together from parts ends where an undisturbed one does.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate

import pandas as pd

from servobench.harness.batch.plan import Cell
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.files import Record


@dataclass(frozen=True)
class Looks:
    """When a batch is looked at, and what then goes on."""

    ends: tuple[int, ...]  # number of runs up to each look, the last one that of all runs
    goes_on: Callable[[pd.DataFrame], Callable[[RunRequest], bool]]
    """returns from the table of the runs so far, which may be empty, whether a run is still needed"""
    record: Record
    """entry `until_decided` of the manifest: what is asked"""


def in_looks(
    cells: Sequence[Cell], seeds: Sequence[int], looks: Sequence[int]
) -> tuple[list[Cell], tuple[int, ...]]:
    """Return runs in the order of looks, else in their own, and the number of runs up to each look.

    Args:
        cells: the runs.
        seeds: of the batch, ascending.
        looks: numbers of seeds after which one looks.
    """
    look_of = {seed: bisect_right(looks, place) for place, seed in enumerate(seeds)}
    own: list[list[Cell]] = [[] for _ in looks]
    for cell in cells:
        own[look_of[cell.request.seed]].append(cell)
    ordered = [cell for each in own for cell in each]
    return ordered, tuple(accumulate(map(len, own)))
