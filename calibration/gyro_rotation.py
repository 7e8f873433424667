"""Verify the uncertainty of every measured rotation, by repeated rotations of several durations.

The table rotates back and forth between the same two rests, at several speeds. A group is one speed and one direction.
Systematic differences between encoder and gyro (scale, backlash, error of the encoder over its revolution) are the same
in every rotation of a group, so they are in the group's mean. The remaining scatter must match the uncertainty stated
for each rotation,

    σ² = N²·t + (σ_bias·t)² + 2·c²/12

with the gyro's angle random walk N over the duration t, the uncertainty of its zero from the rest before, and two rests
anywhere within an encoder count c. Σ (d − mean)²/σ² then follows χ². The stated σ of the bench is rather too large: a
servo stops at nearly the same place of a count each time, and the zero is known better than assumed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from calibration.legs import Leg, reasons
from calibration.procedure import (
    Evaluation,
    Measured,
    Procedure,
    lower_end,
    returning,
)
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode
from rig.charts.xy import LIMIT, MODEL, Axis, Chart, Series
from rig.core.json_form import plain
from rig.motion.turntable import Turntable
from rig.plans.steps import moved

NAME = "imu.rotation"

# noise grows with the duration, a scale error does not: moves of 1.7, 3.0 and 9.8 s separate them
SPEEDS = {"fast": 1.0, "medium": 0.3, "slow": 0.08}
"""Shares of table.velocity_dps."""
DISTANCE_DEG = 60.0  # longer: more noise of the gyro to check; shorter: less cable is needed
MIN_REPEATS = 4  # with fewer, the limits by `CHANCE` are so wide that they reject nothing
CHANCE = 1e-4
"""Probability that a true σ is rejected, at each duration and in either direction."""
CAUTION = 2.0
"""Largest accepted ratio of the stated σ to the true one, because too large an uncertainty does no harm."""


@dataclass(frozen=True, slots=True)
class TimedLeg:
    """A leg, the time over which its gyro was summed up, and its speed (a key of `SPEEDS`)."""

    speed: str
    seconds: float
    leg: Leg


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the scatter of repeated rotations over their duration, and of the stated uncertainty."""
    rows = result.evidence["by_duration"]
    if not rows:
        return None
    seconds = [row["seconds"] for row in rows]
    largest = [row["stated_deg"] * row["ratio_may_be"][1] for row in rows]
    return Chart(
        "Scatter of a measured rotation by its duration",
        Axis("duration, s", span=(0.0,)),
        Axis("σ, °", span=(0.0,)),
        [
            Series("stated", seconds, [row["stated_deg"] for row in rows], MODEL, curve=True),
            Series("largest by chance", seconds, largest, LIMIT, dots=False, curve=True, dashed=True),
            Series("measured", seconds, [row["measured_deg"] for row in rows]),
        ],
    )


@dataclass(frozen=True)
class GyroRotation(Procedure):
    """A procedure that rotates back and forth ``repeats`` times at each speed, around the table's present angle."""

    result_name, devices, valid_days, plots = NAME, ("servo", "imu"), 180, (plot,)
    reference = "encoder of the servo"
    repeats: int

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        velocity_dps = bench.config.table.velocity_dps
        moves: list[TimedLeg] = []
        index = 0
        for speed, share in SPEEDS.items():
            with Turntable(bench, trust_gyro=False, velocity_dps=velocity_dps * share) as table:
                base_deg = lower_end(bench, table.rest_deg, DISTANCE_DEG)
                with returning(table) as goto:
                    for number in range(2 * self.repeats + 1):
                        move = goto(base_deg + (0.0 if number % 2 else DISTANCE_DEG))
                        if number:  # the first rotation begins at any angle
                            moves.append(TimedLeg(speed, move.gyro.duration_s, Leg.of(move, bench.config.imu)))
                        yield moved(index, move)
                        index += 1
        return evaluate(moves, resolution_deg=bench.servo.resolution_deg)


def evaluate(moves: Sequence[TimedLeg], *, resolution_deg: float) -> Evaluation:
    """Compare the scatter of ``moves`` at each speed with the stated uncertainty.

    ``moves`` go back and forth between the same rests. ``resolution_deg`` is the angle of one encoder count.
    """
    found = Evaluation(name=NAME, residual_unit="of the stated σ")
    rows: list[dict[str, Any]] = []
    for speed in dict.fromkeys(move.speed for move in moves):
        used = [move for move in moves if move.speed == speed and not move.leg.invalid]
        # Each direction has its own mean: backlash and a scale error are no scatter.
        ways = [[m for m in used if (m.leg.encoder_deg > 0) == up] for up in (True, False)]
        if min(map(len, ways)) < MIN_REPEATS:
            why = reasons([move.leg for move in moves])
            found.reject(RejectionCode.TOO_FEW_MOVES, speed=speed, needed=MIN_REPEATS, reasons=why)
            continue
        squares, stated = [], []
        for way in ways:
            difference = np.array([m.leg.encoder_deg - m.leg.gyro_deg for m in way])
            stated.append(np.hypot([m.leg.sigma_deg for m in way], resolution_deg / sqrt(6)))
            squares.append((difference - difference.mean()) ** 2)
        square, sigma = np.concatenate(squares), np.concatenate(stated)
        freedom = len(used) - 2
        ratio = sqrt(float((square / sigma**2).sum()) / freedom)
        # The scatter of so few moves varies by chance: the limits are quantiles of χ².
        low, high = (sqrt(2 * float(gammaincinv(freedom / 2, p)) / freedom) for p in (CHANCE, 1 - CHANCE))
        low /= CAUTION
        seconds, measured_deg = float(np.mean([m.seconds for m in used])), sqrt(float(square.sum()) / freedom)
        stated_deg = float(np.sqrt((sigma**2).mean()))
        row = {"speed": speed, "seconds": seconds, "measured_deg": measured_deg, "stated_deg": stated_deg}
        rows.append({**row, "freedom": freedom, "ratio_may_be": [low, high]})
        for name, value, unit in (("sigma", measured_deg, "°"), ("ratio", ratio, found.residual_unit)):
            chance = Contribution("chance in the scatter of so few moves", "A", value / sqrt(2 * freedom), unit)
            found.estimate(f"{name}_{speed}", value, unit, chance)
        code = RejectionCode.SCATTER_TOO_LARGE if ratio > 1 else RejectionCode.SCATTER_TOO_SMALL
        found.reject_if(not low < ratio < high, code, **row, ratio=ratio)
    found.evidence = {"by_duration": rows, "moves": plain(list(moves))}
    if rows:
        # The residual is that of the duration nearest to its limit.
        worst = max(rows, key=lambda row: row["measured_deg"] / row["stated_deg"] / row["ratio_may_be"][1])
        found.residual = found.estimates[f"ratio_{worst['speed']}"].value
        found.limit = worst["ratio_may_be"][1]
    return found
