"""The rendered plant on PyBullet."""

from __future__ import annotations

from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.rendered.engine import Engine
from servobench.plant.rendered.settings import RenderedConfig, rendered_config
from servobench.plant.rendered.world import build_rendered


def build_bullet(config: RenderedConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant on PyBullet, which is only imported here, as it loads slowly.

    Raises:
        ValueError: see `servobench.plant.rendered.world.RenderedWorld`.
    """
    from servobench.plant.rendered.bullet.scene import BulletScene  # noqa: PLC0415
    from servobench.plant.rendered.bullet.simulation import BulletSimulation  # noqa: PLC0415

    return build_rendered(Engine(BulletScene, BulletSimulation), config, setup)


def rendering_engine() -> str:
    """Return which engine renders the images, and how they arrive."""
    from servobench.plant.rendered.bullet.scene import describe_renderer  # noqa: PLC0415

    return describe_renderer()


ENTRY = PlantEntry(
    name="bullet",
    summary="PyBullet arm with dynamics; ball or discs are found in the rendered images of its cameras",
    config=RenderedConfig,
    build=build_bullet,
    needs=("pybullet",),
    engine=rendering_engine,
    config_for=rendered_config,
    any_sensing=True,
)
