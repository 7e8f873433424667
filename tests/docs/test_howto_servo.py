"""docs/how-to/add-a-servo.md"""

from types import MappingProxyType

from rig import Catalog, enroll
from rig.config import load_config
from rig.devices.mpu6050 import Mpu6050
from rig.devices.opencv_camera import CameraSettings, OpenCvCamera
from rig.events.events import Enrolled, Moved
from rig.safety.state_machine import TableState
from sim.bench import ShelfOperator, open_sim_bench
from sim.devices import SimDevices
from sim.motion import to_position, to_velocity
from sim.objects.shelf import shelf
from sim.servo import models
from sim.world import World
from tests.docs.pages import blocks, run

MODEL, DRIVER, BENCH = blocks("add-a-servo")


def test_new_dynamixel_model_moves_the_simulated_table(monkeypatch):
    model = run(MODEL)["xm430_w210"]
    monkeypatch.setattr(models, "MODELS", MappingProxyType({**models.MODELS, model.name: model}))
    monkeypatch.setattr("sim.servo.configured.MODELS", models.MODELS, raising=False)
    monkeypatch.setattr("sim.servo.device.MODELS", models.MODELS, raising=False)
    config = load_config(None, ["servo.model=xm430_w210"])
    with open_sim_bench(config, ShelfOperator(World(seed=1), shelf())) as bench:
        assert bench.servo.identity.model == "xm430_w210"


class Controller:
    """The vendor's controller: it drives the shaft of the simulated world."""

    def __init__(self, world):
        self.world = world
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


def test_new_servo_turns_the_table_for_an_enrollment(tmp_path):
    world = World(seed=1)
    config = load_config(None, ["table.zero_deg=0"])
    with SimDevices.connected(config, world) as devices:

        def open_my_devices(config):
            imu = Mpu6050(devices.i2c.path, clock=world.clock)
            settings = CameraSettings(**config.camera.model_dump(exclude={"source"}))
            camera = OpenCvCamera(devices.camera, clock=world.clock, settings=settings, name="camera")
            return world.clock, imu, camera, Controller(world)

        page = run(DRIVER + BENCH)
        page["open_my_devices"] = open_my_devices
        with (
            page["STEPPER"].open(config, None, None) as bench,
            Catalog.open(tmp_path, clock=bench.clock) as catalog,
        ):
            bench.operator = ShelfOperator(world, shelf())
            assert bench.safety.state is TableState.UNREFERENCED  # as the page says
            bench.safety.set_revolutions(0)
            events = list(enroll(bench, catalog, "lamp", views=8))
    assert any(isinstance(event, Enrolled) for event in events)
    moves = [event for event in events if isinstance(event, Moved)]
    assert len(moves) >= 8
    assert all(move.agrees for move in moves)  # the gyro on the platter confirms the new servo
