"""A Dynamixel servo of any model whose row in `rig.config.servos` is complete.

One class drives all of them: resolution, units and registers are those of the row.

Decision: docs/decisions/0007.
"""

from collections.abc import Callable
from dataclasses import asdict
from typing import Final, NamedTuple

from rig.config import ServoConfig
from rig.config.servos import DynamixelModel
from rig.core.clock import Clock, seconds_between
from rig.core.errors import DeviceFault, DeviceMismatch, DeviceNotFound, DeviceSilent, TorqueStaysOn
from rig.core.next_steps import Do
from rig.devices.dynamixel import settings
from rig.devices.dynamixel.bus import DynamixelBus, watchdog_units
from rig.devices.dynamixel.guardian import Guardian
from rig.devices.dynamixel.port import ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import ControlTable, control_table, model_of, require_driven, servo_plugin
from rig.devices.dynamixel.settings import Mode, SettingDifference
from rig.devices.servo import MotionProfile, Servo, ServoCondition, ServoIdentity, ServoLimits, ServoState

BOOT_ALLOWANCE_S = 3.0
"""How long a servo may be silent after a reboot: some tenths of a second; the e-manual states no number."""
TORQUE_OFF_ATTEMPTS = 3
"""Largest number of attempts to switch the torque off and read it back before it counts as on."""

WATCHDOG_TRIPPED = 0xFF  # e-manual, Bus Watchdog: reads as −1; goals are read-only until 0 is written

TICK_MODULUS_MS = 32768  # e-manual, Realtime Tick: wraps after 32,767 ms
TICK_TOLERANCE_MS, TICK_DRIFT = 20.0, 0.03
"""How much the servo's clock (Realtime Tick) may differ from the computer's between two readings, besides what is not
known about when it was read."""
TICK_MEMORY_S = 10.0  # the tick wraps after 33 s, and both clocks drift
"""After a longer pause, two readings must agree with each other instead."""
_FRESH_ATTEMPTS, _RESTARTED = 8, 3

# e-manual, Hardware Error Status: by bit
_HARDWARE_ERRORS = {
    0: "input voltage",
    1: "motor hall sensor",
    2: "overheating",
    3: "motor encoder",
    4: "electrical shock",
    5: "overload",
}
_STATE: Final = "Realtime Tick", "Present Temperature"
_CONDITION: Final = "Torque Enable", "Profile Acceleration"
"""First and last register of the blocks that `DynamixelServo.read_state` and `DynamixelServo.read_condition` read."""


