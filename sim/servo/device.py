"""A simulated X-series (or MX 2.0, or P series) servo: its answers on the bus, and methods for tests.

It knows the instructions that the rig sends: Ping, Read, Write and Reboot. It rejects all others.
"""

from collections.abc import Callable

from rig.devices.dynamixel.registers import Register
from sim.clock import Timer
from sim.servo.control_table import InstructionRejected, Memory
from sim.servo.controller import Controller
from sim.servo.models import BAUD_RATES, POSITION_MODE, servo_model
from sim.servo.motor import Motor
from sim.servo.protocol2 import ALERT, BROADCAST_ID, Instruction, InstructionPacket, StatusError, word
from sim.world import World

BOOT_S = 0.2  # silence after power-up or Reboot; the e-manual states no value
SUPERVISION_S = 0.1  # period of the checks of load and temperature while the servo works
RETURN_DELAY_UNIT_NS = 2_000
WATCHDOG_UNIT_NS = 20_000_000  # 20 ms; the e-manual's page of the XM430 prints µs
WATCHDOG_TRIPPED = 0xFF

VOLTAGE_ERROR, OVERHEATING_ERROR, ENCODER_ERROR, ELECTRICAL_ERROR, OVERLOAD_ERROR = 0x01, 0x04, 0x08, 0x10, 0x20
"""Bits of Hardware Error Status and Shutdown."""

_GOALS = frozenset({"Goal PWM", "Goal Current", "Goal Velocity", "Goal Position"})


