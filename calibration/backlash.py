"""The play of the gears between shaft and platter, and the servo's sense and ratio, by the gyro on the platter.

The table goes up and down in turn. At each reversal the shaft first crosses the play, while the platter stands, so that
the gyro sees less than the encoder by the play's full width b, whatever the length of the leg:

    E = s·G + b·sign(E)

with the rotations E by the encoder and G by the gyro. Short legs tell b, long ones the ratio s, which must be near 1:
another one is a wrong gear ratio, and a negative one a wrong direction. A rest lies anywhere within an encoder count,
and neighbouring legs share one.
"""

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import Any

import numpy as np

from calibration.legs import COVERAGE, Leg, fit
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.errors import LimitExceeded, UsageError
from rig.events.events import Moved, plain
from rig.motion.turntable import Turntable
from rig.plans.capture import moved

NAME = "servo.backlash"
VALID_DAYS = 90

SHORT_DEG, LONG_DEG = 6.0, 60.0
MIN_REVERSALS = 6
RATIO = (0.9, 1.1)
"""What a sound gyro and a right gear ratio can show (see `calibration.gyro_scale.PLAUSIBLE`)."""
MAX_BACKLASH_DEG = 2.0
"""Eight times what an XL430's gears have: more is a loose horn or coupling."""
MAX_UNCERTAINTY_DEG = 0.03


def live(bench: Bench, *, reversals: int = 24) -> Generator[Moved | CalibrationResult, None, CalibrationResult]:
    """Measure the play by ``reversals`` of the table around where it stands; yields each move, then the fact.

    Raises
    ------
    UsageError
        Too few reversals.
    LimitExceeded
        The cable leaves no room; before anything moves.
    MotionTimeout, DeviceFault, DeviceSilent
        See `rig.motion.turntable`.
    """
    if reversals < MIN_REVERSALS:
        raise UsageError(f"{reversals} reversals are too few.", next_step=f"Give at least {MIN_REVERSALS}.")
    when_utc, imu = bench.clock.utc(), bench.config.imu
    low, high = bench.config.table.limits_deg
    legs: list[Leg] = []
    with plain_approach(bench), Turntable(bench, trust_gyro=False) as table:
        start_deg = table.rest_deg
        # Away from where it stands to the side that has room for a long leg.
        base_deg = start_deg if start_deg + LONG_DEG <= high else start_deg - LONG_DEG
        if base_deg < low:
            raise LimitExceeded(
                f"The cable leaves {high - low:.0f}°, the procedure needs {LONG_DEG:g}°.",
                next_step="Where the cable allows it, widen table.limits_deg.",
                evidence={"limits_deg": [low, high]},
            )
        may_return = True
        try:
            may_return = False
            yield moved(0, table.goto(base_deg + LONG_DEG))
            yield moved(1, table.goto(base_deg))
            may_return = True
            for index in range(reversals):
                # Pairs of short and of long legs in turn: a bias of the gyro that drifts is in both.
                length_deg = SHORT_DEG if index // 2 % 2 == 0 else LONG_DEG
                may_return = False
                move = table.goto(base_deg + (length_deg if index % 2 == 0 else 0.0))
                may_return = True
                legs.append(Leg.of(move, imu))
                yield moved(2 + index, move)
        finally:
            if may_return:
                table.goto(start_deg)
    fact = from_data(
        legs, resolution_deg=bench.servo.resolution_deg, when_utc=when_utc, device=bench.apparatus("servo", "imu")
    )
    yield fact
    return fact


