"""A world that tests of the camera share."""

import pytest

from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World


@pytest.fixture
def world() -> World:
    """Return a world without noise, with a teapot on the table."""
    world = World(noise=NoiseModel.none())
    world.put(shelf()["teapot"])
    world.clock.sleep(100.0)
    return world
