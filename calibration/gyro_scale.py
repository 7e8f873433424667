"""The scale of the gyro about the table's axis, against whole turns of the servo's encoder.

A whole turn ends on the encoder's own counts again, so that neither its harmonic error nor the eccentricity of its
magnet is left in the ratio. Turns both ways in equal number cancel a bias that drifts evenly:

    s = Σ w·E·G / Σ w·G²,    w = 1/σ²,    σ² = σ_gyro² + σ_encoder²

with the rotations E by the encoder and G by the gyro as it reads, without a scale. The tilt of the sensor against the
axis (a factor cos of it) and the error of its sample clock are part of s. A platter that slips by the same share on
every leg looks like a scale: no whole turns can tell the two apart.
"""

from collections.abc import Generator, Mapping, Sequence
from datetime import datetime
from math import ceil, floor, hypot, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.legs import COVERAGE, Leg, fit
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.core.errors import LimitExceeded, UsageError
from rig.events.events import Moved, plain
from rig.motion.turntable import Turntable
from rig.plans.capture import moved
from rig.safety.gyro_rotation import DRAIN_S, MEMORY_S

NAME = "imu.scale"

MIN_LEGS = 2
"""Legs each way: fewer cannot contradict each other."""
MAX_LEG_TURNS = 2
"""Longer legs gain nothing: what the rest before says about the bias gets old."""
PLAUSIBLE = (0.9, 1.1)
"""±3 % from part to part, ±2 % over temperature (PS-MPU-6000A, 6.1), a mounting tilted by up to 15°."""
VALID_DAYS = 180
"""The scale ages by mounting and temperature, not by use; half a year finds a sensor that came loose."""
MAX_UNCERTAINTY = 0.001
"""What a rotation by 90° needs to be known to a tenth of a degree."""


