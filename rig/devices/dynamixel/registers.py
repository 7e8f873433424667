"""Control tables of Dynamixel models, from the `.model` files that the SDK ships: registers by name, values signed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from rig.errors import ConfigError

_FOLDER = "control_table"
_PACKAGE = "dynamixel_easy_sdk"

# The .model files mark the sign of few registers; these are the signed ones of the e-manual's control tables.
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
# Names that the .model files do not spell as the e-manual does.
_RENAMED = {"Secondary(Shadow) ID": "Secondary ID", "BUS Watchdog": "Bus Watchdog"}


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
        """Return ``value`` as it goes on the wire; OverflowError where it does not fit."""
        return int(value).to_bytes(self.size, "little", signed=self.signed)


class ControlTable(Mapping[str, Register]):
    """The registers of one model by their e-manual names."""

    def __init__(self, model: str, registers: Mapping[str, Register]) -> None:
        self.model = model
        self._registers = dict(registers)

    def __getitem__(self, name: str) -> Register:
        return self._registers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._registers)

    def __len__(self) -> int:
        return len(self._registers)


def _rows(file_name: str, section: str) -> list[list[str]]:
    """Return the tab-separated rows below ``[section]`` without their heading."""
    text = files(_PACKAGE).joinpath(_FOLDER, file_name).read_text(encoding="utf-8")
    body = text.partition(f"[{section}]")[2] if section else text
    lines = body.partition("\n[")[0].strip().splitlines()[1:]
    return [line.split("\t") for line in lines if line.strip()]


@cache
def model_numbers() -> Mapping[int, str]:
    """Return the models that the SDK has a table for, by their Model Number."""
    return {int(number): name.strip().removesuffix(".model") for number, name in _rows("dynamixel.model", "")}


@cache
def control_table(model: str, firmware: int | None = None) -> ControlTable:
    """Return the control table of ``model`` (e.g. ``"xl430_w250"``); from firmware 52 on some models have another one.

    Raises
    ------
    ConfigError
        The SDK knows no such model.
    """
    known = sorted(model_numbers().values())
    if model not in known:
        raise ConfigError(
            f"There is no Dynamixel model {model!r}.",
            next_step="Set servo.model to one of the models listed.",
            evidence={"models": known},
        )
    name = model
    if firmware is not None and firmware >= 52 and files(_PACKAGE).joinpath(_FOLDER, f"{model}_fw52.model").is_file():
        name = f"{model}_fw52"
    registers = {}
    for address, size, label in _rows(f"{name}.model", "control table"):
        label = _RENAMED.get(label, label)
        registers[label] = Register(label, int(address), int(size), label in _SIGNED)
    return ControlTable(model, registers)
