"""A request with all its settings as typed values: names looked up and texts read once a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servobench.harness.config.defaults import default_config
from servobench.harness.config.registry import controller_names, find_controller, find_plant, plant_names
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.tasks import find_task, task_names
from servobench.plant.bench import vary_sensing


@dataclass(frozen=True)
class ResolvedRun:
    """All that a run depends on; it can be pickled.

    Attributes:
        request: what to run.
        run: the settings that are common to all runs.
        plant: settings of the plant, noise and latency of the request included.
        controller: settings of the controller.
        task: settings of the task.
    """

    request: RunRequest
    run: RunSettings
    plant: Any
    controller: Any
    task: Any


def resolve(request: RunRequest, settings: Settings) -> ResolvedRun:
    """Return `request` with the settings of its plant, controller and task.

    Raises:
        ConfigurationError: an unknown name, or a setting that cannot be used.
    """
    plant = settings.resolve(request.plant, find_plant(request.plant).config())
    if request.noise_factor != 1.0 or request.latency_periods is not None:
        try:
            plant = vary_sensing(plant, request.noise_factor, request.latency_periods)
        except ValueError as error:
            raise ConfigurationError(f"plant {request.plant}: {error}") from error
    return ResolvedRun(
        request=request,
        run=settings.resolve("run", RunSettings()),
        plant=plant,
        controller=settings.resolve(request.controller, default_config(find_controller(request.controller))),
        task=settings.resolve(request.task, find_task(request.task).default),
    )


def known_sections() -> list[str]:
    """Return every section that a configuration may have."""
    return ["run", *plant_names(), *controller_names(), *task_names()]
