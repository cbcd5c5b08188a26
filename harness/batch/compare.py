"""Many runs: every plant with every controller, task, mismatch and seed, side by side on worker processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import joblib
from joblib.externals.loky import get_reusable_executor

from servobench.controllers.networks.fit import Progress
from servobench.harness.batch import results
from servobench.harness.batch.seed_ranges import refuse_tuning_seeds
from servobench.harness.batch.workers import leave_interrupts_to_parent
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build_experiment, known_sections
from servobench.harness.run.request import RunRequest, read_mismatch

PICTURES = "pictures"


@dataclass(frozen=True)
class Batch:
    """The runs of a comparison: all combinations of these, in this order."""

    plants: tuple[str, ...]
    controllers: tuple[str, ...]
    tasks: tuple[str, ...]
    mismatches: tuple[str, ...]
    seeds: tuple[int, ...]

    @classmethod
    def around(cls, requests: Sequence[RunRequest]) -> Batch:
        """Return the smallest batch that holds all of `requests`."""
        places = [(each.plant, each.controller, each.task, str(each.mismatch), each.seed) for each in requests]
        return cls(*(tuple(dict.fromkeys(values)) for values in zip(*places, strict=True)))

    def requests(self) -> list[RunRequest]:
        """Return the runs, seeds varying fastest."""
        order = product(self.plants, self.tasks, self.mismatches, self.controllers, self.seeds)
        return [
            RunRequest(plant, controller, task, read_mismatch(mismatch), seed)
            for plant, task, mismatch, controller, seed in order
        ]


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds that `text` names: a count `5`, a list `3,1,4`, or a range `100:120` (end not included).

    Raises:
        ConfigurationError: none of these, or empty.
    """
    try:
        if ":" in text:
            begin, end = (int(part) for part in text.split(":"))
            seeds = tuple(range(begin, end))
        elif "," in text:
            seeds = tuple(int(part) for part in text.split(",") if part.strip())
        else:
            seeds = tuple(range(int(text)))
    except ValueError as error:
        raise ConfigurationError(
            f"seeds must be a count (5), a list (3,1,4) or a range (100:120), got {text!r}"
        ) from error
    if not seeds or min(seeds) < 0:
        raise ConfigurationError(f"seeds must name at least one seed, none of them negative; got {text!r}")
    return tuple(dict.fromkeys(seeds))


def check_batch(
    batch: Batch,
    settings: Settings,
    progress: Progress | None = None,
    noise_factor: float = 1.0,
    latency_periods: int | None = None,
) -> None:
    """Build every plant, controller, task and mismatch once, so that a bad one is refused before anything is written.

    Networks that controllers need are trained on the way.

    Args:
        batch: what will be run.
        settings: overrides of the defaults.
        progress: told how far a training of networks is.
        noise_factor: on the plants' sensor noise.
        latency_periods: of the camera; None for what a plant is configured with.

    Raises:
        ConfigurationError: a name, setting or mismatch that cannot be used, or a seed that is kept for tuning.
    """
    refuse_tuning_seeds(batch.seeds)
    settings.check_sections([*known_sections(), *batch.plants, *batch.controllers])
    mismatches = [read_mismatch(text) for text in batch.mismatches]
    names = (batch.plants[0], batch.controllers[0], batch.tasks[0])
    first = RunRequest(*names, mismatches[0], batch.seeds[0], noise_factor, latency_periods)
    requests = dict.fromkeys(
        [
            *(replace(first, plant=plant, mismatch=name) for plant, name in product(batch.plants, mismatches)),
            *(replace(first, plant=plant, controller=name) for plant, name in product(batch.plants, batch.controllers)),
            *(replace(first, task=name) for name in batch.tasks),
        ]
    )
    for request in requests:
        build_experiment(request, settings, progress=progress).plant.close()


def run_batch(
    requests: Sequence[RunRequest], settings: Settings, folder: Path, workers: int
) -> Iterator[dict[str, Any]]:
    """Carry out `requests` and yield each run's row as it finishes; every finished run is on disk by then.

    Args:
        requests: the runs.
        settings: overrides of the defaults.
        folder: a results folder made by `results.create_folder`.
        workers: number of processes; with 1 the runs happen in this one.
    """
    pictured = min(request.seed for request in requests)
    parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)
    jobs = (
        joblib.delayed(_carry_out)(index, request, settings, folder, request.seed == pictured, workers > 1)
        for index, request in enumerate(requests)
    )
    try:
        yield from parallel(jobs)
    finally:
        if workers > 1:  # idle workers would keep their memory while tables and pictures are made
            get_reusable_executor().shutdown(wait=True)


def _carry_out(
    index: int, request: RunRequest, settings: Settings, folder: Path, picture: bool, in_worker: bool
) -> dict[str, Any]:
    if in_worker:
        leave_interrupts_to_parent()
    result = run_experiment(request, settings, picture=picture, keep=folder)
    if result.steps is not None:
        results.write_part(folder, index, result.row, result.steps)
    if result.picture is not None:
        (folder / PICTURES).mkdir(exist_ok=True)
        import cv2  # noqa: PLC0415 - only the extra bullet brings it

        large = cv2.resize(result.picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / PICTURES / f"{request.run_id}.png"), cv2.cvtColor(large, cv2.COLOR_RGB2BGR))
    return result.row
