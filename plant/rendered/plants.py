"""The rendered plants, one for each physics engine; an engine is imported when a plant is built on it."""

from __future__ import annotations

from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.rendered.engine import Engine
from servobench.plant.rendered.settings import RenderedConfig, rendered_config
from servobench.plant.rendered.world import build_rendered


def build_bullet(config: RenderedConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant on PyBullet, which loads slowly.

    Raises:
        ValueError: see `servobench.plant.rendered.world.RenderedWorld`.
    """
    from servobench.plant.rendered.bullet import BulletScene, BulletSimulation  # noqa: PLC0415

    return build_rendered(Engine(BulletScene, BulletSimulation), config, setup)


def bullet_renderer() -> str:
    """Return the engine that renders the images, with its version."""
    from servobench.plant.rendered.bullet import describe_renderer  # noqa: PLC0415

    return describe_renderer()


BULLET = PlantEntry(
    name="bullet",
    summary="PyBullet arm with dynamics; ball or discs are found in the rendered images of its cameras",
    config=RenderedConfig,
    build=build_bullet,
    needs=("pybullet",),
    engine=bullet_renderer,
    config_for=rendered_config,
    any_sensing=True,
)


def build_mujoco(config: RenderedConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant on MuJoCo, which is an extra.

    Raises:
        ValueError: see `servobench.plant.rendered.world.RenderedWorld`; or this machine cannot render.
    """
    from servobench.plant.rendered.mujoco import MujocoScene, MujocoSimulation  # noqa: PLC0415

    return build_rendered(Engine(MujocoScene, MujocoSimulation), config, setup)


def mujoco_lacks() -> str:
    """Return how to install the renderer that this machine lacks; empty if it can render."""
    try:
        from servobench.plant.rendered.mujoco import missing_renderer  # noqa: PLC0415
    except (ImportError, RuntimeError) as error:  # incompatible parts, or a MUJOCO_GL that MuJoCo does not know
        return f"MuJoCo cannot be loaded: {error}"
    return missing_renderer()


def mujoco_renderer() -> str:
    """Return which engine computes, and which library renders its images."""
    from servobench.plant.rendered.mujoco import describe_renderer  # noqa: PLC0415

    return describe_renderer()


MUJOCO = PlantEntry(
    name="mujoco",
    summary="MuJoCo arm with dynamics; ball or discs are found in the rendered images of its cameras",
    config=RenderedConfig,
    build=build_mujoco,
    needs=("mujoco",),
    lacking=mujoco_lacks,
    engine=mujoco_renderer,
    config_for=rendered_config,
    any_sensing=True,
)
