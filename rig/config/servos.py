"""The Dynamixel models that the SDK knows, and which of them the driver fits.

The driver is written for the XL430-W250. It fits the models whose `.model` file has the same counts per revolution,
unit of speed, and registers.
"""

import difflib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from importlib.resources import files
from math import pi

REFERENCE = "xl430_w250"
OWN = "ax_12a"
"""The model that the rig knows without the SDK, which has no file for it."""
GROUP = "rig.servos"
"""Entry-point group in which packages name a `rig.devices.dynamixel.registers.DynamixelModel`, or a
`rig.devices.servo.ServoDriver`."""
USE_ANOTHER = "Use a servo of the X series or the MX series (2.0), or an AX-12A"

_PACKAGE, _FOLDER = "dynamixel_easy_sdk", "control_table"
# Names that differ between the .model files and the e-manual.
_RENAMED = {"Secondary(Shadow) ID": "Secondary ID", "BUS Watchdog": "Bus Watchdog"}
# The driver uses none of these registers, and the models with a Present Current have no Present Load.
_UNUSED = ("LED", "Indirect", "Present Load")


def model_file_exists(name: str) -> bool:
    """Return whether the SDK has a file of this name."""
    return files(_PACKAGE).joinpath(_FOLDER, f"{name}.model").is_file()


def model_registers(name: str) -> dict[str, tuple[int, int]]:
    """Return address and size of each register in a file of the SDK, by the name of the e-manual."""
    return {_RENAMED.get(row[2], row[2]): (int(row[0]), int(row[1])) for row in _rows(name, "control table")}


@cache
def sdk_models() -> Mapping[int, str]:
    """Return the models of the SDK by their Model Number."""
    return {int(number): name.strip().removesuffix(".model") for number, name in _rows("dynamixel", "")}


@cache
def differences(model: str) -> tuple[str, ...]:
    """Return what prevents the driver from driving a model of the SDK; empty if it fits, and for all other names."""
    if model == REFERENCE or model not in sdk_models().values():
        return ()
    found = []
    (least, most), (low_rad, high_rad) = _range(model)
    if _range(model) != _range(REFERENCE):
        counts = round((most - least) / (high_rad - low_rad) * 2 * pi)
        found.append(f"a revolution has {counts} counts instead of 4096")
    if (units_rpm := _speed_units_rpm(model)) != (usual_rpm := _speed_units_rpm(REFERENCE)):
        found.append(f"speeds count in {units_rpm[0]:.3g} rpm instead of {usual_rpm[0]:.3g} rpm")
    registers = model_registers(model)
    needed = {name: at for name, at in model_registers(REFERENCE).items() if not name.startswith(_UNUSED)}
    if "Present Load" not in registers:
        needed |= {"Present Current": model_registers(REFERENCE)["Present Load"], "Current Limit": (38, 2)}
    if elsewhere := sum(registers.get(name) != at for name, at in needed.items()):
        found.append(f"{elsewhere} registers are missing or have another address")
    return tuple(found)


def driven(model: str) -> str:
    """Return the value of ``servo.model``; raises ValueError for an unknown model, or one that no driver fits."""
    models = [OWN, *sdk_models().values()]
    if model not in models:
        models += (point.name for point in entry_points(group=GROUP))  # only now, because looking them up takes 10 ms
    if model not in models:
        near = difflib.get_close_matches(model, [name for name in models if not differences(name)], n=1)
        raise ValueError("unknown model" + (f"; did you mean {near[0]}?" if near else "; `rig find` names yours"))
    if reasons := differences(model):
        raise ValueError(f"the rig cannot drive this model: {'; '.join(reasons)}. {USE_ANOTHER}")
    return model


def _rows(name: str, section: str) -> list[list[str]]:
    """Return the tab-separated rows below ``[section]`` of a file without their heading."""
    text = files(_PACKAGE).joinpath(_FOLDER, f"{name}.model").read_text(encoding="utf-8")
    body = text.partition(f"[{section}]")[2] if section else text
    lines = body.partition("\n[")[0].strip().splitlines()[1:]
    return [line.split("\t") for line in lines if line.strip()]


def _range(model: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the lowest and the highest position of a model, in counts and in radians."""
    values = {row[0]: float(row[1]) for row in _rows(model, "type info")}
    counts = values["value_of_min_radian_position"], values["value_of_max_radian_position"]
    return counts, (values["min_radian"], values["max_radian"])


def _speed_units_rpm(model: str) -> tuple[float, float]:
    """Return the units of Goal Velocity and Present Velocity in revolutions per minute."""
    units = {row[0]: float(row[1]) * 30 / pi for row in _rows(model, "unit info")}
    return units["Goal Velocity"], units["Present Velocity"]
