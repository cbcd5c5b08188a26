"""The rendered plant on MuJoCo."""

from __future__ import annotations

from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.rendered.engine import Engine
from servobench.plant.rendered.settings import RenderedConfig, rendered_config
from servobench.plant.rendered.world import build_rendered


def build_mujoco(config: RenderedConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant on MuJoCo, which is only imported here, as it is an extra.

    Raises:
        ValueError: see `servobench.plant.rendered.world.RenderedWorld`; or this machine cannot render.
    """
    from servobench.plant.rendered.mujoco.scene import MujocoScene  # noqa: PLC0415
    from servobench.plant.rendered.mujoco.simulation import MujocoSimulation  # noqa: PLC0415

    return build_rendered(Engine(MujocoScene, MujocoSimulation), config, setup)


def lacking() -> str:
    """Return what to install where this machine cannot render; empty if it can."""
    try:
        from servobench.plant.rendered.mujoco.engine import missing_renderer  # noqa: PLC0415
    except (ImportError, RuntimeError) as error:  # parts that do not fit, or a MUJOCO_GL that MuJoCo does not know
        return f"MuJoCo cannot be loaded: {error}"
    return missing_renderer()


def rendering_engine() -> str:
    """Return which engine computes, and what renders its images."""
    from servobench.plant.rendered.mujoco.engine import describe_renderer  # noqa: PLC0415

    return describe_renderer()


ENTRY = PlantEntry(
    name="mujoco",
    summary="MuJoCo arm with dynamics; ball or discs are found in the rendered images of its cameras",
    config=RenderedConfig,
    build=build_mujoco,
    needs=("mujoco",),
    lacking=lacking,
    engine=rendering_engine,
    config_for=rendered_config,
    any_sensing=True,
)
