"""Control tables of Dynamixel models: registers by name, values signed.

The rows, with the units of each model, are in `rig.config.servos`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

from rig.config.servos import (
    GROUP,
    USE_ANOTHER,
    DynamixelModel,
    known_model,
    lacks,
    model_file_exists,
    model_numbers,
)
from rig.core.errors import ConfigError, DeviceMismatch
from rig.core.plugins import plugins

# The signed registers of the e-manual's control tables: the .model files mark the sign of few registers.
_SIGNED = frozenset(
    {
        *("Homing Offset", "Max Position Limit", "Min Position Limit", "Goal PWM", "Goal Current", "Goal Velocity"),
        *("Goal Position", "Present PWM", "Present Current", "Present Load", "Present Velocity", "Present Position"),
        *("Velocity Trajectory", "Position Trajectory"),
    }
)
# A register that is missing in the .model files: (address, size, name), and its first firmware by model.
_STARTUP = (60, 1, "Startup Configuration")
_STARTUP_FIRMWARE = {"xl330": 46, "xc330": 46, "x": 45}


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of a control table."""

    name: str
    address: int
    size: int
    signed: bool

    def decode(self, data: bytes) -> int:
        """Return the value of ``data``, little endian."""
        return int.from_bytes(data, "little", signed=self.signed)

    def encode(self, value: int) -> bytes:
        """Return the bytes of ``value`` on the wire; raises OverflowError if it does not fit."""
        return int(value).to_bytes(self.size, "little", signed=self.signed)


class ControlTable(dict[str, Register]):
    """The registers of one model by their e-manual names, and its row.

    Registers below ``ram_start`` are EEPROM: they survive without supply, and are locked while the torque is on.
    """

    def __init__(self, row: DynamixelModel, registers: Iterable[Register]) -> None:
        super().__init__((register.name, register) for register in registers)
        self.row = row
        self.ram_start = row.ram_start

    def decoded(self, start: int, image: bytes) -> dict[str, int]:
        """Return the values of the registers that lie in ``image``, the bytes from address ``start`` on."""
        found = ((r, r.address - start) for r in self.values())
        return {r.name: r.decode(image[at : at + r.size]) for r, at in found if 0 <= at <= len(image) - r.size}


def servo_plugin(model: str) -> Any:
    """Return the object that a package names ``model`` in the group `GROUP`; None for other models.

    Raises `ConfigError`: a package cannot be loaded.
    """
    if known_model(model) is not None:
        return None
    return next((plugged for name, plugged in plugins(GROUP) if name == model), None)


def model_of(number: int) -> str | None:
    """Return the model with this Model Number; None if it is unknown."""
    if (known := model_numbers().get(number)) is not None:
        return known
    rows = (row for _, row in plugins(GROUP) if isinstance(row, DynamixelModel))
    return next((row.name for row in rows if row.number == number), None)


def obstacle(number: int) -> tuple[str, str] | None:
    """Return why the rig cannot drive the servo with this Model Number, and the way out; None if it can."""
    if (model := model_of(number)) is None:
        return f"{number} is the number of no known model", USE_ANOTHER
    row = model_row(model)
    reason = lacks(row) if row else ""
    return (reason, USE_ANOTHER) if reason else None


def require_driven(number: int, bus_id: int) -> None:
    """Raise `DeviceMismatch` if the rig cannot drive the servo with this Model Number."""
    if found := obstacle(number):
        model = model_of(number) or "unknown model"
        raise DeviceMismatch(
            f"The rig cannot drive the servo at id {bus_id} ({model}).",
            next_step=f"{found[1]}.",
            evidence={"got": model, "model_number": number, "reason": found[0]},
        )


def model_row(model: str) -> DynamixelModel | None:
    """Return the row of a Dynamixel model, also of one that a package names; None for other models."""
    row = known_model(model) or servo_plugin(model)
    return row if isinstance(row, DynamixelModel) else None


@cache
def control_table(model: str, firmware: int | None = None) -> ControlTable:
    """Return the control table of ``model`` (e.g. ``"xl430_w250"``), which may change with firmware 52.

    Raises `ConfigError`: the model does not exist, or its row lacks what the driver uses.
    """
    row = model_row(model)
    if row is None or row.missing():
        known = sorted(name for name in model_numbers().values() if (one := known_model(name)) and not one.missing())
        raise ConfigError(
            f"The rig cannot drive a {model}." if row else f"There is no Dynamixel model {model!r}.",
            next_step="Set servo.model to one of the listed models.",
            evidence={**({"missing": list(row.missing())} if row else {}), "models": known},
        )
    if firmware is not None and firmware >= 52 and model_file_exists(f"{model}_fw52"):
        row = known_model(model, f"{model}_fw52") or row
    registers = [Register(name, address, size, name in _SIGNED) for address, size, name in row.registers]
    since = next((version for prefix, version in _STARTUP_FIRMWARE.items() if model.startswith(prefix)), None)
    if firmware is not None and since is not None and firmware >= since:
        address, size, label = _STARTUP
        registers.append(Register(label, address, size, signed=False))
    return ControlTable(row, registers)
