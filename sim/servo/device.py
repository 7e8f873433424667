"""One simulated X-series (or MX 2.0) servo: what it answers on the bus, and what tests may do to it in the world."""

from collections.abc import Callable

from rig.devices.dynamixel.registers import Register
from sim.clock import Timer
from sim.motion import to_position
from sim.servo.control_table import RAM_START, Memory, Refusal
from sim.servo.models import (
    BAUD_RATES,
    COUNTS_PER_TURN,
    DEG_PER_COUNT,
    DPS2_PER_UNIT,
    DPS_PER_UNIT,
    EXTENDED_POSITION_MODE,
    MODELS,
    POSITION_MODE,
    PWM_FULL,
    VELOCITY_MODE,
)
from sim.servo.motor import Motor
from sim.servo.protocol2 import ALERT, BROADCAST_ID, Instruction, InstructionPacket, Status, StatusError
from sim.servo.requests import CHAINED_READS, chained_reads, group_writes, word
from sim.world import World

BOOT_S = 0.2
"""How long a servo is silent after power-up or Reboot; the e-manual gives no number."""
SUPERVISION_S = 0.1
"""How often the servo judges load and heat while it works."""
WATCHDOG_UNIT_S = 0.02
WATCHDOG_TRIPPED = 0xFF
IN_POSITION_COUNTS = 4
FOLLOWING_ERROR_COUNTS = 100
"""The e-manual calls these two thresholds of Moving Status predefined and gives no numbers."""
EXTENDED_RANGE_COUNTS = 1_048_575
SINGLE_TURN_HOMING_COUNTS = 1024

VOLTAGE_ERROR, OVERHEATING_ERROR, ENCODER_ERROR, ELECTRICAL_ERROR, OVERLOAD_ERROR = 0x01, 0x04, 0x08, 0x10, 0x20
"""Bits of Hardware Error Status and Shutdown."""

_REVERSE, _TIME_BASED, _TORQUE_BY_GOAL = 0x01, 0x04, 0x08
_STEP, _RECTANGULAR, _TRIANGULAR, _TRAPEZOIDAL = 0, 1, 2, 3
_GOALS = frozenset({"Goal PWM", "Goal Current", "Goal Velocity", "Goal Position"})
_GAINS = (
    "Velocity I Gain",
    "Velocity P Gain",
    "Position D Gain",
    "Position I Gain",
    "Position P Gain",
    "Feedforward 2nd Gain",
    "Feedforward 1st Gain",
)
_CLEAR_MULTI_TURN = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))
_LIVE_START = 120
"""Registers from Realtime Tick on are filled in when they are read."""


