"""A Dynamixel X or MX (2.0) servo as the table's drive: extended position mode, registers by name, units of the rig."""

from dataclasses import dataclass

from rig.clock import Clock
from rig.devices.dynamixel.bus import DynamixelBus, watchdog_units
from rig.devices.dynamixel.registers import ControlTable, control_table, model_numbers
from rig.devices.servo import MotionProfile, ServoCondition, ServoIdentity, ServoLimits, ServoState
from rig.errors import DeviceFault, DeviceMismatch, DeviceNotFound, DeviceRefused, DeviceSilent

COUNTS_PER_TURN = 4096
DEG_PER_COUNT = 360.0 / COUNTS_PER_TURN
DPS_PER_UNIT = 0.229 * 6.0  # Velocity registers: 0.229 rev/min
DPS2_PER_UNIT = 214.577 * 6.0 / 60.0  # Profile Acceleration: 214.577 rev/min^2
EXTENDED_POSITION_MODE = 4
WATCHDOG_TRIPPED = 0xFF
BOOT_ALLOWANCE_S = 3.0
"""How long a servo may be silent after a reboot; the e-manual gives no number, they take some tenths of a second."""

_HARDWARE_ERRORS = {
    0: "input voltage",
    2: "overheating",
    3: "motor encoder",
    4: "electrical shock",
    5: "overload",
}
_DRIVE_MODE_BITS = 0b1101
"""Drive Mode bits that must be 0: reverse direction (the table's direction is the rig's), time-based profile, and
torque on by goal update (after a dip of its supply the servo would obey the next goal, unprofiled)."""


@dataclass(frozen=True, slots=True)
class SettingDifference:
    """An EEPROM register that is not as the rig needs it."""

    register: str
    found: int
    wanted: int


