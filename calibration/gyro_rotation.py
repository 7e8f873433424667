"""Whether the uncertainty that goes with every measured rotation is true, by repeated moves of several durations.

The table goes to and fro between the same two rests, at several speeds. What differs between encoder and gyro besides
chance (scale, play, error of the encoder over its turn) is the same in every move of a group, one speed and one way: it
goes into the group's mean. Left is the scatter, which must be what is stated for each move,

    σ² = N²·t + (σ_bias·t)² + 2·c²/12

with the gyro's angle random walk N over the duration t, the uncertainty of its zero as learnt from the rest before, and
two rests anywhere within an encoder count c. Σ (d − mean)²/σ² then follows χ². The bench states its σ with caution: a
servo rests at nearly the same place of a count each time, and of the zero it grants itself less than it knows.
"""

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from math import sqrt
from typing import Any

import numpy as np
from scipy.stats import chi2

from calibration.legs import Leg
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import LIMIT, MODEL, Axis, Chart, Series
from rig.core.errors import LimitExceeded, UsageError
from rig.events.events import Moved, plain
from rig.motion.turntable import Turntable
from rig.plans.capture import moved

NAME = "imu.rotation"
VALID_DAYS = 180

SPEEDS = {"fast": 1.0, "medium": 0.3, "slow": 0.08}
"""Of table.velocity_dps."""
DISTANCE_DEG = 60.0
MIN_REPEATS = 4
CHANCE = 1e-4
"""A true σ is refused this often, at each duration; in either direction."""
CAUTION = 2.0
"""The stated σ may be so many times too large: an error that is granted and not made does no harm."""


@dataclass(frozen=True, slots=True)
class Timed:
    """A leg, how long its gyro was summed up, and at which of the speeds it was."""

    speed: str
    seconds: float
    leg: Leg


def live(bench: Bench, *, repeats: int = 10) -> Generator[Moved | CalibrationResult, None, CalibrationResult]:
    """Go to and fro ``repeats`` times at each speed around where the table stands; yields each move, then the fact.

    Raises
    ------
    UsageError
        Too few repeats.
    LimitExceeded
        The cable leaves no room; before anything moves.
    MotionTimeout, DeviceFault, DeviceSilent
        See `rig.motion.turntable`.
    """
    if repeats < MIN_REPEATS:
        raise UsageError(f"{repeats} repeats are too few to see a scatter.", next_step=f"Give at least {MIN_REPEATS}.")
    when_utc, imu = bench.clock.utc(), bench.config.imu
    low, high = bench.config.table.limits_deg
    moves: list[Timed] = []
    index = 0
    for speed, share in SPEEDS.items():
        with _at_speed(bench, share), Turntable(bench, trust_gyro=False) as table:
            start_deg = table.rest_deg
            base_deg = start_deg if start_deg + DISTANCE_DEG <= high else start_deg - DISTANCE_DEG
            if base_deg < low:
                raise LimitExceeded(
                    f"The cable leaves {high - low:.0f}°, the procedure needs {DISTANCE_DEG:g}°.",
                    next_step="Where the cable allows it, widen table.limits_deg.",
                    evidence={"limits_deg": [low, high]},
                )
            may_return = True
            try:
                for number in range(2 * repeats + 1):
                    may_return = False
                    move = table.goto(base_deg + (0.0 if number % 2 else DISTANCE_DEG))
                    may_return = True
                    if number:  # the first begins where the table happened to stand
                        moves.append(Timed(speed, move.gyro.duration_s, Leg.of(move, imu)))
                    yield moved(index, move)
                    index += 1
            finally:
                if may_return:
                    table.goto(start_deg)
    fact = from_data(
        moves, resolution_deg=bench.servo.resolution_deg, when_utc=when_utc, device=bench.apparatus("servo", "imu")
    )
    yield fact
    return fact


