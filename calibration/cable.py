"""How far the cable lets the table turn, taught by hand with the torque off.

A person turns the table to either end of the cable's reach; the servo, under supply, counts the turns itself.
"""

from collections.abc import Generator, Mapping
from datetime import datetime
from typing import Any

from calibration import pictures
from calibration.events import Ask
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate

NAME = "servo.cable"
VALID_DAYS = 365

MARGIN_DEG = 15.0
"""Kept from either end: a motion that is stopped runs on, and a hand feels a taut cable late."""
HAND_DEG = 5.0
"""Standard uncertainty of where a person finds the cable taut."""
TURN_DEG = 360.0


def live(bench: Bench) -> Generator[Ask | CalibrationResult, None, CalibrationResult]:
    """Have both ends of the cable shown; yields what to do, then the fact. The servo moves nothing.

    Raises
    ------
    DeviceFault, DeviceSilent
        The servo fails.
    """
    when_utc = bench.clock.utc()
    bench.servo.torque_off()
    ends_deg = []
    for direction, picture in (("counter-clockwise", pictures.TURN_LEFT), ("clockwise", pictures.TURN_RIGHT)):
        yield Ask(f"Turn the table by hand {direction}, seen from above, until its cable is just not taut.", picture)
        ends_deg.append(bench.safety.angle_reference.to_table(bench.servo.read_state().position_deg))
    yield Ask("Turn the table back by hand until its cable hangs free.", pictures.CABLE_FREE)
    fact = from_data(
        ends_deg[0],
        ends_deg[1],
        pan=bench.config.table.mode == "pan",
        when_utc=when_utc,
        device=bench.apparatus("servo"),
    )
    yield fact
    return fact


def from_data(
    high_deg: float, low_deg: float, *, pan: bool, when_utc: datetime, device: Mapping[str, Any]
) -> CalibrationResult:
    """Judge the two ends of the cable, table angles in degrees; ``pan`` tables need no whole turn."""
    limits = [round(low_deg + MARGIN_DEG, 1), round(high_deg - MARGIN_DEG, 1)]
    span_deg = limits[1] - limits[0]
    refusals = []
    if high_deg < low_deg:
        refusals.append(
            f"The counter-clockwise end ({high_deg:.0f}°) lies below the clockwise one ({low_deg:.0f}°): the ends were "
            "shown the other way round, or table.direction has the wrong sign. Check it with `rig calibrate servo`."
        )
    elif not pan and span_deg < TURN_DEG:
        refusals.append(
            f"Between the ends, less {MARGIN_DEG:g}° at each, the cable leaves {span_deg:.0f}°: less than a turn. Give "
            'it more slack, lead it up along the axis, or set table.mode = "pan".'
        )
    elif not limits[0] <= 0.0 <= limits[1]:
        refusals.append(
            f"The table's zero does not lie between {limits[0]:.0f}° and {limits[1]:.0f}°: turn the table to where "
            "the cable hangs free, tell the rig with `rig home --set`, and teach the ends again."
        )
    return CalibrationResult(
        name=NAME,
        estimates={"lowest": Estimate(low_deg, HAND_DEG, "°"), "highest": Estimate(high_deg, HAND_DEG, "°")},
        residual=None,
        limit=None,
        residual_unit="°",
        refusals=tuple(refusals),
        settings={} if refusals else {"table.limits_deg": limits},
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"margin_deg": MARGIN_DEG},
    )
