"""Monte Carlo sweeps: many runs without their steps, side by side on this machine or on a Dask cluster, resumable.

Runs are carried out in chunks of a fixed size. The process that leads the sweep writes each finished chunk as one part
of the table of runs; what is there counts. A sweep that is continued carries out the chunks that are missing, so that
its table is the one that an undisturbed sweep gives, wall-clock columns aside.

A run that kills its process (a foreign FMU may) takes its pool of workers with it. The chunks that were under way are
then carried out alone, run by run, each in a process of its own; the culprit becomes a row that says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import joblib

from servobench.harness.batch import results
from servobench.harness.batch.cluster import Backend
from servobench.harness.batch.compare import Batch
from servobench.harness.batch.workers import leave_interrupts_to_parent
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.episode import crashed_row, run_experiment
from servobench.harness.run.request import RunRequest
from servobench.plant.robot.mismatch import Magnitude, Mismatch, parse_magnitudes

CHUNK = 8  # runs; small enough to lose little, large enough that files and messages cost nothing

Row = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """A run of a sweep and where it stands along the axis that is varied.

    Attributes:
        request: the run.
        axis: name of the varied axis, or "" where nothing is varied.
        magnitude: as written, such as "60deg", or "".
    """

    request: RunRequest
    axis: str = ""
    magnitude: str = ""

    def label(self, row: Row) -> Row:
        """Return a run's row with the cell's place in the sweep."""
        return {**row, "axis": self.axis, "magnitude": self.magnitude}


@dataclass(frozen=True)
class SweepPlan:
    """All combinations of these.

    Attributes:
        batch: plants, controllers, tasks, mismatches and seeds.
        variations: axis and magnitudes, such as ("camera_rotation", ("0deg", "30deg")); each is put on top of every
            mismatch on its own, not combined with the others.
        noise_factors: on the plants' sensor noise.
        latencies: periods; None for what a plant is configured with.
    """

    batch: Batch
    variations: tuple[tuple[str, tuple[str, ...]], ...] = ()
    noise_factors: tuple[float, ...] = (1.0,)
    latencies: tuple[int | None, ...] = (None,)

    def cells(self) -> list[Cell]:
        """Return the runs, seeds varying fastest."""
        places = [(axis, magnitude) for axis, magnitudes in self.variations for magnitude in magnitudes] or [("", "")]
        return [
            Cell(replace(request, mismatch=vary(request.mismatch, *place), noise_factor=noise, latency_periods=latency),
                 *place)
            for place, noise, latency in product(places, self.noise_factors, self.latencies)
            for request in self.batch.requests()
        ]  # fmt: skip


def vary(mismatch: Mismatch, axis: str, magnitude: str) -> Mismatch:
    """Return `mismatch` with one axis put on top of it; unchanged where `axis` is ""."""
    return mismatch.with_axis(axis, Magnitude.parse(axis, magnitude)) if axis else mismatch


def parse_variation(text: str) -> tuple[str, tuple[str, ...]]:
    """Return the axis and the magnitudes in `axis=begin:end:step` (both ends included) or `axis=one/another`.

    The unit stands at the end, as in `camera_rotation=0:180:30deg`.

    Raises:
        ConfigurationError: an unknown axis, or an empty or malformed range.
    """
    axis, _, values = text.strip().partition("=")
    try:
        return axis, tuple(str(magnitude) for magnitude in parse_magnitudes(axis, values))
    except ValueError as error:
        raise ConfigurationError(f"--vary: {error}") from error


@dataclass(frozen=True)
class Chunk:
    """Consecutive runs of a sweep; `index` is that of the first."""

    index: int
    cells: tuple[Cell, ...]


def chunks_of(cells: Sequence[Cell]) -> list[Chunk]:
    """Return the runs in chunks."""
    return [Chunk(begin, tuple(cells[begin : begin + CHUNK])) for begin in range(0, len(cells), CHUNK)]


def check_cells(cells: Sequence[Cell]) -> None:
    """Refuse a sweep that would carry out the same run twice.

    Raises:
        ConfigurationError: names the run.
    """
    seen: set[str] = set()
    for cell in cells:
        if cell.request.run_id in seen:
            raise ConfigurationError(f"the run {cell.request.run_id} is asked for twice")
        seen.add(cell.request.run_id)


def run_sweep(cells: Sequence[Cell], settings: Settings, folder: Path, backend: Backend) -> Iterator[list[Row]]:
    """Carry out the runs whose chunk has no part in `folder` yet; yield the rows of each chunk once it is on disk.

    Args:
        cells: all runs of the sweep.
        settings: overrides of the defaults.
        folder: a results folder.
        backend: where the runs happen.
    """
    done = results.finished_parts(folder)
    missing = {chunk.index: chunk for chunk in chunks_of(cells) if chunk.index not in done}
    under_way: set[int] = set()
    while missing:
        try:
            for index, rows in _run_together(missing, under_way, settings, backend):
                results.write_rows(folder, index, rows)
                del missing[index]
                yield rows
        except backend.lost:  # a run killed its worker
            for index in sorted(under_way & missing.keys()):
                rows = [_carry_out_alone(cell, settings) for cell in missing[index].cells]
                results.write_rows(folder, index, rows)
                del missing[index]
                yield rows


def _run_together(
    missing: Mapping[int, Chunk], under_way: set[int], settings: Settings, backend: Backend
) -> Iterator[tuple[int, list[Row]]]:
    under_way.clear()

    def jobs() -> Iterator[Any]:
        for index, chunk in list(missing.items()):
            under_way.add(index)
            yield joblib.delayed(_carry_out)(chunk, settings, backend.workers != 1)

    with joblib.parallel_config(**backend.arguments):
        parallel = joblib.Parallel(n_jobs=backend.workers, return_as="generator_unordered", batch_size=1)
        yield from parallel(jobs())


def _carry_out(chunk: Chunk, settings: Settings, in_worker: bool) -> tuple[int, list[Row]]:
    if in_worker:
        leave_interrupts_to_parent()
    return chunk.index, [_row(cell, settings) for cell in chunk.cells]


def _row(cell: Cell, settings: Settings) -> Row:
    return cell.label(run_experiment(cell.request, settings).row)


def _carry_out_alone(cell: Cell, settings: Settings) -> Row:
    """Return the row of a run in a process of its own; where that dies, the row says so."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_row, cell, settings).result()
        except BrokenProcessPool:
            return cell.label(crashed_row(cell.request, "the run killed the process that carried it out"))