def from_data(
    moves: Sequence[Timed], *, resolution_deg: float, when_utc: datetime, device: Mapping[str, Any]
) -> CalibrationResult:
    """Compare the scatter of ``moves``, each speed for itself, with what was stated for them.

    Parameters
    ----------
    moves
        To and fro between the same rests.
    resolution_deg
        Angle of one encoder count.
    when_utc, device
        Kept with the fact.
    """
    refusals: list[str] = []
    estimates: dict[str, Estimate] = {}
    rows: list[dict[str, Any]] = []
    for speed in dict.fromkeys(move.speed for move in moves):
        used = [move for move in moves if move.speed == speed and not move.leg.trouble]
        ways = [[m for m in used if (m.leg.encoder_deg > 0) == up] for up in (True, False)]
        if min(map(len, ways)) < MIN_REPEATS:
            troubles = "".join(f"; {t}" for t in dict.fromkeys(m.leg.trouble for m in moves if m.leg.trouble))
            refusals.append(f"Too few {speed} moves can be used, {MIN_REPEATS} each way are needed{troubles}.")
            continue
        squares, stated = [], []
        for way in ways:
            difference = np.array([m.leg.encoder_deg - m.leg.gyro_deg for m in way])
            stated.append(np.hypot([m.leg.sigma_deg for m in way], resolution_deg / sqrt(6)))
            squares.append((difference - difference.mean()) ** 2)
        square, sigma = np.concatenate(squares), np.concatenate(stated)
        freedom = len(used) - 2
        ratio = sqrt(float((square / sigma**2).sum()) / freedom)
        low, high = (sqrt(float(chi2.ppf(p, freedom)) / freedom) for p in (CHANCE, 1 - CHANCE))
        low /= CAUTION
        rows.append(
            {
                "speed": speed,
                "seconds": float(np.mean([m.seconds for m in used])),
                "measured_deg": sqrt(float(square.sum()) / freedom),
                "stated_deg": float(np.sqrt((sigma**2).mean())),
                "freedom": freedom,
                "ratio_may_be": [low, high],
            }
        )
        estimates[f"sigma_{speed}"] = Estimate(
            rows[-1]["measured_deg"], rows[-1]["measured_deg"] / sqrt(2 * freedom), "°"
        )
        estimates[f"ratio_{speed}"] = Estimate(ratio, ratio / sqrt(2 * freedom), "of the stated σ")
        if not low < ratio < high:
            what = (
                "something shakes the bench, or the platter slips: tighten it, keep hands and fans off"
                if ratio > 1
                else "the sensor's noise is stated too large: check that the right sensor is configured"
            )
            refusals.append(
                f"Rotations of {rows[-1]['seconds']:.1f} s scatter by {rows[-1]['measured_deg']:.3f}°, {ratio:.2f} "
                f"times what is stated ({rows[-1]['stated_deg']:.3f}°): {what}. Then calibrate again."
            )
    worst = max(rows, key=lambda row: row["measured_deg"] / row["stated_deg"] / row["ratio_may_be"][1], default=None)
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=estimates[f"ratio_{worst['speed']}"].value if worst else None,
        limit=worst["ratio_may_be"][1] if worst else None,
        residual_unit="of the stated σ",
        refusals=tuple(refusals),
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"by_duration": rows, "moves": plain(list(moves))},
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return the scatter of repeated rotations over their duration, and what is stated for them."""
    rows = fact.evidence["by_duration"]
    if not rows:
        return None
    seconds = [row["seconds"] for row in rows]
    measured = [row["measured_deg"] for row in rows]
    return Chart(
        "Scatter of a measured rotation by its duration",
        Axis("duration, s", log=True),
        Axis("σ, °", span=(0.0,)),
        [
            Series("stated", seconds, [row["stated_deg"] for row in rows], MODEL, curve=True),
            Series(
                "largest by chance",
                seconds,
                [row["stated_deg"] * row["ratio_may_be"][1] for row in rows],
                LIMIT,
                dots=False,
                curve=True,
                dashed=True,
            ),
            Series("measured", seconds, measured),
        ],
    )


@contextmanager
def _at_speed(bench: Bench, share: float) -> Generator[None, None, None]:
    """Let the table turn at a share of its speed for the length of a ``with`` block."""
    before = bench.config
    table = before.table.model_copy(update={"velocity_dps": before.table.velocity_dps * share})
    bench.config = before.model_copy(update={"table": table})
    try:
        yield
    finally:
        bench.config = before
