"""docs/how-to/add-a-camera.md"""

import sys
from types import ModuleType, SimpleNamespace

import cv2
import pytest

from rig import Catalog, enroll
from rig.bench import hardware
from rig.bench.computer import Computer
from rig.config import load_config
from rig.events.events import Enrolled
from rig.safety.supervisor import TableState
from sim.bench import ShelfOperator
from sim.devices import SimDevices
from sim.objects.shelf import shelf
from sim.world import World
from tests.docs.pages import blocks, run


class VendorCamera:
    """The camera of the vendor's library, before the simulated world."""

    def __init__(self, capture):
        self._capture = capture
        self.read_setting, self.write_setting = capture.get, capture.set

    def is_connected(self):
        return self._capture.isOpened()

    def next_frame(self, timeout_s):
        if not self._capture.grab():
            return None
        exposed_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        return SimpleNamespace(bgr=self._capture.retrieve()[1], exposed_ns=exposed_ns)

    def close(self):
        self._capture.release()


@pytest.mark.nightly
def test_new_camera_takes_the_views_of_an_enrollment(monkeypatch, tmp_path):
    world = World(seed=1)
    config = load_config(None, [f"state_dir={tmp_path}/state", "servo.write_settings=true"])
    with SimDevices.connected(config, world) as devices:
        vendor = ModuleType("vendor")
        vendor.open = lambda _serial_number: VendorCamera(devices.camera)
        monkeypatch.setitem(sys.modules, "vendor", vendor)
        page = run("\n".join(blocks("add-a-camera")))
        monkeypatch.setattr(Computer, "open_serial", lambda *_: devices.adapter)
        monkeypatch.setattr(hardware, "SystemClock", lambda: world.clock)
        monkeypatch.setattr(hardware, "Guardian", lambda *_: None)  # it would guard a real port
        config = config.model_copy(update={"imu": config.imu.model_copy(update={"bus": devices.i2c.path})})
        options = page["VendorOptions"](serial_number="17")
        with (
            page["VENDOR"].open(config, options, None) as bench,
            Catalog.open(tmp_path / "catalog", clock=world.clock) as catalog,
        ):
            bench.placer = ShelfOperator(world, shelf())
            if bench.safety.state is TableState.UNREFERENCED:
                bench.safety.set_revolutions(0)
            events = list(enroll(bench, catalog, "lamp", views=8))
    assert any(isinstance(event, Enrolled) for event in events)
