"""The differences between servo models as data: initial values, ranges, speed, current.

Source: the e-manual's control tables and specifications of each model. Registers, resolution and units are those of the
model's row in `rig.config.servos`. Each model that the rig drives can be simulated: one without a `ServoModel` has the
limits, speed and current of the model most like it.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from rig.config.servos import DynamixelModel
from rig.devices.dynamixel.registers import model_row

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rates by the value of the register Baud Rate."""

_VOLTAGES = "Min Voltage Limit", "Max Voltage Limit"

VELOCITY_MODE, POSITION_MODE, EXTENDED_POSITION_MODE = 1, 3, 4

GAINS = (
    *("Velocity I Gain", "Velocity P Gain", "Position D Gain", "Position I Gain", "Position P Gain"),
    *("Feedforward 2nd Gain", "Feedforward 1st Gain"),
)

# e-manual, control tables of the X series: what a new servo has, if `_MODELS` says nothing else
_INITIAL = {
    "ID": 1,
    "Baud Rate": 1,
    "Return Delay Time": 250,
    "Drive Mode": 0,
    "Operating Mode": POSITION_MODE,
    "Secondary ID": 255,
    "Protocol Type": 2,
    "Homing Offset": 0,
    "Moving Threshold": 10,
    "PWM Limit": 885,
    "Acceleration Limit": 32_767,
    "Shutdown": 52,
    "Status Return Level": 2,
}

_RANGES: dict[str, Container[int]] = {
    "ID": range(253),
    "Baud Rate": range(len(BAUD_RATES)),
    "Return Delay Time": range(255),
    "Drive Mode": frozenset(bits for bits in range(14) if not bits & ~0b1101),
    # Current and PWM control are not emulated. They are rejected, because nothing would move in them.
    "Operating Mode": frozenset({VELOCITY_MODE, POSITION_MODE, EXTENDED_POSITION_MODE}),
    "Protocol Type": frozenset({2}),
    "Homing Offset": range(-1_044_479, 1_044_480),
    "Moving Threshold": range(1024),
    "Temperature Limit": range(101),
    "Velocity Limit": range(1024),
    "Torque Enable": range(2),
    "LED": range(2),
    "Status Return Level": range(3),
    "Startup Configuration": range(2),  # its bit for restoring RAM is not emulated
    **dict.fromkeys(GAINS, range(16_384)),
    "Bus Watchdog": range(128),
    "Profile Acceleration": range(32_768),
    "Profile Velocity": range(32_768),
}


@dataclass(frozen=True)
class ServoModel:
    """A servo model.

    Attributes
    ----------
    name
        Name of its row in `rig.config.servos`.
    firmware
        Firmware of a new servo.
    initial
        Initial values of registers by name; default: 0.
    ranges
        Valid values of registers by name; default: all that fit.
    supply_v
        Supply voltage, for which the specifications give a speed.
    no_load_dps
        Speed without load at that supply, in °/s: the maximum.
    acceleration_dps2
        Acceleration at stall torque with a light platter, in °/s²: the maximum. It is an estimate (no-load speed within
        about 0.1 s): the e-manual gives the torque, but the inertia depends on the platter.
    stall_error_deg
        Error at which the position controller pushes with the stall torque; X series: PWM Limit over Position P Gain /
        128 (e-manual, Position PID Gain), in counts.
    inertia_s
        Time constant of the speed. With more than a quarter of the lag, which is the ``stall_error_deg`` over the
        maximum speed, the shaft overshoots; 0: the D gain damps it.
    stall_current
        Present Current at stall, in the register's unit; None for models that report Present Load instead.
    """

    name: str
    firmware: int
    initial: Mapping[str, int]
    ranges: Mapping[str, Container[int]]
    supply_v: float
    no_load_dps: float
    acceleration_dps2: float = 3000.0
    stall_error_deg: float = 885 / (640 / 128) * 360 / 4096
    inertia_s: float = 0.0
    stall_current: int | None = field(default=None)


