"""The differences between servo models as data: initial values, ranges, speed, current.

Source: the e-manual's control tables and specifications of each model. A further X-series or MX (2.0) model is one more
`ServoModel`; its register addresses come from the SDK's `.model` file.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Baud rates by the value of the register Baud Rate."""

COUNTS_PER_TURN = 4096
DEG_PER_COUNT = 360.0 / COUNTS_PER_TURN
DPS_PER_UNIT = 0.229 * 6.0
"""Velocity registers count in 0.229 rev/min."""
DPS2_PER_UNIT = 214.577 * 6.0 / 60.0
"""Profile Acceleration counts in 214.577 rev/min²."""
PWM_FULL = 885
"""Goal and Present PWM at 100 %."""

VELOCITY_MODE, POSITION_MODE, EXTENDED_POSITION_MODE = 1, 3, 4

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
    "Max Position Limit": COUNTS_PER_TURN - 1,
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
    "Max Position Limit": range(COUNTS_PER_TURN),
    "Min Position Limit": range(COUNTS_PER_TURN),
    "Torque Enable": range(2),
    "LED": range(2),
    "Status Return Level": range(3),
    "Startup Configuration": range(2),  # its bit for restoring RAM is not emulated
    "Velocity I Gain": range(16_384),
    "Velocity P Gain": range(16_384),
    "Position D Gain": range(16_384),
    "Position I Gain": range(16_384),
    "Position P Gain": range(16_384),
    "Feedforward 2nd Gain": range(16_384),
    "Feedforward 1st Gain": range(16_384),
    "Bus Watchdog": range(128),
    "Profile Acceleration": range(32_768),
    "Profile Velocity": range(32_768),
}


@dataclass(frozen=True)
class ServoModel:
    """One model.

    Attributes
    ----------
    name
        Name of its `.model` file, which gives the registers.
    firmware
        Firmware of a new one.
    initial
        Initial values of registers by name; those not named start at 0.
    ranges
        Values that a register takes; a register not named takes all that fit.
    supply_v
        Supply that it runs from, one for which the specifications give a speed.
    no_load_dps
        Speed without load at that supply, in °/s: the fastest that the shaft turns.
    acceleration_dps2
        Acceleration at stall torque, in °/s², with a light platter: the steepest ramp. An estimate (no-load speed
        within about 0.1 s): the e-manual gives the torque, but the inertia is the user's.
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
    initial: dict[str, int],
    ranges: dict[str, Container[int]],
    *,
    supply_v: float,
    no_load_rpm: float,
    stall_current: int | None = None,
) -> ServoModel:
    return ServoModel(
        name,
        firmware,
        MappingProxyType(_INITIAL | initial),
        MappingProxyType(_RANGES | ranges),
        supply_v,
        no_load_rpm * 6.0,
        stall_current=stall_current,
    )


MODELS: Mapping[str, ServoModel] = MappingProxyType(
    {
        model.name: model
        for model in (
            _model(
                "xl430_w250",
                46,
                {
                    "Temperature Limit": 72,
                    "Max Voltage Limit": 140,
                    "Min Voltage Limit": 60,
                    "Velocity Limit": 265,
                    "Velocity I Gain": 1000,
                    "Velocity P Gain": 100,
                    "Position D Gain": 4000,
                    "Position P Gain": 640,
                },
                {"Max Voltage Limit": range(60, 141), "Min Voltage Limit": range(60, 141)},
                supply_v=12.0,
                no_load_rpm=61.0,
            ),
            _model(
                "xm430_w350",
                46,
                {
                    "Temperature Limit": 80,
                    "Max Voltage Limit": 160,
                    "Min Voltage Limit": 95,
                    "Current Limit": 1193,
                    "Velocity Limit": 200,
                    "Velocity I Gain": 1920,
                    "Velocity P Gain": 100,
                    "Position P Gain": 800,
                },
                {
                    "Max Voltage Limit": range(95, 161),
                    "Min Voltage Limit": range(95, 161),
                    "Current Limit": range(1194),
                },
                supply_v=12.0,
                no_load_rpm=46.0,
                stall_current=855,
            ),
            _model(
                "xl330_m288",
                52,
                {
                    "Temperature Limit": 70,
                    "Max Voltage Limit": 70,
                    "Min Voltage Limit": 35,
                    "Current Limit": 1750,
                    "Velocity Limit": 445,
                    "PWM Slope": 140,
                    "Shutdown": 53,
                    "Velocity I Gain": 1600,
                    "Velocity P Gain": 180,
                    "Position P Gain": 400,
                },
                {
                    "Baud Rate": range(7),
                    "Max Voltage Limit": range(31, 71),
                    "Min Voltage Limit": range(31, 71),
                    "Current Limit": range(1751),
                    "Velocity Limit": range(2048),
                    "PWM Slope": range(1, 256),
                },
                supply_v=5.0,
                no_load_rpm=103.0,
                stall_current=1470,
            ),
            _model(
                "mx_28",
                43,
                {
                    "Temperature Limit": 80,
                    "Max Voltage Limit": 160,
                    "Min Voltage Limit": 95,
                    "Acceleration Limit": 32_767,
                    "Velocity Limit": 230,
                    "Velocity I Gain": 1920,
                    "Velocity P Gain": 100,
                    "Position P Gain": 850,
                },
                {
                    "Drive Mode": frozenset({0, 1, 4, 5}),
                    "Max Voltage Limit": range(95, 161),
                    "Min Voltage Limit": range(95, 161),
                    "Acceleration Limit": range(32_768),
                },
                supply_v=12.0,
                no_load_rpm=55.0,
            ),
        )
    }
)