class DynamixelServo:
    """A servo on a `DynamixelBus`; implements `rig.devices.servo.Servo`.

    Opening only reads: identity and EEPROM are compared with what the rig needs. Nothing moves, torque stays as it is.

    Raises
    ------
    DeviceNotFound
        Nothing answers at ``bus_id``.
    DeviceMismatch
        Another model answers.
    """

    def __init__(self, bus: DynamixelBus, *, bus_id: int, model: str, clock: Clock) -> None:
        self._bus = bus
        self._clock = clock
        self._id = bus_id
        try:
            number = bus.ping(bus_id)
        except DeviceSilent as silent:
            raise DeviceNotFound(
                f"No servo answers at id {bus_id}.",
                next_step="Check the servo's power and cable, and servo.id and servo.baud in the configuration.",
                evidence=silent.evidence,
            ) from silent
        found = model_numbers().get(number, f"unknown model {number}")
        if found != model:
            raise DeviceMismatch(
                f"The servo at id {bus_id} is another model than configured.",
                next_step=f'Set servo.model = "{found}" if this is the right servo, else connect the right one.',
                evidence={"expected": model, "got": found, "model_number": number},
            )
        firmware = bus.read(bus_id, control_table(model)["Firmware Version"])
        self._table: ControlTable = control_table(model, firmware)
        self._identity = ServoIdentity(model, number, bus_id, firmware)
        first, last = self._table["Moving"], self._table["Present Temperature"]
        self._status_address = first.address
        self._status_size = last.address + last.size - first.address
        # Present Current shares the unit of Current Limit, so that their ratio needs no unit of the model.
        self._current_limit = self._read("Current Limit") if "Present Current" in self._table else None
        self._limits = ServoLimits(
            temperature_c=float(self._read("Temperature Limit")),
            voltage_v=(self._read("Min Voltage Limit") * 0.1, self._read("Max Voltage Limit") * 0.1),
        )

    @property
    def identity(self) -> ServoIdentity:
        return self._identity

    @property
    def limits(self) -> ServoLimits:
        return self._limits

    @property
    def resolution_deg(self) -> float:
        return DEG_PER_COUNT

    @property
    def bus(self) -> DynamixelBus:
        return self._bus

    # -- settings -------------------------------------------------------------------------------------------------

    def setting_differences(self) -> list[SettingDifference]:
        """Return the EEPROM settings that stand in the rig's way."""
        drive_mode = self._read("Drive Mode")
        wanted = {
            "Drive Mode": drive_mode & ~_DRIVE_MODE_BITS,
            "Operating Mode": EXTENDED_POSITION_MODE,
            "Homing Offset": 0,
            "Return Delay Time": 0,
        }
        found = {name: self._read(name) for name in wanted}
        return [SettingDifference(n, found[n], wanted[n]) for n in wanted if found[n] != wanted[n]]

    def write_settings(self, differences: list[SettingDifference]) -> None:
        """Write EEPROM settings, with torque off, and read them back."""
        self.torque_off()
        for difference in differences:
            self._write(difference.register, difference.wanted)
            if (now := self._read(difference.register)) != difference.wanted:
                raise DeviceRefused(
                    f"Servo {self._id} did not keep {difference.register}.",
                    next_step="Power-cycle the servo and try again; if it persists, its EEPROM may be worn.",
                    evidence={"wrote": difference.wanted, "read_back": now},
                )

    # -- Servo ----------------------------------------------------------------------------------------------------

    def read_state(self) -> ServoState:
        start_ns = self._clock.now_ns()
        block = self._bus.read_block(self._id, self._status_address, self._status_size)
        time_ns = (start_ns + self._clock.now_ns()) // 2
        return ServoState(
            time_ns=time_ns,
            position_deg=self._field(block, "Present Position") * DEG_PER_COUNT,
            velocity_dps=self._field(block, "Present Velocity") * DPS_PER_UNIT,
            load_percent=self._load_percent(block),
            voltage_v=self._field(block, "Present Input Voltage") * 0.1,
            temperature_c=float(self._field(block, "Present Temperature")),
            moving=bool(self._field(block, "Moving")),
            in_position=bool(self._field(block, "Moving Status") & 1),
            hardware_errors=self._hardware_errors() if self._bus.alert(self._id) else (),
            trajectory_deg=self._field(block, "Position Trajectory") * DEG_PER_COUNT,
        )

    def read_condition(self) -> ServoCondition:
        watchdog = self._read("Bus Watchdog")
        tripped = watchdog == WATCHDOG_TRIPPED
        return ServoCondition(
            torque=bool(self._read("Torque Enable")),
            watchdog_armed=0 < watchdog < WATCHDOG_TRIPPED,
            watchdog_tripped=tripped,
            # The rig's profile is never 0, power-up's is; a watchdog that trips sets it to 0 as well.
            power_lost=not tripped and self._read("Profile Acceleration") == 0,
            hardware_errors=self._hardware_errors(),
        )

    def verify(self) -> None:
        number, firmware = self._bus.ping(self._id), self._read("Firmware Version")
        if (number, firmware) != (self._identity.model_number, self._identity.firmware):
            raise DeviceMismatch(
                f"Another servo answers at id {self._id} than the one that was there.",
                next_step="Connect the servo that belongs to this bench, or start again with the other one.",
                evidence={
                    "expected": f"{self._identity.model}, firmware {self._identity.firmware}",
                    "got": f"{model_numbers().get(number, f'unknown model {number}')}, firmware {firmware}",
                },
            )
        prepare_servo(self, write=False)

    def reboot(self) -> None:
        self._bus.reboot(self._id)
        give_up_ns = self._clock.now_ns() + round(BOOT_ALLOWANCE_S * 1e9)
        while True:
            self._clock.sleep(0.1)
            try:
                self.verify()
            except DeviceSilent:
                if self._clock.now_ns() > give_up_ns:
                    raise
            else:
                return

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        velocity = max(round(profile.velocity_dps / DPS_PER_UNIT), 1)  # 0 would mean: as fast as it can
        acceleration = max(round(profile.acceleration_dps2 / DPS2_PER_UNIT), 1)
        self._write("Profile Acceleration", acceleration)
        self._write("Profile Velocity", velocity)
        return MotionProfile(velocity * DPS_PER_UNIT, acceleration * DPS2_PER_UNIT)

    def torque_on(self) -> None:
        errors = self._hardware_errors()
        if errors:
            raise DeviceFault(
                f"Servo {self._id} reports a hardware error: {', '.join(errors)}.",
                next_step="Remove the cause (jam, heat, supply), then power-cycle the servo.",
                evidence={"hardware_errors": list(errors)},
            )
        self._write("Bus Watchdog", 0)  # tripped, or still armed by a host that was killed
        self._write("Goal Position", self._read("Present Position"))
        self._write("Torque Enable", 1)

    def torque_off(self) -> None:
        self._write("Torque Enable", 0)

    def move_to(self, position_deg: float) -> None:
        self._write("Goal Position", round(position_deg / DEG_PER_COUNT))

    def arm_watchdog(self, timeout_s: float) -> None:
        self._write("Bus Watchdog", watchdog_units(timeout_s))

    def disarm_watchdog(self) -> None:
        self._write("Bus Watchdog", 0)

    def close(self) -> None:
        self._bus.close()

    # -- inside ---------------------------------------------------------------------------------------------------

    def _read(self, name: str) -> int:
        return self._bus.read(self._id, self._table[name])

    def _write(self, name: str, value: int) -> None:
        self._bus.write(self._id, self._table[name], value)

    def _field(self, block: bytes, name: str) -> int:
        register = self._table[name]
        start = register.address - self._status_address
        return register.decode(block[start : start + register.size])

    def _load_percent(self, block: bytes) -> float:
        if self._current_limit is not None:
            return 100.0 * self._field(block, "Present Current") / self._current_limit
        return 0.1 * self._field(block, "Present Load")

    def _hardware_errors(self) -> tuple[str, ...]:
        bits = self._read("Hardware Error Status")
        return tuple(name for bit, name in _HARDWARE_ERRORS.items() if bits >> bit & 1)


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
