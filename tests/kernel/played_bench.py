"""A simulated bench whose devices are played on USB, in real time."""

from contextlib import AbstractContextManager
from threading import Thread
from typing import Final

from rig.config import RigConfig
from sim.devices import SimDevices
from sim.i2c import SimI2cBus
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.realtime.pace import RealTime
from sim.world import World
from tests.kernel.usb.device import UsbDevice
from tests.kernel.usb.ftdi import FtdiAdapter
from tests.kernel.usb.i2c_tiny_usb import I2cTinyUsb
from tests.kernel.usb.webcam import Webcam

OBJECT: Final = "mug-white"


class PlayedBench(AbstractContextManager["PlayedBench"]):
    """Servo, IMU and camera of a world, each behind a USB device.

    Attributes
    ----------
    devices
        The simulated devices.
    time
        Holds the world (`RealTime.present`) while a test changes it.
    servo, imu, camera
        The USB devices.
    """

    def __init__(self) -> None:
        # A slow computer waits long for the end of a vibration; the contract of an IMU is for one without errors.
        noise = NoiseModel(structure_hz=0.0, accel_bias_g=0.0, imu_tilt_deg=0.0)
        world = World(noise=noise, seed=1)
        self.devices = SimDevices.connected(RigConfig(), world)
        assert isinstance(self.devices.i2c, SimI2cBus)
        world.put(shelf()[OBJECT])
        self.servo = FtdiAdapter(self.devices.adapter)
        self.time = self.servo.time = RealTime(world.clock, [self.servo])
        self.imu = I2cTinyUsb(self.devices.i2c, self.time)
        self.camera = Webcam(self.devices.camera, self.time)
        self._thread = Thread(target=self.time.run, name="world", daemon=True)
        self._thread.start()

    @property
    def usb(self) -> tuple[UsbDevice, ...]:
        return self.servo, self.imu, self.camera

    def table(self) -> tuple[float, float]:
        """Return the servo's angle (°) and speed (°/s)."""
        with self.time.present():
            return self.devices.world.shaft()

    def restore(self) -> None:
        """End all faults of the devices."""
        with self.time.present():
            i2c, camera = self.devices.i2c, self.devices.camera
            assert isinstance(i2c, SimI2cBus)
            i2c.stuck = False
            i2c.errors.clear()
            i2c.nack_conditions.clear()
            camera.latency_ns, camera.hangs = 0, False
            camera.filters.clear()
            camera.drift(gain_db=0.0, kelvin=5000.0, focus=120.0)
        self.camera.stopped = False

    def __exit__(self, *_: object) -> None:
        self.time.over = True
        self._thread.join()
        for device in self.usb:
            device.close()
        self.devices.__exit__()
