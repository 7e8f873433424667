"""A simulated AX-12A: its control table, its answers in Protocol 1.0, and methods for tests.

Source: e-manual page "AX-12+, AX-12A". The addresses are not the driver's (decision 0001). LEDs, compliance, punch and
Max Torque are stored but have no effect.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

from rig.devices.dynamixel.registers import control_table
from sim.servo.base import SimulatedServoBase
from sim.servo.models import ServoModel
from sim.servo.protocol1 import Error
from sim.servo.protocol2 import BROADCAST_ID, Instruction, InstructionPacket, StatusPacket
from sim.servo.shaft import Shaft

DEG_PER_COUNT = 300.0 / 1023.0  # e-manual, AX-12A: 300° in 1,023 steps, 0.111 rev/min for each unit
DPS_PER_UNIT = 0.111 * 6.0
CENTER_COUNTS = 512  # 150°, the middle of its range
BAUD_RATES = {
    1: 1_000_000,
    3: 500_000,
    4: 400_000,
    7: 250_000,
    9: 200_000,
    16: 115_200,
    34: 57_600,
    103: 19_200,
    207: 9_600,
}
"""Baud rates by the register's value n: the standard rate next to 2,000,000 / (n + 1)."""

_COUNTS = range(1024)
_BYTE = range(256)
_DIRECTION = 0x400  # bit 10 of speed and load: clockwise
_ARRIVED_COUNTS = 2
_MOVING_DPS = 1.0  # the e-manual states no threshold of Moving

AX_12A = ServoModel(
    name="ax_12a",
    firmware=24,
    initial=MappingProxyType({}),
    ranges=MappingProxyType({"ID": range(254)}),
    supply_v=12.0,
    no_load_dps=59.0 * 6.0,
    stall_error_deg=32 * DEG_PER_COUNT,  # its Compliance Slope
    inertia_s=0.055,  # fitted to a recorded step (docs/explanation/simulator-against-recordings.md)
)


@dataclass(frozen=True, slots=True)
class Ax12Register:
    """A register: its address, its initial value, and its valid values (none: it is read only)."""

    address: int
    size: int
    initial: int
    allowed: range | None


# e-manual, AX-12A, control table: address, size, initial value, range
ENTRIES: dict[str, Ax12Register] = {
    "Model Number": Ax12Register(0, 2, 12, None),
    "Firmware Version": Ax12Register(2, 1, 24, None),
    "ID": Ax12Register(3, 1, 1, range(254)),
    "Baud Rate": Ax12Register(4, 1, 1, range(1, 255)),
    "Return Delay Time": Ax12Register(5, 1, 250, range(255)),
    "CW Angle Limit": Ax12Register(6, 2, 0, _COUNTS),
    "CCW Angle Limit": Ax12Register(8, 2, 1023, _COUNTS),
    "Temperature Limit": Ax12Register(11, 1, 70, range(100)),
    "Min Voltage Limit": Ax12Register(12, 1, 60, range(50, 161)),
    "Max Voltage Limit": Ax12Register(13, 1, 140, range(50, 161)),
    "Max Torque": Ax12Register(14, 2, 1023, _COUNTS),
    "Status Return Level": Ax12Register(16, 1, 2, range(3)),
    "Alarm LED": Ax12Register(17, 1, 36, range(128)),
    "Shutdown": Ax12Register(18, 1, 36, range(128)),
    "Torque Enable": Ax12Register(24, 1, 0, range(2)),
    "LED": Ax12Register(25, 1, 0, range(2)),
    "CW Compliance Margin": Ax12Register(26, 1, 1, _BYTE),
    "CCW Compliance Margin": Ax12Register(27, 1, 1, _BYTE),
    "CW Compliance Slope": Ax12Register(28, 1, 32, _BYTE),
    "CCW Compliance Slope": Ax12Register(29, 1, 32, _BYTE),
    "Goal Position": Ax12Register(30, 2, 0, _COUNTS),
    "Moving Speed": Ax12Register(32, 2, 0, range(2048)),
    "Torque Limit": Ax12Register(34, 2, 1023, _COUNTS),
    "Present Position": Ax12Register(36, 2, 0, None),
    "Present Speed": Ax12Register(38, 2, 0, None),
    "Present Load": Ax12Register(40, 2, 0, None),
    "Present Voltage": Ax12Register(42, 1, 0, None),
    "Present Temperature": Ax12Register(43, 1, 0, None),
    "Registered": Ax12Register(44, 1, 0, None),
    "Moving": Ax12Register(46, 1, 0, None),
    "Lock": Ax12Register(47, 1, 0, range(2)),
    "Punch": Ax12Register(48, 2, 32, _COUNTS),
}
SIZE = 50
RAM_START = 24
_LIVE = slice(36, 47)  # Present Position to Moving: what changes by itself