class SimServo:
    """A servo whose horn is the table's shaft, or the small wheel of a gear on it with this ``gear_ratio``.

    If one register of a block rejects its value, nothing of the block is written. The answer to a new id, baud rate or
    delay still uses the old one. A second servo on the same bus has another world on the same clock. ``firmware`` is
    by default that of the model, and ``center_counts``, the encoder's reading at the shaft's angle 0, the middle of its
    revolution.

    Raises `ValueError`: there is no such model, id or baud rate.
    """

    def __init__(
        self,
        world: World,
        model: str = "xl430_w250",
        *,
        bus_id: int = 1,
        baudrate: int = 57_600,
        firmware: int | None = None,
        center_counts: int | None = None,
        gear_ratio: float = 1.0,
    ) -> None:
        row = servo_model(model)
        if baudrate not in BAUD_RATES:
            raise ValueError(f"no servo has the baud rate {baudrate}: choose one of {', '.join(map(str, BAUD_RATES))}")
        self.model = row
        self.motor = Motor(world, row, gear_ratio)
        self.distortions: list[Callable[[Memory], None]] = []
        """Called with the memory after its live registers are updated and before they are read, to falsify them."""
        self._clock = world.clock
        self._powered = True
        self._timers: dict[Callable[[], None], Timer] = {}
        if bus_id not in self.model.ranges["ID"]:
            raise ValueError(f"no servo has the id {bus_id}: choose one of 0 to 252")
        self.memory = Memory(self.model, self.model.firmware if firmware is None else firmware)
        self.memory["ID"] = bus_id
        self.memory["Baud Rate"] = BAUD_RATES.index(baudrate)
        center = self.memory.row.zero_counts if center_counts is None else center_counts
        self._controller = Controller(world, self.memory, self.motor, self.model, center)
        self._heard_ns = 0
        self._on_write: dict[str, Callable[[], None]] = {
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
    def bus_id(self) -> int:
        return self.memory["ID"]

    @property
    def baudrate(self) -> int:
        return BAUD_RATES[self.memory["Baud Rate"]]

    @property
    def return_delay_ns(self) -> int:
        return self.memory["Return Delay Time"] * RETURN_DELAY_UNIT_NS

    @property
    def powered(self) -> bool:
        """Whether the servo has power and has booted."""
        return self._powered

    def execute(self, packet: InstructionPacket) -> tuple[int, bytes] | None:
        """Execute ``packet`` if it is for this servo; return error byte and parameters of the answer, if any."""
        mine, everyones = packet.bus_id == self.bus_id, packet.bus_id == BROADCAST_ID
        if not self._powered or not (mine or everyones):
            return None
        level = self.memory["Status Return Level"]
        if not packet.intact:
            return self._status(StatusError.CRC) if mine and level == 2 else None
        self._heard_ns = self._clock.now_ns()
        ping, read = packet.instruction == Instruction.PING, packet.instruction == Instruction.READ
        answers = ping or (mine and level >= 2 - read)
        try:
            data = b"" if read and everyones else self._perform(packet)
        except InstructionRejected as rejection:
            return self._status(rejection.error) if answers else None
        return self._status(StatusError.NONE, data) if answers else None

    def _perform(self, packet: InstructionPacket) -> bytes:
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                return self.memory.read(0, 2) + self.memory.read(6, 1)
            case Instruction.READ if len(parameters) == 4:
                return self._read(word(parameters), word(parameters, 2))
            case Instruction.WRITE if len(parameters) >= 2:
                self._write(word(parameters), parameters[2:])
            case Instruction.REBOOT:
                self.power_cycle()
            case _:
                raise InstructionRejected(StatusError.INSTRUCTION)
        return b""

    def _status(self, error: StatusError, data: bytes = b"") -> tuple[int, bytes]:
        return error | (ALERT if self.memory["Hardware Error Status"] else 0), data

    def _read(self, address: int, size: int) -> bytes:
        if address + size > self.memory.live_start:
            self._controller.refresh()
            for distort in self.distortions:
                distort(self.memory)
        return self.memory.read(address, size)

    def _write(self, address: int, data: bytes) -> None:
        entries = self.memory.entries(address, data)
        self._permit(entries)
        for register, value in entries:
            self.memory[register.name] = value
            if hook := self._on_write.get(register.name):
                hook()

    def _permit(self, entries: list[tuple[Register, int]]) -> None:
        """Reject values that are invalid in the servo's state."""
        locked = self.memory["Torque Enable"]
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
            case "Profile Velocity" | "Profile Acceleration" if "Acceleration Limit" in memory:
                return 0, memory[name.removeprefix("Profile ") + " Limit"]
        return value, value

    # -- for tests and faults -------------------------------------------------------------------------------------

    def rotate_by_hand(self, angle_deg: float) -> float:
        """Rotate the shaft by hand by ``angle_deg``; see `Motor.push`."""
        return self.motor.push(angle_deg)

    def jam(self) -> None:
        """Block the shaft."""
        self.motor.jam()
        self._supervise()

    def free(self) -> None:
        """Unblock the shaft."""
        self.motor.free()
        self._supervise()

    def set_voltage(self, supply_v: float) -> None:
        """Set the supply voltage; the servo checks it at once."""
        self.motor.supply_v = supply_v
        self._check_shutdown()

    def set_temperature(self, temperature_c: float) -> None:
        """Set the temperature of the case, from which the thermal model continues."""
        self.motor.set_temperature(temperature_c)
        self._check_shutdown()

    def power_off(self) -> None:
        """Cut the supply."""
        self._powered = False
        self.memory["Torque Enable"] = 0
        self.motor.release()
        for timer in self._timers.values():
            timer.cancel()

    def power_on(self) -> None:
        """Restore the supply; the servo answers after `BOOT_S`."""
        if not self._powered:
            self.power_cycle()

    def power_cycle(self) -> None:
        """Cut the supply and restore it, like Reboot."""
        self.power_off()
        self._schedule(self._start, self._clock.now_ns() + round(BOOT_S * 1e9))

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
        """Let the encoder slip on the shaft by ``angle_deg``; the shaft follows what the encoder now reads."""
        self._controller.slip_encoder(angle_deg)
        self._supervise()

    def _start(self) -> None:
        self._powered = True
        self.memory.forget_ram()
        self._controller.start()
        self._check_shutdown()

    def _schedule(self, action: Callable[[], None], time_ns: int | None) -> None:
        """Call ``action`` at ``time_ns`` instead of at the time scheduled before; None: do not call it."""
        if timer := self._timers.pop(action, None):
            timer.cancel()
        if time_ns is not None:
            self._timers[action] = self._clock.call_at(time_ns, action)

    def _supervise(self) -> None:
        """Check load, temperature and supply now, and repeatedly while the load varies."""
        self.motor.settle()
        self._check_shutdown()
        varies = self._powered and self.motor.busy
        self._schedule(self._supervise, self._clock.now_ns() + round(SUPERVISION_S * 1e9) if varies else None)

    def _supply_and_heat(self) -> int:
        motor, memory = self.motor, self.memory
        bits = 0
        if not memory["Min Voltage Limit"] <= motor.supply_v * 10 <= memory["Max Voltage Limit"]:
            bits |= VOLTAGE_ERROR
        if motor.temperature_c(motor.state().load) > memory["Temperature Limit"]:
            bits |= OVERHEATING_ERROR
        return bits

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
        if self.memory["Torque Enable"]:  # in the drive mode "torque on by goal update", too: the rig switches it off
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
