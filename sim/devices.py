"""The simulated devices of a bench, to which its drivers are connected."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Self

import serial

from rig.config import RigConfig, ServoConfig
from rig.config.imus import imu_kind
from rig.core.errors import ConfigError, DeviceNotFound
from rig.devices.dynamixel.port import READ_SLICE_S
from sim.camera import SimCapture
from sim.head.board import PinChange, SimHead
from sim.head.serial_port import HeadSerial
from sim.i2c import SimI2cBus
from sim.imu.inertial import SimulatedImu
from sim.objects.projection import Image
from sim.objects.shelf import shelf
from sim.servo import ServoBus, SimSerial
from sim.servo.device import SimServo
from sim.world import SimObject, World


def simulated_servo(world: World, config: ServoConfig) -> SimServo:
    """Return the servo that ``config`` describes, with factory settings, on the table's shaft or behind its gear.

    Raises `ConfigError` if there is no simulated servo of that model, or the model does not have the baud rate.
    """
    try:
        return SimServo(world, config.model, bus_id=config.id, baudrate=config.baud, gear_ratio=config.gear_ratio)
    except ValueError as error:
        raise ConfigError(
            "The simulated bench has no such servo.",
            next_step="Correct servo.model or servo.baud.",
            evidence={"reason": str(error)},
        ) from error


@dataclass
class SimDevices(AbstractContextManager["SimDevices"]):
    """The devices in one world and the connections to them, which the end of a ``with`` block closes.

    They outlive a bench: a second bench on the same devices finds them in the state after the first one. ``objects``
    are those that a fault can put on the table.
    """

    world: World
    servo_bus: ServoBus
    servo: SimServo
    adapter: SimSerial
    i2c: SimI2cBus | SimHead
    imu: SimulatedImu
    camera: SimCapture
    head: SimHead | None = None
    objects: Mapping[str, SimObject] = field(default_factory=shelf, repr=False)

    def __exit__(self, *_: object) -> None:
        self.i2c.close()

    @classmethod
    def connected(cls, config: RigConfig, world: World, backdrop: Image | None = None) -> Self:
        """Return the devices that ``config`` describes, with factory settings; ``backdrop`` as in `SimCapture`.

        Raises `ConfigError` if the simulator has no servo or IMU of that model, or the servo does not support the baud
        rate.
        """
        servo = simulated_servo(world, config.servo)
        servo_bus = ServoBus(world.clock)
        servo_bus.attach(servo)
        head = _head(config, world, servo) if config.imu.connection == "head" else None
        around = head.world_at_board_time if head else world
        imu = _imu(config, around)
        i2c = head or SimI2cBus(world.clock)
        i2c.attach(config.imu.address, imu)
        adapter = SimSerial(servo_bus, config.servo.baud, READ_SLICE_S)
        camera = SimCapture(world, backdrop)
        camera.orbits = config.table.carries == "camera"
        return cls(world, servo_bus, servo, adapter, i2c, imu, camera, head)

    def head_port(self) -> HeadSerial:
        """Open the rig head's port. Raises `DeviceNotFound` if the bench has no head, or it is unplugged."""
        if self.head is None or self.head.unplugged:
            raise DeviceNotFound("No rig head is connected to this port.", next_step="Connect its USB cable.")
        return HeadSerial(self.head)

    def reopen_adapter(self) -> SimSerial:
        """Open the servo's port, even after its adapter was unplugged.

        Raises `DeviceNotFound` if the adapter is unplugged.
        """
        if not self.adapter.is_open:
            try:
                self.adapter.open()
            except serial.SerialException as error:
                raise DeviceNotFound(
                    f"Cannot open {self.adapter.port}.",
                    next_step="Connect the adapter.",
                    evidence={"reason": str(error)},
                ) from error
        return self.adapter


def _imu(config: RigConfig, world: World) -> SimulatedImu:
    row = imu_kind(config.imu.model)
    try:
        imu: SimulatedImu = resolve_name(row.simulator)(world, address=config.imu.address)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"There is no simulated {row.name}.",
            next_step="Set imu.model to another sensor, or fix the package that provides it.",
            evidence={"simulator": row.simulator, "reason": str(error)},
        ) from error
    return imu


def _head(config: RigConfig, world: World, servo: SimServo) -> SimHead:
    """Return a rig head whose ring light is the only light and whose relay supplies the servo.

    Raises `ConfigError` if the firmware cannot be built on this computer.
    """
    error = world.noise.head_clock_error * float(world.rng("head").standard_normal())
    head = SimHead(world, clock_error=error)
    level = config.head.light

    def act(change: PinChange) -> None:
        if change.pin == "light" and level is not None:
            world.change(light=(change.value / level,) * 3)
        elif change.pin == "relay" and config.head.power:
            servo.power_on() if change.value else servo.power_off()

    head.listeners.append(act)
    if level is not None:
        world.change(light=(0.0, 0.0, 0.0))
    if config.head.power:
        servo.power_off()
    return head
