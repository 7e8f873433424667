"""The differences between servo models as data: initial values, ranges, speed, current.

Source: the e-manual's control tables and specifications of each model. For another X-series or MX (2.0) model, add a
`ServoModel`; its register addresses come from the SDK's `.model` file.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from rig.core.plugins import plugins

GROUP = "rig.simulated_servos"

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rates by the value of the register Baud Rate."""

COUNTS_PER_REVOLUTION = 4096
DEG_PER_COUNT = 360.0 / COUNTS_PER_REVOLUTION
DPS_PER_UNIT = 0.229 * 6.0  # velocity registers count in 0.229 rev/min
DPS2_PER_UNIT = 214.577 * 6.0 / 60.0  # profile Acceleration counts in 214.577 rev/min²
PWM_FULL = 885  # goal and Present PWM at 100 %

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
    "PWM Limit": PWM_FULL,
    "Max Position Limit": COUNTS_PER_REVOLUTION - 1,
    "Min Position Limit": 0,
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
    "PWM Limit": range(PWM_FULL + 1),
    "Velocity Limit": range(1024),
    "Max Position Limit": range(COUNTS_PER_REVOLUTION),
    "Min Position Limit": range(COUNTS_PER_REVOLUTION),
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
        Name of its `.model` file, which contains the registers.
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
) -> ServoModel:
    """Return a model with its initial limits, velocity gains (I, P) and Position P Gain; ``ranges`` of other registers.

    The voltage limits range from ``lowest_voltage`` (default: the initial lower limit) to the initial upper limit.
    """
    low, high = voltage
    volts = range(low if lowest_voltage is None else lowest_voltage, high + 1)
    own = {"Temperature Limit": temperature, "Min Voltage Limit": low, "Max Voltage Limit": high}
    own |= dict(zip(("Velocity I Gain", "Velocity P Gain", "Position P Gain"), gains, strict=True))
    return ServoModel(
        name,
        firmware,
        MappingProxyType(_INITIAL | own | {"Velocity Limit": velocity} | dict(initial)),
        MappingProxyType(_RANGES | {"Max Voltage Limit": volts, "Min Voltage Limit": volts} | dict(ranges)),
        supply_v,
        no_load_rpm * 6.0,
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
        ranges={"Current Limit": range(1194)},
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
            "Current Limit": range(1751),
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
        initial={"Acceleration Limit": 32_767},
        ranges={"Drive Mode": frozenset({0, 1, 4, 5}), "Acceleration Limit": range(32_768)},
    ),
)
MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _MODELS})


def servo_model(name: str) -> ServoModel:
    """Return the simulated model of that name, which a package may add by an entry point of the group `GROUP`.

    Raises
    ------
    ValueError
        There is none.
    """
    model = MODELS.get(name) or dict(plugins(GROUP)).get(name)
    if model is None:
        raise ValueError(f"no simulated servo {name!r}: choose one of {', '.join(MODELS)}")
    return model
