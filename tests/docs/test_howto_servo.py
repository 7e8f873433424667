"""docs/how-to/add-a-servo.md: packages of the page are put on the path, and the rig uses their servos."""

import sys
from types import ModuleType, SimpleNamespace

import pytest

from rig import Catalog, enroll
from rig.bench.hardware import assemble
from rig.config import load_config
from rig.core.errors import ConfigError
from rig.devices.dynamixel.servo import open_servo
from rig.events.events import Enrolled, Moved
from rig.safety.saved_state import MemoryStore
from rig.safety.supervisor import TableState
from sim.bench import ShelfOperator
from sim.computer import SimComputer
from sim.devices import SimDevices
from sim.motion import to_position, to_velocity
from sim.objects.shelf import shelf
from sim.world import World
from tests.docs.pages import blocks, install
from tests.rig.doctor.doctor_parts import unopened

ROW, DRIVER, OPEN = blocks("add-a-servo")
ROWS_TOML, DRIVER_TOML = blocks("add-a-servo", "toml")


def test_row_of_a_package_opens_and_finds_a_dynamixel(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(install(tmp_path / "rows", {"my_servos": ROW}, ROWS_TOML))
    config = load_config(None, ["servo.model=xm430_w999"])
    with SimDevices.connected(config, World(seed=1)) as devices:
        servo = open_servo(devices.adapter, config.servo, devices.world.clock, config.table.mode)
        assert (servo.identity.model, servo.identity.model_number) == ("xm430_w999", 1999)
        assert servo.read_state().position_deg == pytest.approx(180.0, abs=2.0)
    with unopened("servo.model=xm430_w999") as bench:
        bench.findings("servo")
        assert bench.context.identities["servo"]["model"] == "xm430_w999"


def test_models_of_no_package_are_a_configuration_error():
    with pytest.raises(ConfigError):
        load_config(None, ["servo.model=xm430_w999"])


class Controller:
    """The vendor's controller: it drives the shaft of the simulated world."""

    def __init__(self, connection):
        self.world = connection.world
        self.profile = 90.0, 240.0
        self.watchdog_s = None

    def read(self):
        return self.world.shaft()

    def speed(self, velocity_dps, acceleration_dps2):
        self.profile = velocity_dps, acceleration_dps2

    def move_to(self, position_deg):
        now_s, (at_deg, rate_dps) = self.world.clock.now_ns() * 1e-9, self.world.shaft()
        self.world.drive(to_position(now_s, at_deg, rate_dps, position_deg, *self.profile))

    def stop(self):
        now_s, (at_deg, rate_dps) = self.world.clock.now_ns() * 1e-9, self.world.shaft()
        self.world.drive(to_velocity(now_s, at_deg, rate_dps, 0.0, self.profile[1]))

    def stop_after_silence(self, seconds):
        self.watchdog_s = seconds

    def close(self):
        pass


@pytest.fixture
def stepper(monkeypatch, tmp_path):
    vendor = ModuleType("vendor")
    vendor.Controller = Controller
    monkeypatch.setitem(sys.modules, "vendor", vendor)
    monkeypatch.syspath_prepend(install(tmp_path / "stepper", {"my_stepper": DRIVER + OPEN}, DRIVER_TOML))
    return load_config(None, ["servo.model=stepper", "table.zero_deg=0"])


@pytest.mark.nightly
def test_servo_of_another_make_rotates_the_table_for_an_enrollment(stepper, tmp_path):
    world = World(seed=1)
    with SimDevices.connected(load_config(None, []), world) as devices:
        computer = SimComputer(tmp_path / "no files", devices, stepper)
        computer.open_serial = lambda *_: SimpleNamespace(world=world, close=lambda: None)
        bench = assemble("stepper", stepper, world.clock, computer, state=MemoryStore())
        with bench, Catalog.open(tmp_path / "catalog", clock=bench.clock) as catalog:
            bench.placer = ShelfOperator(world, shelf())
            assert bench.safety.state is TableState.UNREFERENCED  # as the page says
            bench.safety.set_revolutions(0)
            events = list(enroll(bench, catalog, "lamp", views=8))
    assert any(isinstance(event, Enrolled) for event in events)
    moves = [event for event in events if isinstance(event, Moved)]
    assert len(moves) >= 8
    assert all(move.agrees for move in moves)  # the gyro on the platter confirms the new servo


def test_doctor_sends_no_dynamixel_packets_to_a_servo_of_another_make(stepper):
    with unopened() as bench:
        wire = SimpleNamespace(world=bench.devices.world, close=lambda: None)
        bench.context.computer.open_serial = lambda *_: wire
        bench.context.config = stepper
        assert bench.context.identities.get("servo") is None
        bench.findings("servo")
        assert bench.context.identities["servo"]["model"] == "stepper"
