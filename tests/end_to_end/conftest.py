"""Fixtures of several end-to-end tests."""

import pytest

from kit import bullet


@pytest.fixture
def open_plant():
    """A builder of rendered plants that are closed after the test."""
    plants = []

    def build(*args, **options):
        plants.append(bullet.build(*args, **options))
        return plants[-1]

    yield build
    for plant in plants:
        plant.close()