def live(bench: Bench, *, turns: int = 8) -> Generator[Moved | CalibrationResult, None, CalibrationResult]:
    """Calibrate the gyro's scale by at least ``turns`` whole turns; yields each move, then the fact, and returns it.

    The table goes back to where it was when all turns are done, and when the generator is closed between two of them.
    After a fault or an interruption nothing moves by itself: it stays where it stopped, without torque.

    Raises
    ------
    UsageError
        Fewer ``turns`` than one for each leg that is needed.
    LimitExceeded
        The cable does not reach around once; before anything moves.
    MotionTimeout, DeviceFault, DeviceSilent
        See `rig.motion.turntable`.
    """
    table_config, imu_config = bench.config.table, bench.config.imu
    low_deg, high_deg = table_config.limits_deg
    # Downwards the table goes beyond its goal and comes back, so that every rest has the gears' play on the same side.
    ends_deg = _ends(low_deg + table_config.approach_deg, high_deg, turns)
    each_way = max(ceil(turns * 360 / (ends_deg[1] - ends_deg[0]) / 2), MIN_LEGS)
    when_utc = bench.clock.utc()
    legs: list[Leg] = []
    with Turntable(bench, trust_gyro=False) as table:
        start_deg = min(max(table.rest_deg, low_deg), high_deg)
        may_return = True
        try:
            for index in range(1 + 2 * each_way):
                may_return = False
                _rest(table, bench)
                move = table.goto(ends_deg[index % 2])
                may_return = True
                if index:  # the first move takes up the play
                    legs.append(Leg.of(move, imu_config))
                yield moved(index, move)
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
    """Fit the scale to ``legs`` and judge it.

    Parameters
    ----------
    legs
        Whole turns up and down in turn, each from the rest where the one before ended.
    resolution_deg
        Angle of one encoder count: a rest lies anywhere within it.
    when_utc, device
        Kept with the fact.
    """
    used = [leg for leg in legs if not leg.trouble]
    encoder = np.array([leg.encoder_deg for leg in used])
    gyro = np.array([leg.gyro_deg for leg in used])
    # A leg has two rests, each uniform within a count: variance 2·count²/12. Neighbouring legs share one with opposite
    # signs, so that in the ratio its error counts twice: as much again.
    sigma = np.hypot([leg.sigma_deg for leg in used], resolution_deg / sqrt(3))
    up = encoder > 0
    evidence: dict[str, Any] = {"legs": plain(list(legs))}
    estimates = {}
    value = uncertainty = residual = limit = None
    refusals = []
    if min(int(up.sum()), int((~up).sum())) < MIN_LEGS:
        troubles = dict.fromkeys(leg.trouble for leg in legs if leg.trouble)
        refusals.append(
            f"Too few turns: {up.sum()} upwards and {(~up).sum()} downwards can be used, {MIN_LEGS} each way are needed"
            + "".join(f"; {trouble}" for trouble in troubles)
            + ". Give more --turns; where the rate is too high, lower table.velocity_dps or raise imu.range_dps."
        )
    elif not PLAUSIBLE[0] < (ratio := float(np.median(gyro / encoder))) < PLAUSIBLE[1]:
        refusals.append(
            f"The gyro reads {ratio:.3f}° for each degree of the encoder: no part is as far off. Check imu.axis, "
            "imu.sign and table.direction, that the sensor rides flat on the platter, and that no gear is between."
        )
    else:
        fitted = fit(used, gyro[:, None], resolution_deg)
        value, uncertainty = float(fitted.values[0]), float(fitted.sigma[0])
        residuals = np.abs(encoder - value * gyro)
        worst = int(np.argmax(residuals / sigma))
        residual, limit = float(residuals[worst]), COVERAGE * float(sigma[worst])
        estimates["scale"] = Estimate(value, uncertainty, "true °/s per °/s read")
        (value_up, sigma_up), (value_down, sigma_down) = (
            _ratio(encoder[way], gyro[way], sigma[way]) for way in (up, ~up)
        )
        evidence |= {"scale_up": value_up, "scale_down": value_down}
        if residual > limit:
            refusals.append(
                f"Leg {legs.index(used[worst]) + 1} is off by {residual:.2f}°, above {limit:.2f}°: the platter slipped "
                "or was touched. Tighten it, keep hands off, and calibrate again."
            )
        if abs(value_up - value_down) > COVERAGE * hypot(sigma_up, sigma_down):
            refusals.append(
                f"The directions differ: {value_up:.5f} upwards, {value_down:.5f} downwards: the gyro's bias drifts, "
                "or the platter gives way. Let the sensor warm up for some minutes, tighten the platter, and try again."
            )
        if uncertainty > MAX_UNCERTAINTY:
            refusals.append(
                f"The scale is uncertain by {uncertainty:.2%}, more than {MAX_UNCERTAINTY:.1%}: the gyro is noisy. "
                "Keep vibration off the bench, or give more --turns."
            )
    settings = {NAME: value, f"{NAME}_uncertainty": uncertainty}
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
        evidence=evidence,
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return encoder over gyro for each leg, and the scale."""
    legs = [(i + 1, leg) for i, leg in enumerate(fact.evidence["legs"]) if not leg["trouble"] and leg["gyro_deg"]]
    if not legs or not fact.estimates:
        return None
    scale = fact.estimates["scale"]

    def percent(ratio: float) -> float:
        return 100 * (ratio - 1)

    ends = [legs[0][0], legs[-1][0]]
    return Chart(
        "Scale of the gyro, from whole revolutions",
        Axis("leg", whole=True),
        Axis("encoder beyond gyro, %"),
        [
            Series(
                f"scale {scale.value:.5f}",
                ends,
                [percent(scale.value)] * 2,
                MODEL,
                dots=False,
                curve=True,
                low=[percent(scale.value) - 200 * scale.uncertainty] * 2,
                high=[percent(scale.value) + 200 * scale.uncertainty] * 2,
            ),
            *(
                Series(
                    words,
                    [i for i, leg in legs if sign * leg["encoder_deg"] > 0],
                    [percent(leg["encoder_deg"] / leg["gyro_deg"]) for _, leg in legs if sign * leg["encoder_deg"] > 0],
                    colour,
                )
                for words, sign, colour in (("upwards", 1, MEASURED), ("downwards", -1, OTHER))
            ),
        ],
    )


def _ends(low_deg: float, high_deg: float, turns: int) -> tuple[float, float]:
    """Return two angles whole turns apart, in the middle of the cable's reach."""
    if turns < 2 * MIN_LEGS:
        raise UsageError(
            f"{turns} turns are too few to judge a scale by.", next_step=f"Give at least {2 * MIN_LEGS} turns."
        )
    reach = floor((high_deg - low_deg) / 360)
    if reach < 1:
        raise LimitExceeded(
            f"The cable leaves {high_deg - low_deg:.0f}° for whole turns of 360°.",
            next_step="Where the cable allows it, widen table.limits_deg to a turn and table.approach_deg.",
            evidence={"reach_deg": [low_deg, high_deg]},
        )
    leg_turns = min(reach, MAX_LEG_TURNS, turns // (2 * MIN_LEGS))
    first_deg = (low_deg + high_deg - 360.0 * leg_turns) / 2
    return first_deg, first_deg + 360.0 * leg_turns


def _rest(table: Turntable, bench: Bench) -> None:
    """Let the gyro see as much of a rest as it learns from: the bias is the largest part of its uncertainty."""
    for _ in range(round(MEMORY_S / DRAIN_S)):
        bench.clock.sleep(DRAIN_S)
        table.check_still()


def _ratio(encoder: NDArray[np.float64], gyro: NDArray[np.float64], sigma: NDArray[np.float64]) -> tuple[float, float]:
    """Return encoder over gyro as a line through the origin, and its standard uncertainty."""
    weight = 1 / sigma**2
    norm = float((weight * gyro**2).sum())
    return float((weight * encoder * gyro).sum()) / norm, 1 / sqrt(norm)
