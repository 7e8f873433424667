"""A simulated X-series (or MX 2.0) servo: its answers on the bus, and methods for tests."""

from collections.abc import Callable

from rig.devices.dynamixel.registers import Register
from sim.servo.base import OVERLOAD_ERROR, SimulatedServoBase
from sim.servo.control_table import InstructionRejected, Memory
from sim.servo.controller import Controller
from sim.servo.models import BAUD_RATES, POSITION_MODE, servo_model
from sim.servo.protocol2 import ALERT, BROADCAST_ID, Instruction, InstructionPacket, StatusError, StatusPacket
from sim.servo.requests import CHAINED_READS, chained_reads, group_writes, word
from sim.servo.shaft import Shaft

WATCHDOG_UNIT_NS = 20_000_000  # 20 ms; the e-manual's page of the XM430 prints µs
WATCHDOG_TRIPPED = 0xFF

_TIME_BASED, _TORQUE_BY_GOAL = 0x04, 0x08  # bits of Drive Mode
_GOALS = frozenset({"Goal PWM", "Goal Current", "Goal Velocity", "Goal Position"})
# e-manual, Protocol 2.0, Clear: 0x01, and four bytes that no other packet has by chance
_CLEAR_MULTI_TURN = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))


class XSeriesServo(SimulatedServoBase):
    """A servo whose horn is the table's shaft.

    If one register of a block rejects its value, nothing of the block is written. The answer to a new id, baud rate or
    delay still uses the old one.

    Parameters
    ----------
    world
        The world that it rotates, or a gear. A second servo on the same bus has another world on the same clock.
    model
        A name for `sim.servo.models.servo_model`.
    bus_id, baudrate
        Initial settings; Factory Reset restores 1 and 57,600.
    firmware
        Firmware Version; default: that of the model.
    center_counts
        The encoder's reading at the shaft's angle 0; default: the middle of its revolution.

    Raises `ValueError`: there is no such model, id or baud rate.
    """

    protocol = 2
    memory: Memory

    def __init__(
        self,
        world: Shaft,
        model: str = "xl430_w250",
        *,
        bus_id: int = 1,
        baudrate: int = 57_600,
        firmware: int | None = None,
        center_counts: int | None = None,
    ) -> None:
        row = servo_model(model)
        if baudrate not in BAUD_RATES:
            raise ValueError(f"no servo has the baud rate {baudrate}: choose one of {', '.join(map(str, BAUD_RATES))}")
        super().__init__(world, row)
        if bus_id not in self.model.ranges["ID"]:
            raise ValueError(f"no servo has the id {bus_id}: choose one of 0 to 252")
        self.memory = Memory(self.model, self.model.firmware if firmware is None else firmware)
        self.memory["ID"] = bus_id
        self.memory["Baud Rate"] = BAUD_RATES.index(baudrate)
        center = self.memory.row.zero_counts if center_counts is None else center_counts
        self._controller = Controller(world, self.memory, self.motor, self.model, center)
        self._heard_ns = 0
        self._on_write: dict[str, Callable[[], None]] = {
            "Drive Mode": self._controller.wrap_position,
            "Operating Mode": self._controller.change_mode,
            "Temperature Limit": self._check_shutdown,
            "Max Voltage Limit": self._check_shutdown,
            "Min Voltage Limit": self._check_shutdown,
            "Torque Enable": self._on_torque_enable,
            "Bus Watchdog": self._arm_watchdog,
            "Goal Velocity": lambda: self._on_goal(self._controller.pursue_velocity),
            "Goal Position": lambda: self._on_goal(self._controller.pursue_position),
        }
        self._start()

    # -- on the bus -----------------------------------------------------------------------------------------------

    @property
    def baudrate(self) -> int:
        return BAUD_RATES[self.memory["Baud Rate"]]

    def execute(self, packet: InstructionPacket) -> StatusPacket | None:
        """Execute ``packet`` if it is for this servo, and return the answer if there is one."""
        if not self._powered:
            return None
        mine, everyones = packet.bus_id == self.bus_id, packet.bus_id == BROADCAST_ID
        in_group = packet.bus_id == self.memory["Secondary ID"] and not mine
        if not (mine or everyones or in_group):
            return None
        level = self.memory["Status Return Level"]
        if not packet.intact:
            return self._status(StatusError.CRC) if mine and level == 2 else None
        self._heard_ns = self._clock.now_ns()
        try:
            if packet.instruction in CHAINED_READS:
                request = chained_reads(packet).get(self.bus_id) if everyones else None
                answers = request is not None and level > 0
                data = self._read(*request) if request else b""
            else:
                ping, read = packet.instruction == Instruction.PING, packet.instruction == Instruction.READ
                answers = (mine and level >= 2 - read) or (ping and not in_group)
                data = self._perform(packet, everyones, in_group)
        except InstructionRejected as rejection:
            return self._status(rejection.error) if answers else None
        return self._status(StatusError.NONE, data) if answers else None

    def _perform(self, packet: InstructionPacket, everyones: bool, in_group: bool) -> bytes:
        """Execute an instruction; return the data of a read."""
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                return self.memory.read(0, 2) + self.memory.read(6, 1)
            case Instruction.READ if len(parameters) == 4:
                return b"" if everyones else self._read(word(parameters), word(parameters, 2))
            case Instruction.WRITE if len(parameters) >= 2:
                self._write(word(parameters), parameters[2:], in_group)
            case Instruction.REG_WRITE if len(parameters) >= 2:
                self._permit(self.memory.entries(word(parameters), parameters[2:]), in_group)
                self._registered = word(parameters), parameters[2:]
                self.memory["Registered Instruction"] = 1
            case Instruction.ACTION if self._registered is not None:
                registered, self._registered = self._registered, None
                self.memory["Registered Instruction"] = 0
                self._write(*registered, in_group)
            case Instruction.SYNC_WRITE | Instruction.BULK_WRITE if everyones:
                if entry := group_writes(packet).get(self.bus_id):
                    self._write(*entry, in_group)
            case Instruction.REBOOT:
                self.power_cycle()
            case Instruction.FACTORY_RESET if parameters in (b"\xff", b"\x01", b"\x02"):
                self._factory_reset(parameters[0], everyones)
            # A moving servo rejects this, as the e-manual says.
            case Instruction.CLEAR if parameters == _CLEAR_MULTI_TURN:
                if self.motor.state().speed_dps:
                    raise InstructionRejected(StatusError.RESULT_FAIL)
                self._controller.wrap_position()
            case _:
                raise InstructionRejected(StatusError.INSTRUCTION)
        return b""

    def _status(self, error: StatusError, data: bytes = b"") -> StatusPacket:
        return StatusPacket(error | (ALERT if self.memory["Hardware Error Status"] else 0), data)

    def _read(self, address: int, size: int) -> bytes:
        if address + size > self.memory.live_start:
            self._controller.refresh()
            for distort in self.distortions:
                distort(self.memory)
        return self.memory.read(address, size)

    def _write(self, address: int, data: bytes, in_group: bool) -> None:
        entries = self.memory.entries(address, data)
        self._permit(entries, in_group)
        for register, value in entries:
            self.memory[register.name] = value
            if hook := self._on_write.get(register.name):
                hook()

    def _permit(self, entries: list[tuple[Register, int]], in_group: bool) -> None:
        """Reject values that are invalid in the servo's state."""
        locked = in_group or self.memory["Torque Enable"]
        tripped = self.memory["Bus Watchdog"] == WATCHDOG_TRIPPED
        for register, value in entries:
            if register.address < self.memory.ram_start and locked:
                raise InstructionRejected(StatusError.ACCESS)
            if tripped and (register.name in _GOALS or (register.name == "Bus Watchdog" and value)):
                raise InstructionRejected(StatusError.DATA_RANGE)
            low, high = self._limits(register.name, value)
            if not low <= value <= high:
                raise InstructionRejected(StatusError.DATA_LIMIT)

    def _limits(self, name: str, value: int) -> tuple[int, int]:
        """Return the limits of ``name`` from other registers; ``value`` itself if there are none."""
        memory = self.memory
        match name:
            case "Goal Position" if memory["Operating Mode"] == POSITION_MODE:
                return memory["Min Position Limit"], memory["Max Position Limit"]
            case "Goal Position":
                return -memory.row.extended_counts, memory.row.extended_counts
            case "Goal Velocity" | "Goal PWM" | "Goal Current":
                limit = memory[name.removeprefix("Goal ") + " Limit"]
                return -limit, limit
            # e-manual, P series and MX (2.0): the models with an Acceleration Limit limit their profile
            case "Profile Velocity" | "Profile Acceleration" if (
                "Acceleration Limit" in memory and not memory["Drive Mode"] & _TIME_BASED
            ):
                return 0, memory[name.removeprefix("Profile ") + " Limit"]
        return value, value

    # -- for tests and faults -------------------------------------------------------------------------------------

    def fail(self, error: int) -> None:
        """Set bits of Hardware Error Status, such as `ENCODER_ERROR`."""
        self.memory["Hardware Error Status"] |= error
        if error & self.memory["Shutdown"] and self.memory["Torque Enable"]:
            self.memory["Torque Enable"] = 0
            self.motor.release()

    def trip_watchdog(self) -> None:
        """Let the Bus Watchdog expire now if it is enabled, as after a pause of the host."""
        if self.memory["Torque Enable"] and 0 < self.memory["Bus Watchdog"] < WATCHDOG_TRIPPED:
            self._trip()

    def slip_encoder(self, angle_deg: float) -> None:
        self._controller.slip_encoder(angle_deg)
        self._supervise()

    def _start(self) -> None:
        self._powered = True
        self._registered = None
        self.memory.forget_ram()
        self._controller.start()
        if self.memory.starts_with_torque:
            self.memory["Torque Enable"] = 1
            self._on_torque_enable()
        self._check_shutdown()

    def _factory_reset(self, option: int, everyones: bool) -> None:
        if everyones and option == 0xFF:
            return  # since firmware 42: otherwise all servos on the bus would get the same id
        self.memory.forget_all(keep={0xFF: (), 0x01: ("ID",), 0x02: ("ID", "Baud Rate")}[option])
        self.power_cycle()

    def _shut_down(self) -> bool:
        """Return whether a hardware error keeps torque off until a reboot."""
        return bool(self.memory["Hardware Error Status"] & self.memory["Shutdown"])

    def _on_torque_enable(self) -> None:
        if not self.memory["Torque Enable"]:
            self.motor.release()
        elif self._shut_down():
            self.memory["Torque Enable"] = 0
        elif not self.motor.driven:  # if it is written again, a motion continues
            self._torque_on()

    def _torque_on(self) -> None:
        self._controller.torque_on()
        self._arm_watchdog()
        self._supervise()

    def _on_goal(self, pursue: Callable[[], None]) -> None:
        memory = self.memory
        if not memory["Torque Enable"]:
            if self._shut_down() or not memory["Drive Mode"] & _TORQUE_BY_GOAL:
                return
            goals = memory["Goal Position"], memory["Goal Velocity"]
            memory["Torque Enable"] = 1
            self._torque_on()
            memory["Goal Position"], memory["Goal Velocity"] = goals
        pursue()
        self._supervise()

    def _check_shutdown(self) -> None:
        if not self._powered:
            return
        if errors := self._supply_and_heat() | (OVERLOAD_ERROR if self.motor.overloaded else 0):
            self.fail(errors)

    def _arm_watchdog(self) -> None:
        """Schedule the watchdog after the last instruction; only while torque is on."""
        units = self.memory["Bus Watchdog"]
        armed = self.memory["Torque Enable"] and 0 < units < WATCHDOG_TRIPPED
        self._schedule(self._on_watchdog, self._heard_ns + units * WATCHDOG_UNIT_NS if armed else None)

    def _on_watchdog(self) -> None:
        if self._clock.now_ns() < self._heard_ns + self.memory["Bus Watchdog"] * WATCHDOG_UNIT_NS:
            self._arm_watchdog()
        elif self.memory["Torque Enable"]:
            self._trip()

    def _trip(self) -> None:
        self.memory["Bus Watchdog"] = WATCHDOG_TRIPPED
        self._controller.stop()
