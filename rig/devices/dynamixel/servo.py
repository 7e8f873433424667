"""A Dynamixel servo of the X or MX (2.0) series."""

from collections.abc import Iterator
from typing import Any

from rig.core.clock import seconds_between
from rig.core.errors import DeviceFault, UsageError
from rig.core.next_steps import Do
from rig.devices.dynamixel import settings
from rig.devices.dynamixel.bus import watchdog_units
from rig.devices.dynamixel.register_servo import RegisterServo, hardware_errors
from rig.devices.dynamixel.settings import ServoMode
from rig.devices.servo import MotionProfile, ServoCondition, ServoState

COUNTS_PER_REVOLUTION = 4096
DEG_PER_COUNT = 360.0 / COUNTS_PER_REVOLUTION
DPS_PER_UNIT = 0.229 * 6.0  # Velocity registers: 0.229 rev/min
DPS2_PER_UNIT = 214.577 * 6.0 / 60.0  # Profile Acceleration: 214.577 rev/min^2
EXTENDED_RANGE_COUNTS = 1_048_575
WATCHDOG_TRIPPED = 0xFF

TICK_MODULUS_MS = 32768
TICK_TOLERANCE_MS, TICK_DRIFT = 20.0, 0.03
"""How much the servo's clock (Realtime Tick) may differ from the computer's between two readings."""
TICK_MEMORY_S = 10.0
"""After a longer pause, two readings must agree with each other instead."""
_FRESH_ATTEMPTS, _RESTARTED = 8, 3

_SPIN_POLL_S, _SPIN_WATCHDOG_S = 0.05, 0.5


