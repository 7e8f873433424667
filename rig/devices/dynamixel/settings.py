"""The permanent settings (EEPROM) of a servo: the required values, the differences, and writing them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from rig.core.errors import RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.registers import ControlTable

Mode = Literal["turntable", "pan"]
"""How the servo is used, as `table.mode`."""


@dataclass(frozen=True, slots=True)
class SettingDifference:
    """A setting that differs from the required value, and the reason for that value."""

    register: str
    found: int
    wanted: int
    reason: str

    def __str__(self) -> str:
        return f"{self.register}: {self.found} → {self.wanted} ({self.reason})"


# e-manual, Operating Mode. Velocity, PWM and current modes do not hold an angle.
_OPERATING_MODES: Final = {
    "turntable": (4, "extended position: the table rotates beyond one revolution"),
    "pan": (3, "position: the arm stays within one revolution"),
}
_DRIVE_MODE_BITS = 0b1101
"""Drive Mode bits that must be 0: reverse direction, time-based profile, and torque on by goal update."""
_SHUTDOWN = 0b110100  # e-manual, Shutdown: the factory settings, with the bits of Hardware Error Status
_NEAR = 16  # largest gap over which it is faster to read on: in the P series the RAM begins 448 bytes later


def differing(found: Mapping[str, int], mode: Mode) -> list[SettingDifference]:
    """Return the settings that differ from what the rig needs; ``found`` has the registers of the model only."""
    # What each register must contain, and why.
    needs = {
        "Drive Mode": (
            found["Drive Mode"] & ~_DRIVE_MODE_BITS,
            "the rig sets the direction (table.direction); velocity-based profile; a goal must not switch torque on",
        ),
        "Operating Mode": _OPERATING_MODES[mode],
        "Homing Offset": (0, "the software has the zero (table.zero_deg); an offset here can move the servo"),
        "Return Delay Time": (0, "no delay of replies; the factory setting of 250 costs 0.5 ms per reading"),
        "Secondary ID": (255, "off: else the servo obeys instructions to a second id"),
        "Startup Configuration": (0, "no torque and no old goal at power-up"),
        "Shutdown": (
            found["Shutdown"] | _SHUTDOWN,
            "overload, short circuit and overheating switch the torque off",
        ),
        "Status Return Level": (2, "the servo answers each instruction, so a lost one is noticed"),
    }
    return [
        SettingDifference(name, found[name], value, reason)
        for name, (value, reason) in needs.items()
        if name in found and found[name] != value
    ]


def read(bus: DynamixelBus, bus_id: int, table: ControlTable) -> dict[str, int]:
    """Return the registers that survive without supply and the Status Return Level, and those between, by name."""
    kept = [r for r in table.values() if r.address < table.ram_start and not r.name.startswith("Indirect")]
    level = table["Status Return Level"]
    end = max(register.address + register.size for register in kept)
    if level.address < end + _NEAR:
        return table.decoded(0, bus.read_block(bus_id, 0, max(end, level.address + level.size)))
    return {**table.decoded(0, bus.read_block(bus_id, 0, end)), level.name: bus.read(bus_id, level)}


def compare(bus: DynamixelBus, bus_id: int, table: ControlTable, mode: Mode = "turntable") -> list[SettingDifference]:
    """Return the settings of a servo that differ from what the rig needs; write nothing."""
    return differing(read(bus, bus_id, table), mode)


def write(bus: DynamixelBus, bus_id: int, table: ControlTable, differences: Sequence[SettingDifference]) -> None:
    """Write settings with the torque off (a servo rejects them otherwise), and read each back.

    Raises `RequestRejected`: the servo's torque stays on, or it rejects or loses a value. `DeviceSilent`: the servo
    stops answering; the values written so far stay, and `compare` returns the others.
    """
    # A servo that does not answer writes would count as silent, so the setting that makes it answer comes first.
    ordered = sorted(differences, key=lambda difference: difference.register != "Status Return Level")
    silent = any(difference.register == "Status Return Level" for difference in ordered)
    bus.write(bus_id, table["Torque Enable"], 0, answered=not silent)
    _expect(bus, bus_id, table, "Torque Enable", 0)
    for difference in ordered:
        answered = difference.register != "Status Return Level"
        bus.write(bus_id, table[difference.register], difference.wanted, answered=answered)
        _expect(bus, bus_id, table, difference.register, difference.wanted)


def _expect(bus: DynamixelBus, bus_id: int, table: ControlTable, name: str, value: int) -> None:
    if (now := bus.read(bus_id, table[name])) != value:
        raise RequestRejected(
            f"Servo {bus_id} did not store {name} = {value}.",
            next_step="Power-cycle the servo and try again. If this repeats, its EEPROM may be worn out.",
            evidence={"register": name, "wrote": value, "read_back": now},
        )