class Image:
    """The control table's bytes, by register name."""

    def __init__(self, model_number: int) -> None:
        self._bytes = bytearray(SIZE)
        self.restore(0)
        self["Model Number"] = model_number

    def __getitem__(self, name: str) -> int:
        entry = ENTRIES[name]
        return int.from_bytes(self._bytes[entry.address : entry.address + entry.size], "little")

    def __setitem__(self, name: str, value: int) -> None:
        entry = ENTRIES[name]
        self._bytes[entry.address : entry.address + entry.size] = value.to_bytes(entry.size, "little")

    def live(self) -> bytes:
        """Return the registers that follow the world."""
        return bytes(self._bytes[_LIVE])

    def set_live(self, data: bytes) -> None:
        """Set the registers that follow the world."""
        self._bytes[_LIVE] = data

    def restore(self, start: int) -> None:
        """Set all registers from address ``start`` to their initial values."""
        for name, entry in ENTRIES.items():
            if entry.address >= start:
                self[name] = entry.initial

    def read(self, address: int, size: int) -> bytes | None:
        """Return ``size`` bytes, or None if they exceed the table."""
        return bytes(self._bytes[address : address + size]) if size > 0 and address + size <= SIZE else None

    def entries(self, address: int, data: bytes) -> list[tuple[str, int]] | None:
        """Return the registers that a write sets, or None if one is cut, out of range or read only."""
        at = {entry.address: (name, entry) for name, entry in ENTRIES.items()}
        found, i = [], 0
        while i < len(data):
            name, entry = at.get(address + i, ("", None))
            if entry is None or entry.allowed is None or i + entry.size > len(data):
                return None
            value = int.from_bytes(data[i : i + entry.size], "little")
            if value not in entry.allowed:
                return None
            found.append((name, value))
            i += entry.size
        return found or None


