"""A run's true robot and a controller, made ready for export as one closed loop."""

from __future__ import annotations

from dataclasses import replace

from servobench.fmus.controller_export import REFERENCE
from servobench.fmus.export import ExportOptions, default_actuation, product
from servobench.fmus.product import Product
from servobench.harness.config.robots import find_robot
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.controller_fmu import controller_model
from servobench.harness.run.drawn import draw
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolved import resolve


def loop_products(request: RunRequest, settings: Settings) -> tuple[Product, Product, float]:
    """Return plant and controller of a run whose target rests, and how long the run is [s].

    The plant begins where the run does; the reference of the controller starts as the target of the run.

    Raises:
        ConfigurationError: a name or setting that cannot be used, or a controller that has no exported form.
    """
    resolved = resolve(request, settings)
    drawn, robot = draw(resolved), find_robot(request.robot)
    if drawn.true is None:
        raise ConfigurationError(f"plant {request.plant} brings a robot of its own, which is not exported")
    run: RunSettings = resolved.run
    reference = drawn.scenario.reference.sampled(run.period, 1 + run.preview_rows)
    actuation = default_actuation(robot)
    if drawn.scenario.start is not None:
        actuation = replace(actuation, home=drawn.scenario.start)
    words = f"{request.mismatch}, seed {request.seed}"
    plant = product(ExportOptions(2, drawn.true, actuation, mismatch=words, robot=robot))
    controller = controller_model(request, settings).product(2, {REFERENCE: reference.reshape(-1)})
    return plant, controller, drawn.scenario.duration
