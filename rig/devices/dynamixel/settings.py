"""The permanent settings (EEPROM) of a servo: what the rig needs, what differs, and how the difference is written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from rig.core.errors import RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.registers import ControlTable


class ServoMode(StrEnum):
    """What the servo is used for."""

    TURNTABLE = "turntable"
    """Turns without end in both directions, and counts the turns (extended position mode)."""
    PAN = "pan"
    """Stays within one turn (position mode): a camera arm, or a table that swings."""
    SPIN = "spin"
    """Turns at a constant speed (velocity mode), for as long as that is asked for."""


@dataclass(frozen=True, slots=True)
class SettingDifference:
    """A setting that is not as the rig needs it, and why that matters."""

    register: str
    found: int
    wanted: int
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.register}: {self.found} → {self.wanted}" + (f" ({self.reason})" if self.reason else "")


_OPERATING_MODES = {
    ServoMode.TURNTABLE: (4, "extended position: the table turns beyond one revolution"),
    ServoMode.PAN: (3, "position: the arm stays within one revolution"),
    ServoMode.SPIN: (1, "velocity: a constant speed"),
}
_DRIVE_MODE_BITS = 0b1101
"""Drive Mode bits that must be 0: reverse direction, time-based profile, and torque on by goal update."""
_SHUTDOWN = 0b110100
"""Overload, electrical shock and overheating must take the torque away."""
_AX_SHUTDOWN = 0b100100
_RETURN_DELAY = "the answer may come at once; 250 would mean 0.5 ms more a reading"
_ALL_ANSWERED = "every instruction is answered, so that a lost one is noticed"


def wanted(found: Mapping[str, int], mode: ServoMode = ServoMode.TURNTABLE) -> dict[str, tuple[int, str]]:
    """Return the values that the rig needs, each with its reason, by register.

    Parameters
    ----------
    found
        The settings as they are, by register; those that the model lacks are left out.
    mode
        What the servo is used for.
    """
    if "Operating Mode" not in found:
        return _wanted_of_ax(found)
    needs = {
        "Drive Mode": (
            found["Drive Mode"] & ~_DRIVE_MODE_BITS,
            "direction is the rig's (table.direction); velocity-based profile; no torque by a mere goal",
        ),
        "Operating Mode": _OPERATING_MODES[mode],
        "Homing Offset": (
            0,
            "the zero lives in software (table.zero_deg): an offset here can move the servo by itself",
        ),
        "Return Delay Time": (0, _RETURN_DELAY),
        "Secondary ID": (255, "off: the servo would obey instructions to another id"),
        "Startup Configuration": (0, "no torque and no old goal at power-up"),
        "Shutdown": (found["Shutdown"] | _SHUTDOWN, "overload, short circuit and overheating take the torque away"),
        "Status Return Level": (2, _ALL_ANSWERED),
    }
    return {name: need for name, need in needs.items() if name in found}


def _wanted_of_ax(found: Mapping[str, int]) -> dict[str, tuple[int, str]]:
    both_zero = found["CW Angle Limit"] == found["CCW Angle Limit"] == 0
    needs = {
        "Return Delay Time": (0, _RETURN_DELAY),
        "CCW Angle Limit": (1023 if both_zero else found["CCW Angle Limit"], "joint mode: both limits 0 mean a wheel"),
        "Shutdown": (found["Shutdown"] | _AX_SHUTDOWN, "overload and overheating take the torque away"),
        "Status Return Level": (2, _ALL_ANSWERED),
    }
    return {name: need for name, need in needs.items() if name in found}


def read(bus: DynamixelBus, bus_id: int, table: ControlTable) -> dict[str, int]:
    """Return every register that is kept without supply, and the Status Return Level, by name."""
    kept = [register for register in table.values() if register.address < table.ram_start]
    kept += [register for name, register in table.items() if name == "Status Return Level" and register not in kept]
    end = max(register.address + register.size for register in kept)
    image = bus.read_block(bus_id, 0, end)
    return {r.name: r.decode(image[r.address : r.address + r.size]) for r in kept}


def compare(
    bus: DynamixelBus, bus_id: int, table: ControlTable, mode: ServoMode = ServoMode.TURNTABLE
) -> list[SettingDifference]:
    """Return the settings of a servo that stand in the rig's way; writes nothing."""
    found = read(bus, bus_id, table)
    return [
        SettingDifference(name, found[name], value, reason)
        for name, (value, reason) in wanted(found, mode).items()
        if found[name] != value
    ]


def write(bus: DynamixelBus, bus_id: int, table: ControlTable, differences: Sequence[SettingDifference]) -> None:
    """Write settings, with the torque off (a servo refuses them otherwise), and read each back.

    Raises
    ------
    RequestRejected
        The servo did not let go of its torque, refused a value, or did not keep it.
    DeviceSilent
        It stopped answering; what was written so far stays, and a new `compare` tells the rest.
    """
    # A servo that does not answer a write would count as silent: first of all it is told to answer.
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
            f"Servo {bus_id} did not keep {name} = {value}.",
            next_step="Power-cycle the servo and try again; if it persists, its EEPROM may be worn.",
            evidence={"register": name, "wrote": value, "read_back": now},
        )
