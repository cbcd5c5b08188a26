"""The rendered plants, one for each physics engine."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.rendered.settings import RenderedConfig, rendered_config

if TYPE_CHECKING:
    from servobench.plant.rendered.engine import Engine


def load_engine(plant: str) -> Engine:
    """Return the physics engine of a plant, which is imported now: PyBullet loads slowly, and MuJoCo is an extra."""
    if plant == "mujoco":
        from servobench.plant.rendered.mujoco import ENGINE as MUJOCO_ENGINE  # noqa: PLC0415

        return MUJOCO_ENGINE
    from servobench.plant.rendered.bullet import ENGINE as BULLET_ENGINE  # noqa: PLC0415

    return BULLET_ENGINE


def build_rendered(plant: str, config: RenderedConfig, setup: PlantSetup) -> Bench:
    """Return a rendered plant by its name.

    Raises:
        ValueError: see `RenderedWorld`; or this machine cannot render.
    """
    from servobench.plant.rendered.world import RenderedWorld  # noqa: PLC0415 - loads OpenCV and CasADi

    make = partial(RenderedWorld, load_engine(plant), config)
    return build_bench(make, setup, config.command_delay, config.sensing)


def describe_engine(plant: str) -> str:
    """Return the engine of a plant with its version, and the library that renders its images."""
    return load_engine(plant).describe()


def mujoco_lacks() -> str:
    """Return how to install the renderer that this machine lacks; empty if it can render."""
    try:
        return load_engine("mujoco").lacking()
    except (ImportError, RuntimeError) as error:
        # The parts do not fit each other, or MuJoCo does not know the word in MUJOCO_GL.
        return f"MuJoCo cannot be loaded: {error}"


BULLET = PlantEntry(
    name="bullet",
    summary="PyBullet arm with dynamics; ball or discs are found in the rendered images of its cameras",
    config=RenderedConfig,
    build=partial(build_rendered, "bullet"),
    needs=("pybullet",),
    engine=partial(describe_engine, "bullet"),
    config_for=rendered_config,
    any_sensing=True,
)
MUJOCO = replace(
    BULLET,
    name="mujoco",
    summary=BULLET.summary.replace("PyBullet", "MuJoCo"),
    build=partial(build_rendered, "mujoco"),
    needs=("mujoco",),
    lacking=mujoco_lacks,
    engine=partial(describe_engine, "mujoco"),
)
