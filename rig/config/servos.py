"""The table of Dynamixel models: registers, resolution and units of each, for driver, doctor and simulator.

Registers, counts per revolution and the unit of speed come from the `.model` file in the SDK; `_SERIES` adds what the
files lack. A model is driven only if its row has everything that the driver uses.
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.resources import files
from math import pi
from typing import Any, Final

GROUP = "rig.servos"
"""Entry-point group in which packages name a `DynamixelModel`, or a `rig.devices.servo.ServoDriver`."""
USE_ANOTHER = "Use a servo of the X series, the MX series (2.0), the P series or the PRO series (A)"

_PACKAGE, _FOLDER = "dynamixel_easy_sdk", "control_table"
# Names that differ between the .model files and the e-manual.
_RENAMED = {"Secondary(Shadow) ID": "Secondary ID", "BUS Watchdog": "Bus Watchdog"}
_UNLISTED: Final = {1280: "xw430_t200"}  # e-manual, XW430-T200: the SDK has its file, but not its number

# The registers that the driver uses; also the load: see `DynamixelModel.missing`.
_USED: Final = (
    *("Model Number", "Firmware Version", "ID", "Baud Rate", "Return Delay Time", "Drive Mode", "Operating Mode"),
    *("Secondary ID", "Homing Offset", "Temperature Limit", "Max Voltage Limit", "Min Voltage Limit"),
    *("Velocity Limit", "Max Position Limit", "Min Position Limit", "Shutdown", "Torque Enable"),
    *("Status Return Level", "Hardware Error Status", "Bus Watchdog", "Profile Acceleration", "Profile Velocity"),
    *("Goal Position", "Realtime Tick", "Moving", "Moving Status", "Present Velocity", "Present Position"),
    *("Velocity Trajectory", "Position Trajectory", "Present Input Voltage", "Present Temperature"),
)


@dataclass(frozen=True, slots=True)
class DynamixelModel:
    """A row of the table; angles and rates are those of the servo's own shaft, and 0 is an unknown unit.

    ``name`` is the value of ``servo.model``, ``number`` its Model Number. ``registers`` are address, size and e-manual
    name of each register. ``zero_counts`` is the middle of a revolution. ``extended_counts`` is the largest goal in
    each direction in extended position mode. ``most_units`` limits a speed or an
    acceleration for which the model has no register with a limit. ``dps2_per_unit`` is the unit of
    Profile Acceleration.
    """

    name: str
    number: int
    registers: tuple[tuple[int, int, str], ...]
    deg_per_count: float = 0.0
    zero_counts: int = 0
    extended_counts: int = 0
    most_units: int = 0
    dps_per_unit: float = 0.0
    dps2_per_unit: float = 0.0
    ma_per_unit: float = 0.0
    load_percent_per_unit: float = 0.1
    v_per_unit: float = 0.1
    c_per_unit: float = 1.0

    @property
    def counts_per_revolution(self) -> int:
        return round(360.0 / self.deg_per_count)

    @property
    def ram_start(self) -> int:
        """Address of the first register that is lost without supply."""
        return next(address for address, _, name in self.registers if name == "Torque Enable")

    def missing(self) -> tuple[str, ...]:
        """Return the registers and units that the driver uses and the row lacks."""
        names = {name for _, _, name in self.registers}
        units = {"Goal Position": self.deg_per_count, "speed": self.dps_per_unit, "acceleration": self.dps2_per_unit}
        lacks = [name for name in _USED if name not in names]
        if not self.extended_counts:
            lacks.append("the range of Goal Position in extended position mode")
        if not self.most_units and "Acceleration Limit" not in names:
            lacks.append("Acceleration Limit")
        if "Present Current" in names:
            lacks += [] if "Current Limit" in names else ["Current Limit"]
            units["Present Current"] = self.ma_per_unit
        elif "Present Load" not in names:
            lacks.append("Present Load")
        return *lacks, *(f"the unit of {what}" for what, unit in units.items() if not unit)


_X: Final[dict[str, Any]] = {
    "dps2_per_unit": 214.577 * 6.0 / 60.0,  # 214.577 rev/min²
    "extended_counts": 1_048_575,
    "most_units": 32_767,
}
# e-manual, Profile Acceleration, Goal Position and Current Limit of each series; by beginnings of the names.
_SERIES: Final[dict[tuple[str, ...], dict[str, Any]]] = {
    ("xl330", "xc330"): _X | {"ma_per_unit": 1.0},
    ("mx_",): _X | {"ma_per_unit": 3.36},
    ("x", "2x"): _X | {"ma_per_unit": 2.69},
    ("ph", "pm", "h42", "h54", "m42", "m54"): {
        "dps2_per_unit": 6.0 / 60.0,  # 1 rev/min²
        "extended_counts": 2**31 - 1,
        "ma_per_unit": 1.0,
    },
}


def model_file_exists(name: str) -> bool:
    """Return whether the SDK has a file of this name."""
    return files(_PACKAGE).joinpath(_FOLDER, f"{name}.model").is_file()


@cache
def model_numbers() -> Mapping[int, str]:
    """Return the models of the SDK by their Model Number."""
    listed = {int(number): name.strip().removesuffix(".model") for number, name in _rows("dynamixel", "")}
    return {**listed, **_UNLISTED}


@cache
def known_model(name: str, file: str = "") -> DynamixelModel | None:
    """Return the row of a model of the SDK; None for other names.

    ``file`` is another `.model` file of the same model.
    """
    number = next((number for number, known in model_numbers().items() if known == name), None)
    if number is None:
        return None
    kind = {row[0]: float(row[1]) for row in _rows(file or name, "type info")}
    units = {row[0]: float(row[1]) for row in _rows(file or name, "unit info")}
    zero, low = kind["value_of_zero_radian_position"], kind["value_of_min_radian_position"]
    return DynamixelModel(
        name,
        number,
        tuple((int(row[0]), int(row[1]), _RENAMED.get(row[2], row[2])) for row in _rows(file or name, "control table")),
        # The highest position is not a whole revolution in all files. -min_radian is rounded to eight digits.
        deg_per_count=360.0 / round((zero - low) * 2 * pi / -kind["min_radian"]),
        zero_counts=int(zero),
        # The file has rad/s; the e-manual's unit, in rev/min, has three digits.
        dps_per_unit=round(units["Goal Velocity"] * 30 / pi, 3) * 6.0,
        **next((more for beginnings, more in _SERIES.items() if name.startswith(beginnings)), {}),
    )


def lacks(row: DynamixelModel) -> str:
    """Return what a row lacks; empty if it is complete."""
    missing = row.missing()
    more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
    return f"its row in the table of models lacks {', '.join(missing[:5])}{more}" if missing else ""


def driven(model: str) -> str:
    """Return the value of ``servo.model``; raises ValueError for an unknown model, or one that no driver fits."""
    row = known_model(model)
    if row is not None:
        if reason := lacks(row):
            raise ValueError(f"the rig cannot drive this model: {reason}. {USE_ANOTHER}")
        return model
    points = [point.name for point in entry_points(group=GROUP)]  # only now, because looking them up takes 10 ms
    if model not in points:
        known = [row.name for name in model_numbers().values() if (row := known_model(name)) and not row.missing()]
        name = model.lower().replace("-", "_")  # as on a label, where more may follow: PH54-200-S500-R
        near = [one for one in known if name.startswith(one)] or difflib.get_close_matches(name, [*known, *points], n=1)
        raise ValueError("unknown model" + (f"; did you mean {near[0]}?" if near else "; `rig find` names yours"))
    return model


def _rows(name: str, section: str) -> list[list[str]]:
    """Return the tab-separated rows below ``[section]`` of a file without their heading."""
    text = files(_PACKAGE).joinpath(_FOLDER, f"{name}.model").read_text(encoding="utf-8")
    body = text.partition(f"[{section}]")[2] if section else text
    lines = body.partition("\n[")[0].strip().splitlines()[1:]
    return [line.split("\t") for line in lines if line.strip()]
