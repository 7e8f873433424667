"""docs/how-to/add-an-imu.md"""

import re
from pathlib import Path

import pytest

from rig import Catalog, enroll
from rig.config import load_config
from rig.core.errors import DeviceMismatch
from rig.events.events import Moved
from sim.bench import ShelfOperator, open_sim_bench
from sim.devices import SimDevices
from sim.i2c import SimI2cBus
from sim.objects.shelf import shelf
from sim.world import World
from tests.docs.pages import DOCS, blocks, run


@pytest.fixture(scope="module")
def page():
    return run("\n".join(blocks("add-an-imu")))


def test_new_imu_measures_the_rotations_of_an_enrollment(page, monkeypatch, tmp_path):
    monkeypatch.setattr("rig.bench.hardware.open_imu", page["open_imu"])
    plain = load_config()
    config = plain.model_copy(update={"imu": plain.imu.model_copy(update={"model": "mpu6500"})})
    world = World(seed=1)
    with SimDevices.connected(config, world) as devices:
        devices.i2c.detach(config.imu.address)
        devices.imu = page["SimMpu6500"](world)
        devices.i2c.attach(config.imu.address, devices.imu)
        operator = ShelfOperator(world, shelf())
        with (
            open_sim_bench(config, operator, devices=devices) as bench,
            Catalog.open(tmp_path, clock=bench.clock) as catalog,
        ):
            assert bench.imu.identity.model == "MPU-6500"
            moves = [e for e in enroll(bench, catalog, "lamp", views=8) if isinstance(e, Moved)]
    assert all(move.agrees for move in moves)


def test_new_imu_rejects_another_sensor(page):
    from sim.imu.mpu6050 import SimMpu6050

    world = World(seed=1)
    with SimI2cBus(world.clock) as bus:
        bus.attach(0x68, SimMpu6050(world))
        with pytest.raises(DeviceMismatch):
            page["Mpu6500"](bus.path, clock=world.clock)


def test_files_to_change_exist():
    text = (DOCS / "how-to" / "add-an-imu.md").read_text(encoding="utf-8")
    for path in re.findall(r"`((?:rig|sim|tests)/[a-z0-9_/]+\.py)`", text):
        assert Path(DOCS.parent, path).is_file(), path
