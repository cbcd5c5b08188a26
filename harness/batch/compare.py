"""The runs of a comparison: every plant with every controller, task, mismatch and seed; and which seeds are for what.

A run's seed decides its true robot, its task and its noise. Methods are tuned on the seeds `TUNING` and judged on all
others, so that no method is judged by a robot on which it was tuned.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

from servobench.controllers.networks.fit import Progress
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.request import RunRequest, read_mismatch
from servobench.harness.run.resolved import known_sections

TUNING: Final = range(10_000, 20_000)  # seeds of `servobench tune`; all others are for judging


@dataclass(frozen=True)
class Batch:
    """All combinations of these."""

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

    Networks that controllers need are trained.

    Args:
        batch: what will be run.
        settings: overrides of the defaults.
        progress: receives how much of a training of networks is done.
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
        build_once(request, settings, progress)


def build_once(request: RunRequest, settings: Settings, progress: Progress | None = None) -> None:
    """Build a run and throw it away: this refuses what is configured wrongly, and trains networks.

    Whatever else fails is left to the run, whose row says so.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    try:
        build_experiment(request, settings, progress=progress).plant.close()
    except ConfigurationError:
        raise
    except Exception:  # noqa: BLE001 - of a plug-in; its run will fail in the same way
        return


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
    """Refuse to judge methods by robots on which they were tuned.

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
