"""The differences between servo models: the table ``models.toml``.

Registers, resolution and units are those of the model's row in `rig.config.servos`. Each model that the rig drives can
be simulated: one that is not in the table has the limits, speed and current of the model most like it.
"""

import tomllib
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

from rig.config.servos import DynamixelModel
from rig.devices.dynamixel.registers import model_row

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rates by the value of the register Baud Rate."""

VELOCITY_MODE, POSITION_MODE, EXTENDED_POSITION_MODE = 1, 3, 4

GAINS = (
    *("Velocity I Gain", "Velocity P Gain", "Position D Gain", "Position I Gain", "Position P Gain"),
    *("Feedforward 2nd Gain", "Feedforward 1st Gain"),
)


@dataclass(frozen=True)
class ServoModel:
    """A servo model."""

    name: str
    """Name of its row in `rig.config.servos`."""
    firmware: int
    """Firmware of a new servo."""
    initial: Mapping[str, int]
    """Initial values of registers by name; default: 0."""
    ranges: Mapping[str, Container[int]]
    """Valid values of registers by name; default: all that fit."""
    supply_v: float
    """Supply voltage, for which the specifications give a speed."""
    no_load_dps: float
    """Speed without load at that supply, in °/s: the maximum."""
    acceleration_dps2: float = 3000.0
    """Acceleration at stall torque with a light platter, in °/s²: the maximum. It is an estimate (no-load speed within
    about 0.1 s): the e-manual gives the torque, but the inertia depends on the platter."""
    stall_error_deg: float = 885 / (640 / 128) * 360 / 4096
    """Error at which the position controller pushes with the stall torque; X series: PWM Limit over Position P Gain /
    128 (e-manual, Position PID Gain), in counts."""
    inertia_s: float = 0.0
    """Time constant of the speed. With more than a quarter of the lag, which is the ``stall_error_deg`` over the
    maximum speed, the shaft overshoots; 0: the D gain damps it."""
    stall_current: int | None = None
    """Present Current at stall, in the register's unit; None for models that report Present Load instead."""


def _read() -> dict[str, ServoModel]:
    tables = tomllib.loads(files("sim.servo").joinpath("models.toml").read_text("utf-8"))
    every = tables.pop("every")
    return {name: _model(name, every, own) for name, own in tables.items()}


def _model(name: str, every: Mapping[str, Any], own: Mapping[str, Any]) -> ServoModel:
    initial: dict[str, int] = every["initial"] | own["initial"]
    falling = (limit for limit in ("PWM Limit", "Current Limit", "Acceleration Limit") if limit in initial)
    limits: dict[str, Container[int]] = {limit: range(initial[limit] + 1) for limit in falling}
    volts = range(initial["Min Voltage Limit"], initial["Max Voltage Limit"] + 1)
    limits |= dict.fromkeys(("Min Voltage Limit", "Max Voltage Limit"), volts)
    return ServoModel(
        name,
        own["firmware"],
        initial,
        _allowed(every) | limits | _allowed(own),
        own["supply_v"],
        own["no_load_rpm"] * 6.0,
        stall_error_deg=initial["PWM Limit"]
        / (initial["Position P Gain"] / 128)
        * 360
        / own.get("counts_per_revolution", 4096),
        stall_current=own.get("stall_current"),
    )


def _allowed(table: Mapping[str, Any]) -> dict[str, Container[int]]:
    ranges = {name: range(low, high + 1) for name, (low, high) in table.get("ranges", {}).items()}
    return ranges | {name: frozenset(values) for name, values in table.get("choices", {}).items()}


MODELS: Mapping[str, ServoModel] = _read()


def servo_model(name: str) -> ServoModel:
    """Return the simulated model of that name. Raises `ValueError`: there is none."""
    if name in MODELS:
        return MODELS[name]
    row = model_row(name)
    if row is None or row.missing():
        raise ValueError(f"no simulated servo {name!r}: choose one of {', '.join(MODELS)}")
    return replace(MODELS[_relative(row)], name=name)


def _relative(row: DynamixelModel) -> str:
    """Return the simulated model that is most like another one."""
    if row.counts_per_revolution > 4096:
        return "ph54_200_s500"
    if row.name.startswith(("xl330", "xc330")):
        return "xl330_m288"
    return "xm430_w350" if any(name == "Present Current" for _, _, name in row.registers) else "xl430_w250"
