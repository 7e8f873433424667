"""Control tables of Dynamixel models: registers by name, values signed.

The tables for Protocol 2.0 come from the SDK's `.model` files, the one of the AX-12A from its e-manual page.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from struct import Struct
from typing import Any, Self

from rig.config.servos import GROUP, USE_ANOTHER, differences, model_file_exists, model_registers, sdk_models
from rig.core.errors import ConfigError, DeviceMismatch
from rig.core.plugins import plugins

# The signed registers of the e-manual's control tables: the .model files mark the sign of few registers.
_SIGNED = frozenset(
    {
        "Homing Offset",
        "Goal PWM",
        "Goal Current",
        "Goal Velocity",
        "Goal Position",
        "Present PWM",
        "Present Current",
        "Present Load",
        "Present Velocity",
        "Present Position",
        "Velocity Trajectory",
        "Position Trajectory",
    }
)
# A register that is missing in the .model files: (address, size, name), and its first firmware by model.
_STARTUP = (60, 1, "Startup Configuration")
_STARTUP_FIRMWARE = {"xl330": 46, "xc330": 46, "x": 45}


@dataclass(frozen=True, slots=True)
class DynamixelModel:
    """A model that has no `.model` file in the SDK.

    ``name`` is the value of ``servo.model``, ``number`` its Model Number. ``registers`` are address, size and e-manual
    name of each register; the RAM area begins at ``ram_start``.
    """

    name: str
    number: int
    protocol: int
    registers: tuple[tuple[int, int, str], ...]
    ram_start: int = 64


_AX_12A_TABLE = (
    (0, 2, "Model Number"),
    (2, 1, "Firmware Version"),
    (3, 1, "ID"),
    (4, 1, "Baud Rate"),
    (5, 1, "Return Delay Time"),
    (6, 2, "CW Angle Limit"),
    (8, 2, "CCW Angle Limit"),
    (11, 1, "Temperature Limit"),
    (12, 1, "Min Voltage Limit"),
    (13, 1, "Max Voltage Limit"),
    (14, 2, "Max Torque"),
    (16, 1, "Status Return Level"),
    (17, 1, "Alarm LED"),
    (18, 1, "Shutdown"),
    (24, 1, "Torque Enable"),
    (25, 1, "LED"),
    (26, 1, "CW Compliance Margin"),
    (27, 1, "CCW Compliance Margin"),
    (28, 1, "CW Compliance Slope"),
    (29, 1, "CCW Compliance Slope"),
    (30, 2, "Goal Position"),
    (32, 2, "Moving Speed"),
    (34, 2, "Torque Limit"),
    (36, 2, "Present Position"),
    (38, 2, "Present Speed"),
    (40, 2, "Present Load"),
    (42, 1, "Present Voltage"),
    (43, 1, "Present Temperature"),
    (44, 1, "Registered"),
    (46, 1, "Moving"),
    (47, 1, "Lock"),
    (48, 2, "Punch"),
)
"""No value is signed: speed and load have their direction in bit 10."""
# Its table is here because the SDK has no .model file of it.
AX_12A = DynamixelModel("ax_12a", 12, 1, _AX_12A_TABLE, ram_start=24)

_LETTERS = {1: "b", 2: "h", 4: "i"}  # formats of the module struct, signed


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
    """The registers of one model by their e-manual names.

    Registers below ``ram_start`` are EEPROM: they survive without supply, and are locked while the torque is on.
    """

    def __init__(self, model: str, registers: Iterable[Register], ram_start: int = 64) -> None:
        super().__init__((register.name, register) for register in registers)
        self.model = model
        self.ram_start = ram_start


@dataclass(frozen=True, slots=True)
class Block:
    """Adjacent registers that are read in one transaction."""

    address: int
    layout: Struct
    names: tuple[str, ...]

    @classmethod
    def of(cls, table: ControlTable, first: str, last: str) -> Self:
        """Return the registers of ``table`` from ``first`` to ``last``; bytes between them are skipped."""
        start, end = table[first].address, table[last].address + table[last].size
        registers = sorted((r for r in table.values() if start <= r.address < end), key=lambda r: r.address)
        layout, at = "<", start
        for register in registers:
            letter = _LETTERS[register.size]
            layout += f"{register.address - at}x{letter if register.signed else letter.upper()}"
            at = register.address + register.size
        return cls(start, Struct(layout), tuple(register.name for register in registers))

    def values(self, image: bytes) -> dict[str, int]:
        """Return the values in the bytes from `address` on, by register."""
        return dict(zip(self.names, self.layout.unpack(image), strict=True))


@cache
def model_numbers() -> Mapping[int, str]:
    """Return the models of the SDK and the AX-12A by their Model Number."""
    return {**sdk_models(), AX_12A.number: AX_12A.name}


def servo_plugin(model: str) -> Any:
    """Return the object that a package names ``model`` in the group `GROUP`; None for other models.

    Raises `ConfigError`: a package cannot be loaded.
    """
    if model in model_numbers().values():
        return None
    return next((plugged for name, plugged in plugins(GROUP) if name == model), None)


def model_of(number: int) -> str | None:
    """Return the model with this Model Number; None if it is unknown."""
    if (known := model_numbers().get(number)) is not None:
        return known
    rows = (row for _, row in plugins(GROUP) if isinstance(row, DynamixelModel))
    return next((row.name for row in rows if row.number == number), None)


def obstacle(number: int) -> str:
    """Return why the rig cannot drive the servo with this Model Number; empty if it can."""
    model = model_of(number)
    return f"{number} is the number of no known model" if model is None else "; ".join(differences(model))


def require_driven(number: int, bus_id: int) -> None:
    """Raise `DeviceMismatch` if the rig cannot drive the servo with this Model Number."""
    if reason := obstacle(number):
        model = model_of(number) or "unknown model"
        raise DeviceMismatch(
            f"The rig cannot drive the servo at id {bus_id} ({model}).",
            next_step=f"{USE_ANOTHER}.",
            evidence={"got": model, "model_number": number, "reason": reason},
        )


def number_of(model: str) -> int:
    """Return the Model Number of a model."""
    row = _row(model)
    return row.number if row else next(number for number, name in model_numbers().items() if name == model)


def protocol_of(model: str) -> int:
    """Return the protocol version of ``model``: 1 or 2."""
    row = _row(model)
    return row.protocol if row else 2


def _row(model: str) -> DynamixelModel | None:
    row = AX_12A if model == AX_12A.name else servo_plugin(model)
    return row if isinstance(row, DynamixelModel) else None


@cache
def control_table(model: str, firmware: int | None = None) -> ControlTable:
    """Return the control table of ``model`` (e.g. ``"xl430_w250"``), which may change with firmware 52.

    Raises `ConfigError`: the model does not exist, or the driver does not fit it.
    """
    if (row := _row(model)) is not None:
        signed = _SIGNED if row.protocol == 2 else frozenset()
        listed = [Register(name, address, size, name in signed) for address, size, name in row.registers]
        return ControlTable(model, listed, row.ram_start)
    known = sorted(name for name in model_numbers().values() if not differences(name))
    if model not in known:
        reasons = {"reasons": list(differences(model))} if differences(model) else {}
        raise ConfigError(
            f"The rig cannot drive a {model}." if reasons else f"There is no Dynamixel model {model!r}.",
            next_step="Set servo.model to one of the listed models.",
            evidence={**reasons, "models": known},
        )
    name = model
    if firmware is not None and firmware >= 52 and model_file_exists(f"{model}_fw52"):
        name = f"{model}_fw52"
    registers = [
        Register(label, address, size, label in _SIGNED) for label, (address, size) in model_registers(name).items()
    ]
    since = next((version for prefix, version in _STARTUP_FIRMWARE.items() if model.startswith(prefix)), None)
    if firmware is not None and since is not None and firmware >= since:
        address, size, label = _STARTUP
        registers.append(Register(label, address, size, signed=False))
    return ControlTable(model, registers)