class DynamixelServo:
    """A servo on a `DynamixelBus`; implements `rig.devices.servo.Servo`.

    Opening only reads, to compare the model with the configured one. Nothing moves, and the torque stays as it is.

    ``model`` is as in `model_of`, ``gear_ratio`` the revolutions of the servo for one revolution of the table. All
    angles and rates of this class are on the table's side of the gear; if it reverses the direction, set
    `table.direction`. ``guardian`` is None if the servo is simulated in this program.

    Raises `DeviceNotFound`: no servo answers at ``bus_id``. `DeviceMismatch`: another model answers. The rig may be
    unable to drive it.
    """

    def __init__(
        self,
        bus: DynamixelBus,
        *,
        bus_id: int,
        model: str,
        clock: Clock,
        mode: Mode = "turntable",
        gear_ratio: float = 1.0,
        guardian: Guardian | None = None,
    ) -> None:
        self.bus = bus
        row = self._row = control_table(model).row
        self._clock = clock
        self._id = bus_id
        self._mode = mode
        self._guardian = guardian
        self.resolution_deg = row.deg_per_count / gear_ratio
        self.revolution_deg = 360.0 / gear_ratio
        self._dps_per_unit = row.dps_per_unit / gear_ratio
        self._dps2_per_unit = row.dps2_per_unit / gear_ratio
        self._kept: dict[str, int] = {}  # the permanent settings
        self._tick: _Tick | None = None  # of the last fresh reading
        self._unconfirmed: list[_Tick] = []  # of readings that agree with each other, but not with it

        # Compare the model, then read what its control table depends on.
        try:
            number = bus.ping(bus_id)
        except DeviceSilent as silent:
            raise DeviceNotFound(
                f"No servo answers at id {bus_id}.",
                next_step=(
                    "Check the servo's power and cable, and servo.id, servo.baud and servo.model in the configuration. "
                    "The rig does not speak the protocol of an AX-12A, nor that of an MX-28, MX-64 or MX-106 with the "
                    "firmware of the factory.",
                    Do.FIND(),
                ),
                evidence=silent.evidence,
            ) from silent
        require_driven(number, bus_id)
        if (found := model_of(number)) != model:
            raise DeviceMismatch(
                f"The servo at id {bus_id} is not the configured model.",
                next_step=(
                    "If this is the right servo,",
                    Do.SET_KEY(key="servo.model", value=found),
                    "Otherwise connect the right one.",
                ),
                evidence={"expected": model, "got": found, "model_number": number},
            )
        try:
            firmware = bus.read(bus_id, control_table(model)["Firmware Version"])
        except DeviceSilent as silent:
            silent.add_note("It answers a ping but no read: its Status Return Level is 0, or the bus has errors.")
            raise
        self._table: ControlTable = control_table(model, firmware)
        self.identity = ServoIdentity(model, number, bus_id, firmware)
        self.limits = ServoLimits(
            temperature_c=self._read("Temperature Limit") * row.c_per_unit,
            voltage_v=(
                self._read("Min Voltage Limit") * row.v_per_unit,
                self._read("Max Voltage Limit") * row.v_per_unit,
            ),
        )
        # Present Current and Current Limit have the same unit, so their ratio is independent of the model.
        self._current_limit = self._read("Current Limit") if "Present Current" in self._table else None

    @property
    def reach_deg(self) -> tuple[float, float]:
        if self._mode == "turntable":
            high_deg = self._row.extended_counts * self.resolution_deg
            return -high_deg, high_deg
        low, high = (
            self._kept_settings()[name] * self.resolution_deg for name in ("Min Position Limit", "Max Position Limit")
        )
        return low, high

    @property
    def profile_units(self) -> MotionProfile:
        return MotionProfile(self._dps_per_unit, self._dps2_per_unit)

    @property
    def bus_statistics(self) -> dict[str, int]:
        return asdict(self.bus.statistics)

    def read_table(self) -> dict[str, int]:
        """Return every register by name."""
        return self.bus.read_table(self._id, self._table)

    # -- permanent settings -------------------------------------------------------------------------------------------

    def prepare(self, *, write: bool) -> tuple[str, ...]:
        differences = self.setting_differences()
        if not differences:
            return ()
        if not write:
            raise DeviceMismatch(
                f"{len(differences)} EEPROM settings of the servo differ from what the rig needs.",
                next_step=(Do.SERVO_SETTINGS(), "Or open the bench once with servo.write_settings = true."),
                evidence={d.register: f"found {d.found}, wanted {d.wanted}: {d.reason}" for d in differences},
            )
        settings.write(self.bus, self._id, self._table, differences)
        self._kept |= {d.register: d.wanted for d in differences}
        return tuple(f"servo set up for the rig: {d.reason} ({d.register} {d.found} → {d.wanted})" for d in differences)

    def setting_differences(self) -> list[SettingDifference]:
        """Return the EEPROM settings that differ from what the rig needs."""
        self._kept = settings.read(self.bus, self._id, self._table)
        return settings.differing(self._kept, self._mode)

    def _kept_settings(self) -> dict[str, int]:
        """Return the permanent settings as last read by `setting_differences`."""
        self._kept = self._kept or settings.read(self.bus, self._id, self._table)
        return self._kept

    # -- readings -----------------------------------------------------------------------------------------------------

    def read_state(self) -> ServoState:
        time_ns, values = self._read_fresh()
        if self._current_limit is not None:
            load_percent = 100.0 * values["Present Current"] / self._current_limit
        else:
            load_percent = self._row.load_percent_per_unit * values["Present Load"]
        return ServoState(
            time_ns=time_ns,
            sampled_ns=self.bus.sampled_ns,
            position_deg=values["Present Position"] * self.resolution_deg,
            velocity_dps=values["Present Velocity"] * self._dps_per_unit,
            load_percent=load_percent,
            voltage_v=values["Present Input Voltage"] * self._row.v_per_unit,
            temperature_c=values["Present Temperature"] * self._row.c_per_unit,
            moving=bool(values["Moving"]),
            in_position=bool(values["Moving Status"] & 1),
            hardware_errors=self._hardware_errors() if self.bus.alert(self._id) else (),
            trajectory_deg=values["Position Trajectory"] * self.resolution_deg,
            trajectory_dps=values["Velocity Trajectory"] * self._dps_per_unit,
        )

    def read_condition(self) -> ServoCondition:
        values = self._read_block(*_CONDITION)
        watchdog = values["Bus Watchdog"]
        tripped = watchdog == WATCHDOG_TRIPPED
        return ServoCondition(
            torque=bool(values["Torque Enable"]),
            watchdog_armed=0 < watchdog < WATCHDOG_TRIPPED,
            watchdog_tripped=tripped,
            # The rig's profile is never 0. The register is 0 after power-up, and after the watchdog has tripped.
            power_lost=not tripped and values["Profile Acceleration"] == 0,
            hardware_errors=hardware_errors(values["Hardware Error Status"]),
        )

    def verify(self) -> None:
        self.bus.port.reconnect()
        number, firmware = self.bus.ping(self._id), self._read("Firmware Version")
        if (number, firmware) != (self.identity.model_number, self.identity.firmware):
            raise DeviceMismatch(
                f"The servo that now answers at id {self._id} is a different one.",
                next_step="Connect the bench's servo again, or start again with the new one.",
                evidence={
                    "expected": f"{self.identity.model}, firmware {self.identity.firmware}",
                    "got": f"{model_of(number) or f'unknown model {number}'}, firmware {firmware}",
                },
            )
        self.prepare(write=False)

    def reboot(self) -> None:
        self.bus.reboot(self._id)
        deadline_ns = self._clock.now_ns() + round(BOOT_ALLOWANCE_S * 1e9)
        while True:
            self._clock.sleep(0.1)
            try:
                self.verify()
            except DeviceSilent:
                if self._clock.now_ns() > deadline_ns:
                    raise
            else:
                return

    # -- motion -------------------------------------------------------------------------------------------------------

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        limits, most = self._kept_settings(), self._row.most_units
        velocity = min(round(profile.velocity_dps / self._dps_per_unit), limits.get("Velocity Limit", most))
        velocity = max(velocity, 1)  # 0: no limit
        acceleration = round(profile.acceleration_dps2 / self._dps2_per_unit)
        acceleration = max(min(acceleration, limits.get("Acceleration Limit", most)), 1)
        self._write("Profile Acceleration", acceleration)
        self._write("Profile Velocity", velocity)
        return MotionProfile(velocity * self._dps_per_unit, acceleration * self._dps2_per_unit)

    def torque_on(self) -> None:
        if self._guardian:
            self._guardian.arm()  # here, so that no command can forget it
        errors = self._hardware_errors()
        if errors:
            raise DeviceFault(
                f"Servo {self._id} reports a hardware error: {', '.join(errors)}.",
                next_step="Remove the cause (jam, heat, supply), then power-cycle the servo.",
                evidence={"hardware_errors": list(errors)},
            )
        # After a killed program the torque may be on: the old goal must not continue when the watchdog is cleared.
        self._write("Torque Enable", 0)
        self._write("Bus Watchdog", 0)
        self._write("Goal Position", self._read("Present Position"))
        self._write("Torque Enable", 1)

    def torque_off(self) -> None:
        for _ in range(TORQUE_OFF_ATTEMPTS):  # read back, because the reply to an earlier write may hide a lost one
            self._write("Torque Enable", 0)
            if not self._read("Torque Enable"):
                if self._guardian:
                    self._guardian.disarm()
                return
        raise TorqueStaysOn(
            f"Servo {self._id} accepts the instruction to switch its torque off, but its torque stays on.",
            next_step=("Switch off the servo's supply. If this repeats, replace the servo.", Do.ACKNOWLEDGE()),
            evidence={"attempts": TORQUE_OFF_ATTEMPTS},
        )

    def move_to(self, position_deg: float) -> None:
        self._write("Goal Position", round(position_deg / self.resolution_deg))

    def arm_watchdog(self, timeout_s: float) -> None:
        self._write("Bus Watchdog", watchdog_units(timeout_s))

    def disarm_watchdog(self) -> None:
        self._write("Bus Watchdog", 0)

    def close(self) -> None:
        self.bus.close()
        if self._guardian:
            self._guardian.close()  # after the port: it needs it if the torque is on

    # -- registers ----------------------------------------------------------------------------------------------------

    def _read(self, name: str) -> int:
        return self.bus.read(self._id, self._table[name])

    def _write(self, name: str, value: int) -> None:
        self.bus.write(self._id, self._table[name], value)

    def _hardware_errors(self) -> tuple[str, ...]:
        return hardware_errors(self._read("Hardware Error Status"))

    def _read_block(self, first: str, last: str, *, dated: bool = False) -> dict[str, int]:
        """Read the registers from ``first`` to ``last`` in one transaction; return their values by name.

        ``dated`` if the registers contain the servo's clock, which the caller checks.
        """
        start, end = self._table[first].address, self._table[last].address + self._table[last].size
        return self._table.decoded(start, self.bus.read_block(self._id, start, end - start, dated=dated))

    def _read_fresh(self) -> tuple[int, dict[str, int]]:
        """Return time and values of a reading whose age the servo's clock confirms; drop repeated old answers."""
        for _ in range(_FRESH_ATTEMPTS):
            values = self._read_block(*_STATE, dated=True)
            # Attempts before the answered one say nothing about when the servo read its clock.
            tick = _Tick.between(self.bus.asked_ns, self._clock.now_ns(), values["Realtime Tick"])
            if self._is_fresh(tick):
                self._tick = tick.dated(self._tick)
                self._unconfirmed.clear()
                return self._tick.time_ns, values
        raise DeviceFault(
            f"The servo's readings are impossible: {_FRESH_ATTEMPTS} readings in a row do not agree with its clock.",
            next_step=("Check its cable. If this repeats, replace the servo.", Do.ACKNOWLEDGE(reboot=True)),
        )

    def _is_fresh(self, tick: "_Tick") -> bool:
        """Return whether a reading is new: its tick has advanced as the computer's clock has since the last one.

        The clock of a servo that restarted is different: several readings must then agree with each other.
        """
        if tick.agrees(self._tick):
            return True
        if not (self._unconfirmed and tick.agrees(self._unconfirmed[-1])):
            self._unconfirmed.clear()
        self._unconfirmed.append(tick)
        return len(self._unconfirmed) >= (_RESTARTED if tick.is_recent(self._tick) else 2)


