"""Base of all Dynamixel servos of the rig: identity, permanent settings, and the gear between servo and table."""

from abc import ABC, abstractmethod
from dataclasses import asdict

from rig.core.clock import Clock
from rig.core.errors import DeviceFault, DeviceMismatch, DeviceNotFound, DeviceSilent, TorqueStaysOn
from rig.core.next_steps import Do
from rig.devices.dynamixel import settings
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.guardian import Guardian
from rig.devices.dynamixel.registers import Block, ControlTable, control_table, model_of, require_driven
from rig.devices.dynamixel.settings import ServoMode, SettingDifference
from rig.devices.servo import MotionProfile, ServoCondition, ServoIdentity, ServoLimits, ServoState

BOOT_ALLOWANCE_S = 3.0
"""How long a servo may be silent after a reboot: some tenths of a second; the e-manual states no number."""

TORQUE_OFF_ATTEMPTS = 3
"""Largest number of attempts to switch the torque off and read it back before it counts as on."""

_HARDWARE_ERRORS = {0: "input voltage", 2: "overheating", 3: "motor encoder", 4: "electrical shock", 5: "overload"}


class RegisterServo(ABC):
    """A servo on a `DynamixelBus`; implements `rig.devices.servo.Servo`.

    Opening only reads, to compare the model with the configured one. Nothing moves, and the torque stays as it is.

    Parameters
    ----------
    bus
        The servo's bus.
    bus_id, model
        The servo's id, and its model as in `model_of`.
    mode
        How the servo is used.
    gear_ratio
        Revolutions of the servo for one revolution of the table. All angles and rates of this class are on the table's
        side of the gear. If the gears reverse the direction, set `table.direction`.
    guardian
        Switches the torque off if this program is killed; None if the servo is simulated in this program.

    Raises
    ------
    DeviceNotFound
        No servo answers at ``bus_id``.
    DeviceMismatch
        Another model answers. The rig may be unable to drive it.
    """

    deg_per_count: float
    """Resolution at the servo's own shaft."""

    def __init__(
        self,
        bus: DynamixelBus,
        *,
        bus_id: int,
        model: str,
        clock: Clock,
        mode: ServoMode = ServoMode.TURNTABLE,
        gear_ratio: float = 1.0,
        guardian: Guardian | None = None,
    ) -> None:
        self.bus = bus
        self._clock = clock
        self._id = bus_id
        self._mode = mode
        self._gear_ratio = gear_ratio
        self._guardian = guardian
        self.resolution_deg = self.deg_per_count / gear_ratio
        self._blocks: dict[tuple[str, str], Block] = {}
        try:
            number = bus.ping(bus_id)
        except DeviceSilent as silent:
            raise DeviceNotFound(
                f"No servo answers at id {bus_id}.",
                next_step="Check the servo's power and cable, and servo.id, servo.baud and servo.model in the "
                "configuration. An AX-12A uses another protocol than the other models.",
                evidence=silent.evidence,
            ) from silent
        found = model_of(number)
        if found != model:
            require_driven(number, bus_id)
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
            temperature_c=float(self._read("Temperature Limit")),
            voltage_v=(self._read("Min Voltage Limit") * 0.1, self._read("Max Voltage Limit") * 0.1),
        )

    @property
    def revolution_deg(self) -> float:
        return 360.0 / self._gear_ratio

    @property
    def bus_statistics(self) -> dict[str, int]:
        return asdict(self.bus.statistics)

    @property
    def remarks(self) -> tuple[str, ...]:
        return ()

    def prepare(self, *, write: bool) -> tuple[str, ...]:
        differences = self.setting_differences()
        if not differences:
            return ()
        if not write:
            raise DeviceMismatch(
                f"{len(differences)} EEPROM settings of the servo differ from what the rig needs.",
                next_step=(Do.SERVO_SETTINGS(), "Or open the bench once with servo.write_settings = true."),
                evidence={d.register: _found_wanted(d) for d in differences},
            )
        self.write_settings(differences)
        return tuple(f"servo: {d.register} was {d.found}, is now {d.wanted}" for d in differences)

    def close(self) -> None:
        self.bus.close()
        if self._guardian:
            self._guardian.close()  # after the port: it needs it if the torque is on

    # -- differences between models ---------------------------------------------------------------------------

    @property
    @abstractmethod
    def reach_deg(self) -> tuple[float, float]: ...
    @abstractmethod
    def read_state(self) -> ServoState: ...
    @abstractmethod
    def read_condition(self) -> ServoCondition: ...
    @abstractmethod
    def set_profile(self, profile: MotionProfile) -> MotionProfile: ...
    @abstractmethod
    def _switch_torque_on(self) -> None: ...
    @abstractmethod
    def arm_watchdog(self, timeout_s: float) -> None: ...
    @abstractmethod
    def disarm_watchdog(self) -> None: ...

    def torque_on(self) -> None:
        self._arm_guardian()
        self._switch_torque_on()

    def torque_off(self) -> None:
        for _ in range(TORQUE_OFF_ATTEMPTS):
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

    # -- settings -------------------------------------------------------------------------------------------------

    def setting_differences(self) -> list[SettingDifference]:
        """Return the EEPROM settings that differ from what the rig needs."""
        return settings.compare(self.bus, self._id, self._table, self._mode)

    def write_settings(self, differences: list[SettingDifference]) -> None:
        """Write EEPROM settings, with torque off, and read them back."""
        settings.write(self.bus, self._id, self._table, differences)

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

    # -- for the models -------------------------------------------------------------------------------------------

    def _arm_guardian(self) -> None:
        if self._guardian:
            self._guardian.arm()

    def _read(self, name: str) -> int:
        return self.bus.read(self._id, self._table[name])

    def _write(self, name: str, value: int) -> None:
        self.bus.write(self._id, self._table[name], value)

    def _reject_errors(self, errors: tuple[str, ...], **evidence: float) -> None:
        """Raise `DeviceFault` if the servo reports hardware errors."""
        if errors:
            raise DeviceFault(
                f"Servo {self._id} reports a hardware error: {', '.join(errors)}.",
                next_step="Remove the cause (jam, heat, supply), then power-cycle the servo.",
                evidence={"hardware_errors": list(errors), **evidence},
            )

    def _read_registers(self, first: str, last: str, *, dated: bool = False) -> tuple[int, dict[str, int]]:
        """Read the registers from ``first`` to ``last`` in one transaction; return its time and the values by name.

        ``dated`` if the registers contain the servo's clock, which the caller checks.
        """
        block = self._blocks.get((first, last))
        if block is None:
            block = self._blocks[first, last] = Block.of(self._table, first, last)
        begun_ns = self._clock.now_ns()
        image = self.bus.read_block(self._id, block.address, block.layout.size, dated=dated)
        ended_ns = self._clock.now_ns()
        return (begun_ns + ended_ns) // 2, block.values(image)


def hardware_errors(bits: int) -> tuple[str, ...]:
    """Return the names of the bits of Hardware Error Status."""
    return tuple(name for bit, name in _HARDWARE_ERRORS.items() if bits >> bit & 1)


def _found_wanted(difference: SettingDifference) -> str:
    because = f": {difference.reason}" if difference.reason else ""
    return f"found {difference.found}, wanted {difference.wanted}{because}"