class Ax12Servo(SimulatedServoBase):
    """A servo of Protocol 1.0 on the table's shaft: 0..300° in joint mode, endless rotation in wheel mode.

    The servo is in wheel mode if both angle limits are 0. Like on the device, writing a goal switches the torque on.
    After a shutdown (overload, heat) Torque Limit is 0, and the servo does not hold until it is written again.

    Parameters
    ----------
    shaft
        The shaft that it rotates.
    model
        Its name and speed; the registers are those of an AX-12A.
    bus_id, baudrate
        Initial settings.
    center_counts
        The position reading at the shaft's angle 0.

    Raises `ValueError`: there is no such id or baud rate.
    """

    protocol = 1
    memory: Image

    def __init__(
        self,
        shaft: Shaft,
        model: ServoModel = AX_12A,
        *,
        bus_id: int = 1,
        baudrate: int = 1_000_000,
        center_counts: int = CENTER_COUNTS,
    ) -> None:
        if bus_id not in range(254):
            raise ValueError(f"no servo has the id {bus_id}: choose one of 0 to 253")
        if baudrate not in BAUD_RATES.values():
            known = ", ".join(map(str, sorted(BAUD_RATES.values())))
            raise ValueError(f"an AX-12A has no baud rate {baudrate}: choose one of {known}")
        super().__init__(shaft, model)
        self.memory = Image(control_table(model.name).row.number)
        self.memory["ID"] = bus_id
        self.memory["Baud Rate"] = next(n for n, rate in BAUD_RATES.items() if rate == baudrate)
        self._shaft = shaft
        self._center = center_counts
        self._rng = shaft.rng(f"servo-{bus_id}")
        self._overload = False
        self._failed = 0
        self._on_write: dict[str, Callable[[], None]] = {
            "Torque Enable": self._on_torque_enable,
            "Goal Position": self._on_goal,
            "Moving Speed": self._on_speed,
            "Torque Limit": self._on_torque_limit,
        }

    # -- on the bus -----------------------------------------------------------------------------------------------

    @property
    def baudrate(self) -> int:
        n = self.memory["Baud Rate"]
        return BAUD_RATES.get(n, 2_000_000 // (n + 1))

    def execute(self, packet: InstructionPacket) -> StatusPacket | None:
        """Execute ``packet`` if it is for this servo, and return the answer if there is one."""
        everyones = packet.bus_id == BROADCAST_ID
        if not self._powered or not (everyones or packet.bus_id == self.bus_id):
            return None
        level = self.memory["Status Return Level"]
        if not packet.intact:
            return None if everyones else StatusPacket(self._hardware_errors() | Error.CHECKSUM)
        error, data = self._perform(packet)
        ping = packet.instruction == Instruction.PING
        answers = ping or (not everyones and level >= 2 - (packet.instruction == Instruction.READ))
        return StatusPacket(self._hardware_errors() | error, data) if answers else None

    def _perform(self, packet: InstructionPacket) -> tuple[int, bytes]:
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                return 0, b""
            case Instruction.READ if len(parameters) == 2:
                self._refresh()
                for distort in self.distortions:
                    distort(self.memory)
                data = self.memory.read(parameters[0], parameters[1])
                return (Error.RANGE, b"") if data is None else (0, data)
            case Instruction.WRITE if len(parameters) >= 2:
                return self._write(parameters[0], parameters[1:]), b""
            case Instruction.REG_WRITE if len(parameters) >= 2:
                if error := self._rejection(self.memory.entries(parameters[0], parameters[1:])):
                    return error, b""
                self._registered = parameters[0], parameters[1:]
                self.memory["Registered"] = 1
            case Instruction.ACTION if self._registered is not None:
                registered, self._registered = self._registered, None
                self.memory["Registered"] = 0
                return self._write(*registered), b""
            case Instruction.FACTORY_RESET:
                self.memory.restore(0)
                self.power_cycle()
            # Each servo takes its part of the packet.
            case Instruction.SYNC_WRITE if packet.bus_id == BROADCAST_ID and len(parameters) > 2:
                address, size = parameters[0], parameters[1]
                for i in range(2, len(parameters) - size, size + 1):
                    if parameters[i] == self.bus_id:
                        self._write(address, parameters[i + 1 : i + 1 + size])
            case _:
                return Error.INSTRUCTION, b""
        return 0, b""

    def _write(self, address: int, data: bytes) -> int:
        entries = self.memory.entries(address, data)
        if error := self._rejection(entries):
            return error
        assert entries is not None
        for name, value in entries:
            self.memory[name] = value
            if hook := self._on_write.get(name):
                hook()
        return 0

    def _rejection(self, entries: list[tuple[str, int]] | None) -> int:
        if entries is None:
            return Error.RANGE
        low, high = self.memory["CW Angle Limit"], self.memory["CCW Angle Limit"]
        for name, value in entries:
            if name == "Goal Position" and not self._wheel and not low <= value <= high:
                return Error.ANGLE_LIMIT
            if ENTRIES[name].address < RAM_START and self.memory["Lock"]:
                return Error.INSTRUCTION
        return 0

    # -- for tests and faults -------------------------------------------------------------------------------------

    def fail(self, error: int) -> None:
        """Set bits of the error byte until the next power-up."""
        self._failed |= error
        self._supervise()

    def trip_watchdog(self) -> None:
        """Do nothing: this servo has no watchdog."""

    def slip_encoder(self, angle_deg: float) -> None:
        """Let the potentiometer slip by ``angle_deg``; the shaft follows the new reading."""
        self._center += round(angle_deg / DEG_PER_COUNT)
        if self.motor.driven:
            self._on_goal()

    @property
    def _wheel(self) -> bool:
        return self.memory["CW Angle Limit"] == self.memory["CCW Angle Limit"] == 0

    def _start(self) -> None:
        self._powered, self._overload, self._failed, self._registered = True, False, 0, None
        self.memory.restore(RAM_START)
        self.memory["Torque Limit"] = self.memory["Max Torque"]

    def _hardware_errors(self) -> int:
        """Return the error bits of the hardware's state."""
        return self._supply_and_heat() | self._failed | (Error.OVERLOAD if self._overload else 0)

    def _check_shutdown(self) -> None:
        if not self._powered:
            return
        self._overload |= self.motor.overloaded
        if self._hardware_errors() & self.memory["Shutdown"] and self.memory["Torque Enable"]:
            self.memory["Torque Enable"] = self.memory["Torque Limit"] = 0
            self.motor.release()

    def _on_torque_enable(self) -> None:
        if not self.memory["Torque Enable"]:
            self.motor.release()
        elif not self.memory["Torque Limit"]:
            self.memory["Torque Enable"] = 0
        elif not self.motor.driven:
            self.motor.hold()
            self.memory["Goal Position"] = self._position()

    def _on_torque_limit(self) -> None:
        if self.memory["Torque Limit"]:
            self._overload = False

    def _on_goal(self) -> None:
        if self._wheel:
            return
        goal = self.memory["Goal Position"]
        if not self.memory["Torque Enable"]:
            self.memory["Torque Enable"] = 1
            self._on_torque_enable()
            if not self.motor.driven:
                return
            self.memory["Goal Position"] = goal
        speed = (self.memory["Moving Speed"] & 0x3FF) * DPS_PER_UNIT
        v_max = min(speed, self.motor.fastest_dps) if speed else self.motor.fastest_dps
        self.motor.go_to((goal - self._center) * DEG_PER_COUNT, v_max, self.motor.steepest_dps2)
        self._supervise()

    def _on_speed(self) -> None:
        if self._wheel and self.memory["Torque Enable"]:
            speed = self.memory["Moving Speed"]
            dps = (speed & 0x3FF) / 1023 * self.motor.fastest_dps
            self.motor.rotate_at(-dps if speed & _DIRECTION else dps, self.motor.steepest_dps2)
            self._supervise()

    def _position(self) -> int:
        """Return the position reading; outside the 300° of the potentiometer it is the next end."""
        noise_deg = self._shaft.noise.encoder_noise_deg
        error_deg = noise_deg * self._rng.standard_normal() if noise_deg else 0.0
        counts = round((self._shaft.rippled_deg() + error_deg) / DEG_PER_COUNT + self._center)
        return min(max(counts, 0), 1023)

    def _refresh(self) -> None:
        """Update the registers that follow the world."""
        memory, motor = self.memory, self.motor
        state = motor.state()
        memory["Present Position"] = self._position()
        memory["Present Speed"] = _signed(state.speed_dps / DPS_PER_UNIT)
        memory["Present Load"] = _signed(state.load * 1000)
        memory["Present Voltage"] = min(max(round(motor.terminal_v(state.load) * 10), 0), 255)
        memory["Present Temperature"] = min(max(round(motor.temperature_c(state.load)), 0), 255)
        goal_deg = (memory["Goal Position"] - self._center) * DEG_PER_COUNT
        away = motor.driven and not self._wheel and abs(state.angle_deg - goal_deg) > _ARRIVED_COUNTS * DEG_PER_COUNT
        memory["Moving"] = int(abs(state.speed_dps) > _MOVING_DPS or away)


def _signed(value: float) -> int:
    """Return a magnitude of up to 1023 with its direction in bit 10, clockwise (falling) set."""
    return min(abs(round(value)), 1023) | (_DIRECTION if value < 0 else 0)
