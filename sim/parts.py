"""The simulated side of a bench: what its drivers are connected to, and what a person there takes into the hand."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import serial

from rig.config import RigConfig
from rig.devices.dynamixel.port import READ_SLICE_S
from rig.errors import DeviceNotFound
from sim.camera import SimCapture
from sim.i2c import SimI2cBus
from sim.imu.bno055 import SimBno055
from sim.imu.mpu6050 import SimMpu6050
from sim.servo import ServoBus, SimSerial
from sim.servo.configured import SimulatedServo, simulated_servo
from sim.world import World

SimulatedImu = SimMpu6050 | SimBno055


@dataclass
class SimParts(AbstractContextManager["SimParts"]):
    """The devices in one world and the wires to them; leaving a ``with`` block takes the wires away.

    They outlive a bench: a second one opened on the same parts finds them as the first one left them.
    """

    world: World
    servo_bus: ServoBus
    servo: SimulatedServo
    adapter: SimSerial
    i2c: SimI2cBus
    imu: SimulatedImu
    camera: SimCapture

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.i2c.close()

    @classmethod
    def connected(cls, config: RigConfig, world: World) -> Self:
        """Return the parts that ``config`` describes, as from the factory.

        Raises
        ------
        ConfigError
            There is no simulated servo of that model, or it does not know the baud rate.
        """
        servo = simulated_servo(world, config.servo)
        servo_bus = ServoBus(world.clock)
        servo_bus.attach(servo)
        imu: SimulatedImu
        if config.imu.model == "bno055":
            imu = SimBno055(world, adr=config.imu.address == 0x29)
        else:
            imu = SimMpu6050(world, ad0=config.imu.address == 0x69)
        i2c = SimI2cBus(world.clock)
        i2c.attach(config.imu.address, imu)
        adapter = SimSerial(servo_bus, config.servo.baud, READ_SLICE_S)
        return cls(world, servo_bus, servo, adapter, i2c, imu, SimCapture(world))

    def open_wires(self) -> None:
        """Open what a closed bench has let go of: the port, and the camera's stream if the camera is there.

        Raises
        ------
        DeviceNotFound
            The adapter is not plugged in.
        """
        self.camera.reopen()
        if not self.adapter.is_open:
            try:
                self.adapter.open()
            except serial.SerialException as error:
                raise DeviceNotFound(
                    f"Cannot open {self.adapter.port}.",
                    next_step="Plug the adapter in.",
                    evidence={"reason": str(error)},
                ) from error