class _Tick(NamedTuple):
    """The servo's clock in a reading: ``tick_ms`` was read at ``time_ns``, ``doubt_ms`` earlier or later."""

    time_ns: int
    doubt_ms: float
    tick_ms: int

    @classmethod
    def between(cls, asked_ns: int, answered_ns: int, tick_ms: int) -> "_Tick":
        return cls((asked_ns + answered_ns) // 2, seconds_between(asked_ns, answered_ns) * 500, tick_ms)

    def is_recent(self, earlier: "_Tick | None") -> bool:
        return earlier is not None and seconds_between(earlier.time_ns, self.time_ns) <= TICK_MEMORY_S

    def agrees(self, earlier: "_Tick | None") -> bool:
        """Return whether the servo's clock and the computer's advanced equally since an earlier, recent reading."""
        if earlier is None or not self.is_recent(earlier):
            return False
        shift_ms, doubt_ms = self._shift_ms(earlier)
        return abs(shift_ms) <= TICK_TOLERANCE_MS + doubt_ms + self.doubt_ms

    def dated(self, earlier: "_Tick | None") -> "_Tick":
        """Return the reading with a better time, by an earlier one, if the answer took long: the computer is busy."""
        if earlier is None or self.doubt_ms <= TICK_TOLERANCE_MS or not self.agrees(earlier):
            return self
        shift_ms, doubt_ms = self._shift_ms(earlier)
        if doubt_ms >= self.doubt_ms:
            return self
        moved_ms = min(max(shift_ms, -self.doubt_ms), self.doubt_ms)
        return self._replace(time_ns=self.time_ns + round(moved_ms * 1e6), doubt_ms=doubt_ms)

    def _shift_ms(self, earlier: "_Tick") -> tuple[float, float]:
        """Return how much later than `time_ns` the clock was read, by an earlier reading; and the doubt of that."""
        passed_ms = seconds_between(earlier.time_ns, self.time_ns) * 1e3
        ahead_ms = self.tick_ms - earlier.tick_ms - passed_ms
        wrapped_ms = (ahead_ms + TICK_MODULUS_MS / 2) % TICK_MODULUS_MS - TICK_MODULUS_MS / 2
        return wrapped_ms, earlier.doubt_ms + TICK_DRIFT * passed_ms


def hardware_errors(bits: int) -> tuple[str, ...]:
    """Return the names of the bits of Hardware Error Status."""
    return tuple(name for bit, name in _HARDWARE_ERRORS.items() if bits >> bit & 1)


def open_servo(
    connection: SerialConnection,
    config: ServoConfig,
    clock: Clock,
    mode: Mode = "turntable",
    reopen: Callable[[], SerialConnection] | None = None,
    guardian: Guardian | None = None,
) -> Servo:
    """Return the configured servo on ``connection``, for ``mode`` (`table.mode`); write nothing.

    ``reopen`` opens the connection again after its adapter was unplugged. ``guardian`` switches the torque off if this
    program is killed.

    Raises `ConfigError`: the model does not exist. `DeviceNotFound`, `DeviceMismatch`, `DeviceSilent`: no servo
    answers, another model answers, or the servo stops answering.
    """
    driver = servo_plugin(config.model)
    if driver is not None and not isinstance(driver, DynamixelModel):
        opened: Servo = driver(connection, config, clock, mode=mode, reopen=reopen)
        return opened
    return DynamixelServo(
        DynamixelBus(ClockedPort(connection, clock, config.port, reopen), config.retries),
        bus_id=config.id,
        model=config.model,
        clock=clock,
        mode=mode,
        gear_ratio=config.gear_ratio,
        guardian=guardian,
    )
