"""Which engine computes or renders a plant, and which plant a run is on that names none."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from servobench.harness.config.extras import has_no_wheel
from servobench.harness.config.registry import RENDERED, UNRENDERED, find_plant, installed_plant
from servobench.harness.config.settings import ConfigurationError
from servobench.plant.bench.plant import PlantEntry

if TYPE_CHECKING:
    from servobench.plant.rendered.engine import OpenScene


def engine_of(name: str) -> str:
    """Return which engine computes or renders a plant, in a line; empty where there is none, or no such plant here."""
    try:
        return _told(find_plant(name))
    except (ConfigurationError, ImportError):
        return ""


@cache
def _told(entry: PlantEntry) -> str:
    return entry.engine() if entry.engine is not None else ""


def default_plant() -> tuple[str, str]:
    """Return the plant of a run for which none is named, and why it is not a first choice; empty if it is.

    Where PyBullet has no wheel, `mujoco` is as good a choice as `bullet`, and the one to install.
    """
    missing = {}
    for name in RENDERED:
        try:
            installed_plant(name)
        except ConfigurationError as error:
            missing[name] = str(error)
        else:
            return name, "" if has_no_wheel() else missing.get(RENDERED[0], "")
    return UNRENDERED, missing[RENDERED[has_no_wheel()]]


def scene_of(plant: str) -> OpenScene:
    """Return what opens a scene of the engine of a rendered plant; engines load slowly, so only here."""
    if plant == "mujoco":
        from servobench.plant.rendered.mujoco.scene import MujocoScene  # noqa: PLC0415

        return MujocoScene
    from servobench.plant.rendered.bullet.scene import BulletScene  # noqa: PLC0415

    return BulletScene


def rendered_plant(named: str | None = None) -> str:
    """Return the plant whose engine shows runs of the plant `named`: itself if it renders, or else one that is there.

    Raises:
        ConfigurationError: the engine is missing, or all of them are; the message says what to install.
    """
    name, why = (named, "") if named is not None and named in RENDERED else default_plant()
    if name == UNRENDERED:
        raise ConfigurationError(why)
    return installed_plant(name).name