def _model(
    name: str,
    firmware: int,
    *,
    supply_v: float,
    no_load_rpm: float,
    temperature: int,
    voltage: tuple[int, int],
    lowest_voltage: int | None = None,
    velocity: int,
    gains: tuple[int, int, int],
    initial: Mapping[str, int] = MappingProxyType({}),
    ranges: Mapping[str, Container[int]] = MappingProxyType({}),
    stall_current: int | None = None,
    counts: int = 4096,
) -> ServoModel:
    """Return a model with its initial limits, velocity gains (I, P) and Position P Gain; ``ranges`` of other registers.

    The voltage limits range from ``lowest_voltage`` (default: the initial lower limit) to the initial upper limit. The
    limits of PWM, current and acceleration can only be reduced.
    """
    low, high = voltage
    volts = range(low if lowest_voltage is None else lowest_voltage, high + 1)
    own = {"Temperature Limit": temperature, **dict(zip(_VOLTAGES, voltage, strict=True))}
    own |= dict(zip(("Velocity I Gain", "Velocity P Gain", "Position P Gain"), gains, strict=True))
    first = _INITIAL | own | {"Velocity Limit": velocity} | dict(initial)
    falling = (name for name in ("PWM Limit", "Current Limit", "Acceleration Limit") if name in first)
    limits = {name: range(first[name] + 1) for name in falling} | dict.fromkeys(_VOLTAGES, volts)
    return ServoModel(
        name,
        firmware,
        MappingProxyType(first),
        MappingProxyType(_RANGES | limits | dict(ranges)),
        supply_v,
        no_load_rpm * 6.0,
        stall_error_deg=first["PWM Limit"] / (gains[2] / 128) * 360 / counts,
        stall_current=stall_current,
    )


_MODELS = (
    _model(
        "xl430_w250",
        46,
        supply_v=12.0,
        no_load_rpm=61.0,
        temperature=72,
        voltage=(60, 140),
        velocity=265,
        gains=(1000, 100, 640),
        initial={"Position D Gain": 4000},
    ),
    _model(
        "xm430_w350",
        46,
        supply_v=12.0,
        no_load_rpm=46.0,
        temperature=80,
        voltage=(95, 160),
        velocity=200,
        gains=(1920, 100, 800),
        initial={"Current Limit": 1193},
        stall_current=855,
    ),
    _model(
        "xl330_m288",
        52,
        supply_v=5.0,
        no_load_rpm=103.0,
        temperature=70,
        voltage=(35, 70),
        lowest_voltage=31,
        velocity=445,
        gains=(1600, 180, 400),
        initial={"Current Limit": 1750, "PWM Slope": 140, "Shutdown": 53},
        ranges={
            "Baud Rate": range(7),
            "Velocity Limit": range(2048),
            "PWM Slope": range(1, 256),
        },
        stall_current=1470,
    ),
    _model(
        "mx_28",
        43,
        supply_v=12.0,
        no_load_rpm=55.0,
        temperature=80,
        voltage=(95, 160),
        velocity=230,
        gains=(1920, 100, 850),
        ranges={"Drive Mode": frozenset({0, 1, 4, 5})},
    ),
    _model(
        "ph54_200_s500",
        13,  # the e-manual names no firmware
        supply_v=24.0,
        counts=1_003_846,
        no_load_rpm=33.1,
        temperature=80,
        voltage=(150, 350),
        velocity=2900,
        gains=(2209, 6153, 314),
        initial={
            "Moving Threshold": 20,
            "PWM Limit": 2009,
            "Current Limit": 22_740,
            "Acceleration Limit": 3_992_644,
        },
        ranges={
            "Homing Offset": range(-(2**31), 2**31),
            "Moving Threshold": range(2901),
            "Velocity Limit": range(2901),
            **dict.fromkeys(GAINS, range(32_768)),
            "Profile Acceleration": range(3_992_645),
            "Profile Velocity": range(2901),
        },
        stall_current=22_740,
    ),
)
MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _MODELS})


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
