"""The bench of real devices: servo on a serial port, IMU on I2C, camera through OpenCV."""

from contextlib import ExitStack
from typing import Any

from pydantic import BaseModel

from rig.bench import Bench, BenchKind
from rig.clock import Clock, SystemClock
from rig.config import RigConfig, Section
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import ClockedPort, Wire, open_serial
from rig.devices.dynamixel.servo import DynamixelServo, SettingDifference
from rig.devices.mpu6050 import Mpu6050
from rig.devices.opencv_camera import OpenCvCamera, VideoCapture, open_capture
from rig.errors import DeviceMismatch


class NoOptions(Section):
    """The real bench is described by [servo], [table], [imu] and [camera] alone."""


class HardwareBench:
    """Opens the devices named in the configuration."""

    options: type[BaseModel] = NoOptions

    def open(self, config: RigConfig, options: Any, seed: int | None) -> Bench:  # noqa: ARG002
        """Open the real devices on the system's clock; it has no options, and ``seed`` no meaning."""
        clock = SystemClock()
        with ExitStack() as opened:
            wire = open_serial(config.servo.port, config.servo.baud)
            opened.callback(wire.close)
            capture = open_capture(config.camera.source)
            opened.callback(capture.release)
            bench = assemble("hardware", config, clock, wire=wire, i2c_bus=config.imu.bus, capture=capture)
            opened.pop_all()
            return bench


def assemble(
    name: str, config: RigConfig, clock: Clock, *, wire: Wire, i2c_bus: int | str, capture: VideoCapture
) -> Bench:
    """Put the drivers on their wires; a simulated bench is assembled by the same lines as a real one.

    Raises
    ------
    DeviceNotFound, DeviceMismatch, DeviceSilent
        A device is not there, is another one, or does not answer. What was opened here is closed again.
    """
    servo = DynamixelServo(
        DynamixelBus(ClockedPort(wire, clock, config.servo.port), config.servo.retries),
        bus_id=config.servo.id,
        model=config.servo.model,
        clock=clock,
    )
    findings = prepare_servo(servo, write=config.servo.write_settings)
    with ExitStack() as opened:
        imu = Mpu6050(
            i2c_bus,
            address=config.imu.address,
            clock=clock,
            range_dps=config.imu.range_dps,
            rate_hz=config.imu.rate_hz,
        )
        opened.callback(imu.close)
        camera = OpenCvCamera(capture, clock=clock)
        opened.pop_all()
    return Bench(name, config, clock, servo, imu, camera, findings=findings)


def prepare_servo(servo: DynamixelServo, *, write: bool) -> tuple[str, ...]:
    """Compare the servo's EEPROM with what the rig needs; write the differences where that is allowed.

    Raises
    ------
    DeviceMismatch
        Settings differ and writing is not allowed.
    """
    differences = servo.setting_differences()
    if not differences:
        return ()
    if not write:
        raise DeviceMismatch(
            f"{len(differences)} EEPROM settings of the servo are not as the rig needs them.",
            next_step="Set servo.write_settings = true once (--set servo.write_settings=true): "
            "the rig then writes these values, with torque off.",
            evidence={d.register: _found_wanted(d) for d in differences},
        )
    servo.write_settings(differences)
    return tuple(f"servo: {d.register} was {d.found}, is now {d.wanted}" for d in differences)


def _found_wanted(difference: SettingDifference) -> str:
    return f"found {difference.found}, wanted {difference.wanted}"


HARDWARE: BenchKind = HardwareBench()