class XSeriesServo:
    """A servo whose horn is the table's shaft.

    Parameters
    ----------
    world
        The world it turns. A second servo on the same bus has a world of its own on the same clock.
    model
        A name of `sim.servo.models.MODELS`.
    bus_id, baudrate
        As left by whoever set the servo up; Factory Reset goes back to 1 and 57,600.
    firmware
        Firmware Version; the model's usual one where not given.
    center_counts
        What the encoder reads at the shaft's angle 0.
    """

    def __init__(
        self,
        world: World,
        model: str = "xl430_w250",
        *,
        bus_id: int = 1,
        baudrate: int = 57_600,
        firmware: int | None = None,
        center_counts: int = COUNTS_PER_TURN // 2,
    ) -> None:
        if model not in MODELS:
            raise ValueError(f"no simulated servo {model!r}: choose one of {', '.join(MODELS)}")
        if baudrate not in BAUD_RATES:
            raise ValueError(f"no servo speaks at {baudrate} baud: choose one of {', '.join(map(str, BAUD_RATES))}")
        self.model = MODELS[model]
        self.memory = Memory(self.model, self.model.firmware if firmware is None else firmware)
        self.memory["ID"] = bus_id
        self.memory["Baud Rate"] = BAUD_RATES.index(baudrate)
        self.motor = Motor(world, self.model)
        self._world = world
        self._clock = world.clock
        self._rng = world.rng(f"servo-{bus_id}")
        self._center = center_counts
        self._turns_counts = 0
        self._profile_type = _STEP
        self._registered: tuple[int, bytes] | None = None
        self._heard_ns = 0
        self._watchdog: Timer | None = None
        self._supervision: Timer | None = None
        self._booting: Timer | None = None
        self._powered = False
        self._on_write: dict[str, Callable[[int], None]] = {
            "Torque Enable": self._on_torque_enable,
            "Goal Position": lambda _: self._on_goal(),
            "Goal Velocity": lambda _: self._on_goal(),
            "Operating Mode": lambda _: self._on_operating_mode(),
            "Drive Mode": lambda _: self._wrap_position(),
            "Bus Watchdog": lambda _: self._arm_watchdog(),
        }
        self._start()

    # -- the bus's side -------------------------------------------------------------------------------------------

    @property
    def bus_id(self) -> int:
        return self.memory["ID"]

    @property
    def baudrate(self) -> int:
        return BAUD_RATES[self.memory["Baud Rate"]]

    @property
    def return_delay_ns(self) -> int:
        return self.memory["Return Delay Time"] * 2_000

    @property
    def powered(self) -> bool:
        """Whether the servo is up: it has power and has booted."""
        return self._powered

    def execute(self, packet: InstructionPacket) -> Status | None:
        """Do what ``packet`` asks if it concerns this servo, and return the answer if there is one to give."""
        mine, everyones = packet.bus_id == self.bus_id, packet.bus_id == BROADCAST_ID
        group = packet.bus_id == self.memory["Secondary ID"] and not mine
        if not self._powered or not (mine or everyones or group):
            return None
        level = self.memory["Status Return Level"]
        if not packet.intact:
            return self._status(StatusError.CRC) if mine and level == 2 else None
        self._heard_ns = self._clock.now_ns()
        self._judge()
        asked = packet.instruction
        if asked in CHAINED_READS:
            request = chained_reads(packet).get(self.bus_id) if everyones else None
            if request is None or level == 0:
                return None
            answers = True
            work: Callable[[], bytes | None] = lambda: self._read(*request)  # noqa: E731
        else:
            answers = asked == Instruction.PING or (mine and level >= (1 if asked == Instruction.READ else 2))
            answers = answers and not group
            work = lambda: self._perform(packet, everyones, group)  # noqa: E731
        error, data = StatusError.NONE, b""
        try:
            data = work() or b""
        except Refusal as refusal:
            error = refusal.error
        return self._status(error, data) if answers else None

    def _perform(self, packet: InstructionPacket, everyones: bool, group: bool) -> bytes | None:
        asked, parameters = packet.instruction, packet.parameters
        match asked:
            case Instruction.PING:
                return self.memory.read(0, 2) + self.memory.read(6, 1)
            case Instruction.READ if len(parameters) == 4:
                return None if everyones else self._read(word(parameters), word(parameters, 2))
            case Instruction.WRITE if len(parameters) >= 2:
                self._write(word(parameters), parameters[2:], group)
            case Instruction.REG_WRITE if len(parameters) >= 2:
                self._permit(self.memory.entries(word(parameters), parameters[2:]), group)
                self._registered = word(parameters), parameters[2:]
                self.memory["Registered Instruction"] = 1
            case Instruction.ACTION:
                if self._registered is None:
                    raise Refusal(StatusError.INSTRUCTION)
                registered, self._registered = self._registered, None
                self.memory["Registered Instruction"] = 0
                self._write(*registered, group)
            case Instruction.SYNC_WRITE | Instruction.BULK_WRITE:
                if everyones and (entry := group_writes(packet).get(self.bus_id)):
                    self._write(*entry, group)
            case Instruction.REBOOT:
                self._shut_down(BOOT_S)
            case Instruction.FACTORY_RESET if parameters[:1] in (b"\xff", b"\x01", b"\x02"):
                self._factory_reset(parameters[0], everyones)
            case Instruction.CLEAR if parameters == _CLEAR_MULTI_TURN:
                if self.motor.busy:
                    raise Refusal(StatusError.RESULT_FAIL)
                self._wrap_position()
            case _:
                raise Refusal(StatusError.INSTRUCTION)
        return None

    def _status(self, error: StatusError, data: bytes = b"") -> Status:
        return Status(error | (ALERT if self.memory["Hardware Error Status"] else 0), data)

    def _read(self, address: int, size: int) -> bytes:
        if address + size > _LIVE_START:
            self._refresh()
        return self.memory.read(address, size)

    def _write(self, address: int, data: bytes, group: bool) -> None:
        """Write all registers that ``data`` covers, or none."""
        entries = self.memory.entries(address, data)
        self._permit(entries, group)
        for register, value in entries:
            self.memory[register.name] = value
            if hook := self._on_write.get(register.name):
                hook(value)

    def _permit(self, entries: list[tuple[Register, int]], group: bool) -> None:
        for register, value in entries:
            name = register.name
            if register.address < RAM_START and (group or self.memory["Torque Enable"]):
                raise Refusal(StatusError.ACCESS)
            tripped = self.memory["Bus Watchdog"] == WATCHDOG_TRIPPED
            if tripped and (name in _GOALS or (name == "Bus Watchdog" and value)):
                raise Refusal(StatusError.DATA_RANGE)
            low, high = self._limits(name)
            if not low <= value <= high:
                raise Refusal(StatusError.DATA_LIMIT)

    def _limits(self, name: str) -> tuple[float, float]:
        memory = self.memory
        match name:
            case "Goal Position" if memory["Operating Mode"] == POSITION_MODE:
                return memory["Min Position Limit"], memory["Max Position Limit"]
            case "Goal Position":
                return -EXTENDED_RANGE_COUNTS, EXTENDED_RANGE_COUNTS
            case "Goal Velocity":
                return -memory["Velocity Limit"], memory["Velocity Limit"]
            case "Goal PWM":
                return -memory["PWM Limit"], memory["PWM Limit"]
            case "Goal Current":
                return -memory["Current Limit"], memory["Current Limit"]
        return float("-inf"), float("inf")

    # -- the world's side -----------------------------------------------------------------------------------------

    def turn_by_hand(self, angle_deg: float, speed_dps: float = 90.0) -> float:
        """Turn the shaft by ``angle_deg``, with torque off; return how many seconds the hand takes."""
        if self.memory["Torque Enable"]:
            raise ValueError("a hand does not turn the shaft against the servo's torque: switch torque off first")
        angle, speed = self.motor.angle()
        path = to_position(self._clock.now_ns() * 1e-9, angle, speed, angle + angle_deg, speed_dps, 4 * speed_dps)
        self.motor.push(path)
        return path.end_s - float(path.start_s[0])

    def jam(self) -> None:
        """Block the shaft."""
        self.motor.jam()
        self._supervise()

    def free(self) -> None:
        """Unblock the shaft."""
        self.motor.free()
        self._supervise()

    def set_voltage(self, supply_v: float) -> None:
        """Set the supply's voltage; the servo notices at once."""
        self.motor.settle()
        self.motor.supply_v = supply_v
        self._judge()

    def set_temperature(self, temperature_c: float) -> None:
        """Set the case's temperature; from there on it follows the thermal model again."""
        self.motor.set_temperature(temperature_c)
        self._judge()

    def fail(self, error: int) -> None:
        """Raise bits of Hardware Error Status, such as `ENCODER_ERROR`."""
        self._raise(error)

    def power_off(self) -> None:
        """Cut the supply."""
        self._shut_down(None)

    def power_on(self) -> None:
        """Give it back; the servo answers after `BOOT_S`."""
        if not self._powered:
            self._shut_down(BOOT_S)

    def power_cycle(self) -> None:
        self._shut_down(BOOT_S)

    # -- power ----------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        self.memory.forget_ram()
        self.memory["Goal PWM"] = self.memory["PWM Limit"]
        if "Goal Current" in self.memory:
            self.memory["Goal Current"] = self.memory["Current Limit"]
        self._registered = None
        self._started_ns = self._clock.now_ns()
        self._powered = True
        self._wrap_position()

    def _shut_down(self, boot_s: float | None) -> None:
        """Go silent, and come up again after ``boot_s`` seconds unless it is None."""
        self._powered = False
        self.memory["Torque Enable"] = 0
        self.motor.release()
        for timer in (self._watchdog, self._supervision, self._booting):
            if timer:
                timer.cancel()
        if boot_s is not None:
            self._booting = self._clock.call_at(self._clock.now_ns() + round(boot_s * 1e9), self._start)

    def _factory_reset(self, option: int, everyones: bool) -> None:
        if everyones and option == 0xFF:
            return  # firmware 42 and later: else every servo of the bus would end up with id 1
        self.memory.forget_all({0xFF: (), 0x01: ("ID",), 0x02: ("ID", "Baud Rate")}[option])
        self._shut_down(BOOT_S)

    # -- torque, modes, goals -------------------------------------------------------------------------------------

    def _on_torque_enable(self, value: int) -> None:
        if value and self.memory["Hardware Error Status"] & self.memory["Shutdown"]:
            self.memory["Torque Enable"] = 0  # after a shutdown only a reboot brings torque back
        elif value:
            self._torque_on()
        else:
            self.motor.release()

    def _torque_on(self) -> None:
        """Take the shaft as it stands: the goal written while torque was off does not count."""
        if self.memory["Operating Mode"] == POSITION_MODE:
            self._wrap_position()
        self.motor.hold()
        self.memory["Goal Position"] = self._present_position()
        self.memory["Goal Velocity"] = 0
        self._profile_type = _STEP
        self._heard_ns = self._clock.now_ns()
        self._arm_watchdog()
        self._supervise()

    def _torque_off(self) -> None:
        self.memory["Torque Enable"] = 0
        self.motor.release()

    def _on_operating_mode(self) -> None:
        """Reset what the mode change resets (e-manual, Operating Mode)."""
        for name in ("Profile Velocity", "Profile Acceleration", "Goal Velocity"):
            self.memory[name] = 0
        for name in _GAINS:
            self.memory[name] = self.model.initial.get(name, 0)
        self.memory["Goal PWM"] = self.memory["PWM Limit"]
        if self.memory["Operating Mode"] in (POSITION_MODE, EXTENDED_POSITION_MODE):
            self._wrap_position()

    def _on_goal(self) -> None:
        if not self.memory["Torque Enable"]:
            shut_down = self.memory["Hardware Error Status"] & self.memory["Shutdown"]
            if shut_down or not self.memory["Drive Mode"] & _TORQUE_BY_GOAL:
                return
            goal, velocity = self.memory["Goal Position"], self.memory["Goal Velocity"]
            self.memory["Torque Enable"] = 1
            self._torque_on()
            self.memory["Goal Position"], self.memory["Goal Velocity"] = goal, velocity
        if self.memory["Operating Mode"] == VELOCITY_MODE:
            self._pursue_velocity()
        else:
            self._pursue_position()
        self._supervise()

    def _pursue_position(self) -> None:
        """Plan the profile to the goal (e-manual, "What is the Profile")."""
        goal_deg = self._degrees(self.memory["Goal Position"])
        velocity, acceleration = self.memory["Profile Velocity"], self.memory["Profile Acceleration"]
        v_max = min(self.motor.fastest_dps, self.memory["Velocity Limit"] * DPS_PER_UNIT)
        a_max = self.motor.steepest_dps2
        distance = abs(goal_deg - self.motor.command()[0])
        if velocity and self.memory["Drive Mode"] & _TIME_BASED:
            ramp_s = min(acceleration, velocity / 2) * 1e-3
            v_max = min(v_max, max(distance / (velocity * 1e-3 - ramp_s), 1e-9))
            a_max = min(a_max, v_max / ramp_s) if ramp_s else a_max
        elif velocity:
            v_max = min(v_max, velocity * DPS_PER_UNIT)
            a_max = min(a_max, acceleration * DPS2_PER_UNIT) if acceleration else a_max
        self.motor.go_to(goal_deg, v_max, a_max)
        if not velocity:
            self._profile_type = _STEP
        elif not acceleration:
            self._profile_type = _RECTANGULAR
        else:
            peak = float(abs(self.motor.commanded.velocity_dps).max())
            self._profile_type = _TRAPEZOIDAL if peak >= v_max * (1 - 1e-9) else _TRIANGULAR

    def _pursue_velocity(self) -> None:
        goal_dps = self._sign * self.memory["Goal Velocity"] * DPS_PER_UNIT
        goal_dps = min(max(goal_dps, -self.motor.fastest_dps), self.motor.fastest_dps)
        acceleration, a_max = self.memory["Profile Acceleration"], self.motor.steepest_dps2
        if acceleration and self.memory["Drive Mode"] & _TIME_BASED:
            change = abs(goal_dps - self.motor.command()[1])
            a_max = min(a_max, max(change / (acceleration * 1e-3), 1e-9))
        elif acceleration:
            a_max = min(a_max, acceleration * DPS2_PER_UNIT)
        self.motor.turn_at(goal_dps, a_max)
        self._profile_type = _TRAPEZOIDAL if acceleration else _STEP

    # -- supervision ----------------------------------------------------------------------------------------------

    def _supervise(self) -> None:
        """Judge the servo's health now, and again and again while its load varies."""
        if self._supervision:
            self._supervision.cancel()
            self._supervision = None
        self.motor.settle()
        self._judge()
        if self._powered and self.motor.busy:
            due_ns = self._clock.now_ns() + round(SUPERVISION_S * 1e9)
            self._supervision = self._clock.call_at(due_ns, self._supervise)

    def _judge(self) -> None:
        if not self._powered:
            return
        voltage, memory = self.motor.supply_v * 10, self.memory
        errors = 0
        if not memory["Min Voltage Limit"] <= voltage <= memory["Max Voltage Limit"]:
            errors |= VOLTAGE_ERROR
        if self.motor.temperature_c() > memory["Temperature Limit"]:
            errors |= OVERHEATING_ERROR
        if self.motor.overloaded:
            errors |= OVERLOAD_ERROR
        if errors:
            self._raise(errors)

    def _raise(self, errors: int) -> None:
        self.memory["Hardware Error Status"] |= errors
        if errors & self.memory["Shutdown"] and self.memory["Torque Enable"]:
            self._torque_off()

    def _arm_watchdog(self) -> None:
        if self._watchdog:
            self._watchdog.cancel()
            self._watchdog = None
        if self.memory["Torque Enable"] and 0 < self.memory["Bus Watchdog"] < WATCHDOG_TRIPPED:
            self._watchdog = self._clock.call_at(self._watchdog_due_ns(), self._on_watchdog)

    def _watchdog_due_ns(self) -> int:
        return self._heard_ns + round(self.memory["Bus Watchdog"] * WATCHDOG_UNIT_S * 1e9)

    def _on_watchdog(self) -> None:
        self._watchdog = None
        if not self.memory["Torque Enable"]:
            return  # it watches only while torque is on
        if self._clock.now_ns() < self._watchdog_due_ns():
            self._arm_watchdog()
            return
        self.memory["Bus Watchdog"] = WATCHDOG_TRIPPED
        self.memory["Profile Velocity"] = self.memory["Profile Acceleration"] = 0
        self._profile_type = _STEP
        self.motor.brake()

    # -- readings -------------------------------------------------------------------------------------------------

    @property
    def _sign(self) -> int:
        return -1 if self.memory["Drive Mode"] & _REVERSE else 1

    @property
    def _homing(self) -> int:
        offset = self.memory["Homing Offset"]
        single_turn = self.memory["Operating Mode"] == POSITION_MODE
        return 0 if single_turn and abs(offset) > SINGLE_TURN_HOMING_COUNTS else offset

    def _counts(self, angle_deg: float) -> int:
        """Return the value of a position register at a shaft angle."""
        counts = self._sign * round(angle_deg / DEG_PER_COUNT + self._center)
        return counts - self._turns_counts + self._homing

    def _degrees(self, counts: int) -> float:
        """Return the shaft angle of a position register's value."""
        return (self._sign * (counts - self._homing + self._turns_counts) - self._center) * DEG_PER_COUNT

    def _wrap_position(self) -> None:
        """Forget the turns: from here on the position counts from within one revolution."""
        self._turns_counts = 0
        present = self._present_position() - self._homing
        self._turns_counts = present - present % COUNTS_PER_TURN
        self.memory["Goal Position"] = self._present_position()

    def _present_position(self) -> int:
        noise = self._world.noise.encoder_noise_deg
        return self._counts(self.motor.angle()[0] + (noise * self._rng.standard_normal() if noise else 0.0))

    def _refresh(self) -> None:
        """Fill in the registers that follow the world."""
        memory, motor = self.memory, self.motor
        present = self._present_position()
        target_deg, target_dps = motor.command()
        velocity = self._sign * round(motor.angle()[1] / DPS_PER_UNIT)
        load = self._sign * motor.load()
        noise = self._world.noise.voltage_noise_v
        voltage = motor.terminal_v() + (noise * self._rng.standard_normal() if noise else 0.0)
        memory["Realtime Tick"] = (self._clock.now_ns() - self._started_ns) // 1_000_000 % 32_768
        memory["Moving Status"] = status = self._moving_status(present, self._counts(target_deg))
        memory["Moving"] = int(bool(status & 0x02) or abs(velocity) > memory["Moving Threshold"])
        memory["Present PWM"] = self._sign * round(motor.pwm() * PWM_FULL)
        if self.model.stall_current is None:
            memory["Present Load"] = round(load * 1000)
        else:
            memory["Present Current"] = round(load * self.model.stall_current)
        memory["Present Velocity"] = velocity
        memory["Present Position"] = present
        memory["Velocity Trajectory"] = self._sign * round(target_dps / DPS_PER_UNIT)
        memory["Position Trajectory"] = self._counts(target_deg)
        memory["Present Input Voltage"] = max(round(voltage * 10), 0)
        memory["Present Temperature"] = min(max(round(motor.temperature_c()), 0), 255)

    def _moving_status(self, present: int, target: int) -> int:
        if not self.memory["Torque Enable"]:
            return 0
        profile = self._profile_type << 4
        if self.memory["Operating Mode"] == VELOCITY_MODE:
            return profile
        in_position = abs(self.memory["Goal Position"] - present) <= IN_POSITION_COUNTS
        ongoing = self._profile_type != _STEP and self.motor.profile_ongoing
        following_error = abs(target - present) > FOLLOWING_ERROR_COUNTS
        return in_position | ongoing << 1 | following_error << 3 | profile