class DynamixelServo(RegisterServo):
    """A servo whose registers are those of the X series; see `RegisterServo` for its parameters."""

    deg_per_count = DEG_PER_COUNT

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._dps_per_unit = DPS_PER_UNIT / self._gear_ratio
        self._dps2_per_unit = DPS2_PER_UNIT / self._gear_ratio
        self._tick: tuple[int, int] | None = None  # time and Realtime Tick of the last fresh reading
        self._unconfirmed: list[tuple[int, int]] = []  # readings that agree with each other, but not with it
        # Present Current and Current Limit have the same unit, so their ratio is independent of the model.
        self._current_limit = self._read("Current Limit") if "Present Current" in self._table else None

    @property
    def reach_deg(self) -> tuple[float, float]:
        if self._mode is ServoMode.PAN:
            return 0.0, (COUNTS_PER_REVOLUTION - 1) * self.resolution_deg
        return -EXTENDED_RANGE_COUNTS * self.resolution_deg, EXTENDED_RANGE_COUNTS * self.resolution_deg

    def read_state(self) -> ServoState:
        time_ns, values = self._read_fresh()
        return ServoState(
            time_ns=time_ns,
            sampled_ns=self.bus.sampled_ns,
            position_deg=values["Present Position"] * self.resolution_deg,
            velocity_dps=values["Present Velocity"] * self._dps_per_unit,
            load_percent=self._load_percent(values),
            voltage_v=values["Present Input Voltage"] * 0.1,
            temperature_c=float(values["Present Temperature"]),
            moving=bool(values["Moving"]),
            in_position=bool(values["Moving Status"] & 1),
            hardware_errors=self._hardware_errors() if self.bus.alert(self._id) else (),
            trajectory_deg=values["Position Trajectory"] * self.resolution_deg,
        )

    def read_condition(self) -> ServoCondition:
        _, values = self._read_registers("Torque Enable", "Profile Acceleration")
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

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        velocity = max(round(profile.velocity_dps / self._dps_per_unit), 1)  # 0 means no limit
        acceleration = max(round(profile.acceleration_dps2 / self._dps2_per_unit), 1)
        self._write("Profile Acceleration", acceleration)
        self._write("Profile Velocity", velocity)
        return MotionProfile(velocity * self._dps_per_unit, acceleration * self._dps2_per_unit)

    def _switch_torque_on(self) -> None:
        self._reject_errors(self._hardware_errors())
        # After a killed program the torque may be on: the old goal must not continue when the watchdog is cleared.
        self._write("Torque Enable", 0)
        self._write("Bus Watchdog", 0)
        self._write("Goal Position", self._read("Present Position"))
        self._write("Torque Enable", 1)

    def arm_watchdog(self, timeout_s: float) -> None:
        self._write("Bus Watchdog", watchdog_units(timeout_s))

    def disarm_watchdog(self) -> None:
        self._write("Bus Watchdog", 0)

    def spin(self, velocity_dps: float, seconds: float, acceleration_dps2: float = 240.0) -> Iterator[ServoState]:
        """Rotate at a constant speed for some time; yield about 20 readings per second.

        Only for tables without a cable: `table.limits_deg` is not checked here. The Bus Watchdog is always armed. When
        the generator ends, the torque goes off and the servo returns to its own mode. The change of mode clears the
        count of revolutions, so afterwards the table is not referenced.

        Raises
        ------
        UsageError
            The speed is 0, or above the servo's Velocity Limit.
        DeviceFault, DeviceSilent
            The servo reports a hardware error, or stops answering (its watchdog stops it).
        """
        unit_dps, limit = self._dps_per_unit, self._read("Velocity Limit")
        units = round(velocity_dps / unit_dps)
        if not 0 < abs(units) <= limit:
            raise UsageError(
                f"The servo cannot rotate the table at {velocity_dps:g} °/s.",
                next_step=f"Give {unit_dps:.2f} to {limit * unit_dps:.0f} °/s, in either direction.",
            )
        self._reject_errors(self._hardware_errors())
        self._change_mode(ServoMode.SPIN)
        try:
            self._write("Bus Watchdog", 0)
            self._write("Profile Acceleration", max(round(acceleration_dps2 / self._dps2_per_unit), 1))
            self._arm_guardian()
            self._write("Torque Enable", 1)  # goal velocity is 0 after a change of mode
            self.arm_watchdog(_SPIN_WATCHDOG_S)
            self._write("Goal Velocity", units)
            begun_ns = self._clock.now_ns()
            while seconds_between(begun_ns, self._clock.now_ns()) < seconds:
                self._clock.sleep(_SPIN_POLL_S)
                yield self._checked(self.read_state())
            self._write("Goal Velocity", 0)
            while abs(self._checked(self.read_state()).velocity_dps) > self._dps_per_unit:
                self._clock.sleep(_SPIN_POLL_S)
        finally:
            self.torque_off()
            self._write("Bus Watchdog", 0)
            self._change_mode(self._mode)

    def _read_fresh(self) -> tuple[int, dict[str, int]]:
        """Return time and values of a reading whose age the servo's clock confirms; drop repeated old answers."""
        for _ in range(_FRESH_ATTEMPTS):
            time_ns, values = self._read_registers("Realtime Tick", "Present Temperature", dated=True)
            if self._is_fresh((time_ns, values["Realtime Tick"])):
                return time_ns, values
        raise DeviceFault(
            f"The servo's readings are impossible: {_FRESH_ATTEMPTS} readings in a row do not agree with its clock.",
            next_step=("Check its cable. If this repeats, replace the servo.", Do.ACKNOWLEDGE(reboot=True)),
        )

    def _is_fresh(self, reading: tuple[int, int]) -> bool:
        """Return whether a reading is new: its tick has advanced as the computer's clock has since the last one.

        The clock of a servo that restarted is different: several readings must then agree with each other.
        """
        recent = self._tick is not None and seconds_between(self._tick[0], reading[0]) <= TICK_MEMORY_S
        if not (recent and self._tick is not None and _ticks_agree(self._tick, reading)):
            if not (self._unconfirmed and _ticks_agree(self._unconfirmed[-1], reading)):
                self._unconfirmed.clear()
            self._unconfirmed.append(reading)
            if len(self._unconfirmed) < (_RESTARTED if recent else 2):
                return False
        self._tick = reading
        self._unconfirmed.clear()
        return True

    def _load_percent(self, values: dict[str, int]) -> float:
        if self._current_limit is not None:
            return 100.0 * values["Present Current"] / self._current_limit
        return 0.1 * values["Present Load"]

    def _hardware_errors(self) -> tuple[str, ...]:
        return hardware_errors(self._read("Hardware Error Status"))

    def _checked(self, state: ServoState) -> ServoState:
        volts = round(state.voltage_v, 1)
        self._reject_errors(state.hardware_errors, temperature_c=state.temperature_c, voltage_v=volts)
        return state

    def _change_mode(self, mode: ServoMode) -> None:
        differences = settings.compare(self.bus, self._id, self._table, mode)
        settings.write(self.bus, self._id, self._table, differences)


def _ticks_agree(earlier: tuple[int, int], later: tuple[int, int]) -> bool:
    """Return whether the servo's clock and the computer's advanced equally between two readings."""
    passed_ms = seconds_between(earlier[0], later[0]) * 1e3
    difference_ms = (later[1] - earlier[1] - passed_ms + TICK_MODULUS_MS / 2) % TICK_MODULUS_MS - TICK_MODULUS_MS / 2
    return abs(difference_ms) <= TICK_TOLERANCE_MS + TICK_DRIFT * passed_ms
