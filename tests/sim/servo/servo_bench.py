"""A bench with one or more simulated servos, and the unmodified SDK at the other end of the bus."""

from dataclasses import dataclass, field

from dynamixel_sdk import COMM_SUCCESS, Protocol2PacketHandler

from rig.devices.dynamixel.port import ClockedPort
from rig.devices.dynamixel.registers import ControlTable, control_table
from sim.clock import VirtualClock
from sim.noise import NoiseModel
from sim.servo import Sender, SentBytes, ServoBus, SimSerial, SimServo
from sim.world import World

ALERT = 0x80
DEG_PER_COUNT = 360 / 4096  # e-manual, X series
DPS_PER_UNIT = 0.229 * 6  # 0.229 rev/min
DPS2_PER_UNIT = 214.577 * 6 / 60  # 214.577 rev/min²


@dataclass
class Line:
    """One bus, its servos by id, the SDK, and all frames on the bus."""

    baudrate: int = 1_000_000
    noise: NoiseModel = field(default_factory=NoiseModel.none)
    frames: list[SentBytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = VirtualClock()
        self.bus = ServoBus(self.clock)
        self.bus.taps.append(self.frames.append)
        self.serial = SimSerial(self.bus, self.baudrate, timeout=0.002)
        self.port = ClockedPort(self.serial, self.clock)
        self.sdk = Protocol2PacketHandler()
        self.servos: dict[int, SimServo] = {}
        self.worlds: dict[int, World] = {}

    def add(self, bus_id: int = 1, model: str = "xl430_w250", **options: int) -> SimServo:
        world = World(noise=self.noise, clock=self.clock)
        servo = SimServo(world, model, bus_id=bus_id, baudrate=options.pop("baudrate", self.baudrate), **options)
        self.bus.attach(servo)
        self.servos[bus_id] = servo
        self.worlds[bus_id] = world
        return servo

    def table(self, bus_id: int) -> ControlTable:
        servo = self.servos[bus_id]
        return control_table(servo.model.name, servo.memory["Firmware Version"])

    def read(self, name: str, bus_id: int = 1) -> int:
        """Read a register that must answer without an error; an alert is allowed."""
        register = self.table(bus_id)[name]
        data, result, error = self.sdk.readTxRx(self.port, bus_id, register.address, register.size)
        assert (result, error & ~ALERT) == (COMM_SUCCESS, 0), name
        return register.decode(bytes(data))

    def write(self, name: str, value: int, bus_id: int = 1) -> int:
        """Write a register and return the status packet's error."""
        register = self.table(bus_id)[name]
        result, error = self.sdk.writeTxRx(
            self.port, bus_id, register.address, register.size, list(register.encode(value))
        )
        assert result == COMM_SUCCESS, name
        return int(error)

    def put(self, bus_id: int = 1, **values: int) -> None:
        """Write registers (underscores for blanks) that must be accepted."""
        for name, value in values.items():
            assert self.write(name.replace("_", " "), value, bus_id) == 0, name

    def sleep(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    def shaft(self, bus_id: int = 1) -> float:
        return self.worlds[bus_id].shaft()[0]

    def sent(self, source: Sender) -> list[bytes]:
        return [frame.data for frame in self.frames if frame.source is source]


def extended(line: Line, velocity: int = 44, acceleration: int = 10) -> None:
    """Put servo 1 into extended position mode with a profile, and switch its torque on."""
    line.put(Operating_Mode=4, Profile_Velocity=velocity, Profile_Acceleration=acceleration, Torque_Enable=1)
