"""What the runs of a campaign are, found in one pass that keeps none of them: 8 bytes a run."""

from __future__ import annotations

import hashlib
from array import array
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.request import RunRequest


@dataclass
class Survey:
    """What runs have in common and in how far they differ; names in the order in which they come first."""

    count: int = 0
    plants: dict[str, None] = field(default_factory=dict)
    controllers: dict[str, None] = field(default_factory=dict)
    tasks: dict[str, None] = field(default_factory=dict)
    mismatches: dict[str, None] = field(default_factory=dict)
    robots: dict[str, None] = field(default_factory=dict)
    sensings: dict[str, None] = field(default_factory=dict)
    seeds: list[range] = field(default_factory=list)  # in order, without gaps within each
    examples: list[RunRequest] = field(default_factory=list)
    """With every plant in every condition (mismatch, noise, times) and with every controller, and every task."""
    digest: str = ""  # of all runs in their order


def survey(requests: Sequence[RunRequest]) -> Survey:
    """Look at every run once.

    Raises:
        ConfigurationError: a run is asked for twice.
    """
    found = Survey(len(requests))
    digest, names, seeds = hashlib.sha256(), array("q"), _Ranges()
    kind: tuple[object, ...] = ()
    seen: set[tuple[object, ...]] = set()
    for request in requests:
        run_id = request.run_id
        digest.update(f"{run_id}\n".encode())
        names.append(hash(run_id))
        seeds.add(request.seed)
        times = request.latency, request.period
        condition = (request.mismatch, request.noise_factor, *times, request.robot, request.sensing)
        last, kind = kind, (request.plant, request.controller, request.task, condition)
        if kind == last:
            continue
        new = {(request.plant, condition), (request.plant, request.controller), (request.task,)} - seen
        if new:
            seen |= new
            found.examples.append(request)
    for example in found.examples:
        found.plants[example.plant] = found.controllers[example.controller] = found.tasks[example.task] = None
        found.mismatches[str(example.mismatch)] = found.sensings[example.sensing] = None
        if not find_plant(example.plant).own_robot:
            found.robots[example.robot] = None
    found.digest, found.seeds = digest.hexdigest(), seeds.merged()
    _refuse_repetition(requests, names)
    return found


def _refuse_repetition(requests: Iterable[RunRequest], hashes: array[int]) -> None:
    """Refuse runs of the same name; only where two of the hashes are equal the names are looked at."""
    values, counts = np.unique(np.frombuffer(hashes, dtype=np.int64), return_counts=True)
    suspects = set(values[counts > 1].tolist())
    if suspects:
        names = Counter(request.run_id for request in requests if hash(request.run_id) in suspects)
        name, count = names.most_common(1)[0]
        if count > 1:
            raise ConfigurationError(f"the run {name} is asked for twice")


class _Ranges:
    """Collects whole numbers as ranges, which are few where the numbers rise one by one again and again."""

    def __init__(self) -> None:
        self._begin = self._end = 0
        self._done: set[tuple[int, int]] = set()

    def add(self, number: int) -> None:
        if number != self._end:
            self._done.add((self._begin, self._end))
            self._begin = number
        self._end = number + 1

    def merged(self) -> list[range]:
        merged: list[range] = []
        for begin, end in sorted({*self._done, (self._begin, self._end)}):
            if merged and begin <= merged[-1].stop:
                merged[-1] = range(merged[-1].start, max(end, merged[-1].stop))
            elif end > begin:
                merged.append(range(begin, end))
        return merged