def from_data(
    legs: Sequence[Leg], *, resolution_deg: float, when_utc: datetime, device: Mapping[str, Any]
) -> CalibrationResult:
    """Fit play and ratio to ``legs``, each of which reverses the one before, and judge them.

    Parameters
    ----------
    legs
        Up and down in turn, of more than one length.
    resolution_deg
        Angle of one encoder count.
    when_utc, device
        Kept with the fact.
    """
    used = [leg for leg in legs if not leg.trouble]
    refusals: list[str] = []
    estimates: dict[str, Estimate] = {}
    settings: dict[str, Any] = {}
    residual = limit = None
    if len(used) < MIN_REVERSALS:
        troubles = "".join(f"; {leg.trouble}" for leg in legs if leg.trouble)
        refusals.append(f"Only {len(used)} reversals can be used, {MIN_REVERSALS} are needed{troubles}.")
    else:
        encoder = np.array([leg.encoder_deg for leg in used])
        gyro = np.array([leg.gyro_deg for leg in used])
        fitted = fit(used, np.column_stack([gyro, np.sign(encoder)]), resolution_deg)
        (ratio, play), (ratio_sigma, play_sigma), worst = fitted.values, fitted.sigma, fitted.worst
        residual = abs(float(fitted.residuals_deg[worst]))
        limit = COVERAGE * float(fitted.residual_sigma_deg[worst])
        estimates = {
            "backlash": Estimate(float(play), float(play_sigma), "°"),
            "ratio": Estimate(float(ratio), float(ratio_sigma), "° of the encoder per ° read"),
        }
        refusals = _judge(estimates, residual, limit, worst)
        # What may differ between encoder and platter without being a fault: the play, and what is not known of it.
        settings = {"table.backlash_deg": round(max(float(play), 0.0) + COVERAGE * float(play_sigma), 3)}
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=residual,
        limit=limit,
        residual_unit="°",
        refusals=tuple(refusals),
        settings={} if refusals else settings,
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"legs": plain(list(legs))},
    )


@contextmanager
def plain_approach(bench: Bench) -> Generator[None, None, None]:
    """Let the table stop from either side for the length of a ``with`` block: the play is what is looked for."""
    before = bench.config
    table = before.table.model_copy(update={"approach_deg": 0.0})
    bench.config = before.model_copy(update={"table": table})
    try:
        yield
    finally:
        bench.config = before


def plot(fact: CalibrationResult) -> Chart | None:
    """Return what each reversal lost beyond the fitted ratio: the play, whatever the length of the leg."""
    if "backlash" not in fact.estimates:
        return None
    play, ratio = fact.estimates["backlash"], fact.estimates["ratio"].value
    legs = [(i + 1, leg) for i, leg in enumerate(fact.evidence["legs"]) if not leg["trouble"]]
    lost = [(leg["encoder_deg"] - ratio * leg["gyro_deg"]) * np.sign(leg["encoder_deg"]) for _, leg in legs]
    ends = [legs[0][0], legs[-1][0]]
    return Chart(
        "Backlash of the gears",
        Axis("reversal", whole=True),
        Axis("encoder beyond gyro, °", span=(0.0,)),
        [
            Series(
                f"backlash {play}",
                ends,
                [play.value] * 2,
                MODEL,
                dots=False,
                curve=True,
                low=[play.value - 2 * play.uncertainty] * 2,
                high=[play.value + 2 * play.uncertainty] * 2,
            ),
            Series("measured", [i for i, _ in legs], lost),
        ],
    )


def _judge(estimates: Mapping[str, Estimate], residual: float, limit: float, worst: int) -> list[str]:
    refusals = []
    play, ratio = estimates["backlash"], estimates["ratio"].value
    if ratio < 0:
        refusals.append(
            f"The platter turns the other way than the encoder says ({ratio:.3f}): change the sign of table.direction, "
            "or imu.sign where the sensor hangs upside down."
        )
    elif not RATIO[0] < ratio < RATIO[1]:
        refusals.append(
            f"The table turns {1 / ratio:.3f}° for each degree that the servo is thought to turn it: set "
            f"servo.gear_ratio to {ratio:.3g} times what it is, or look for a slipping belt."
        )
    if residual > limit:
        refusals.append(
            f"Leg {worst + 1} is off by {residual:.2f}°, above {limit:.2f}°: the platter slipped or was touched. "
            "Tighten it, keep hands off, and calibrate again."
        )
    if play.value > MAX_BACKLASH_DEG:
        refusals.append(
            f"The play is {play.value:.2f}°, above {MAX_BACKLASH_DEG:g}: the horn or a coupling is loose. Tighten it."
        )
    if play.value < -COVERAGE * play.uncertainty:
        refusals.append(
            f"The play comes out negative ({play.value:.2f}°): something pushes the platter. Look for a cable that "
            "pulls, and calibrate again."
        )
    if play.uncertainty > MAX_UNCERTAINTY_DEG:
        refusals.append(
            f"The play is uncertain by {play.uncertainty:.3f}°, more than {MAX_UNCERTAINTY_DEG:g}°: give more "
            "--reversals, and keep vibration off the bench."
        )
    return refusals
