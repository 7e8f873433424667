"""A world, an MPU-6050 and a rig head that several files of tests share."""

from collections.abc import Iterator

import pytest

from rig.devices.mpu6050 import Mpu6050
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World
from tests.contract.heads import Head, opened_head
from tests.rig.bench_parts import Wires, servo_wires
from tests.rig.imu_bench import ImuBench


@pytest.fixture
def world() -> World:
    """Return a world without noise, with a teapot on the table."""
    world = World(noise=NoiseModel.none())
    world.put(shelf()["teapot"])
    world.clock.sleep(100.0)
    return world


@pytest.fixture
def bench() -> Iterator[ImuBench]:
    with ImuBench() as b:
        yield b


@pytest.fixture
def wires() -> Wires:
    return servo_wires()


@pytest.fixture
def imu(bench: ImuBench) -> Mpu6050:
    return bench.open()


@pytest.fixture(params=["memory", "avr"])
def opened(request: pytest.FixtureRequest) -> Iterator[Head]:
    """A driver on the core in memory, and on the AVR binary."""
    with opened_head(request.param, NoiseModel.none()) as head:
        yield head
