"""Fixtures of several end-to-end tests."""

import pytest

from kit import rendered
from kit.plants import plant_parameters
from servobench.harness.config.registry import RENDERED
from servobench.plant.rendered.plants import load_engine
from servobench.plant.rendered.room import Room


@pytest.fixture(params=plant_parameters(RENDERED))
def engine(request):
    """The name of each rendered plant."""
    return request.param


@pytest.fixture
def open_plant(engine):
    """A builder of rendered plants that are closed after the test."""
    plants = []

    def build(*args, **options):
        plants.append(rendered.build(*args, **options, engine=engine))
        return plants[-1]

    yield build
    for plant in plants:
        plant.close()


@pytest.fixture
def open_scene(engine):
    """A builder of scenes of the nominal UR5 that are closed after the test."""
    scenes = []

    def build(**options):
        scenes.append(
            load_engine(engine).scene(Room(rendered.MODEL.arm, robot=rendered.UR5, **options))
        )
        return scenes[-1]

    yield build
    for scene in scenes:
        scene.close()
