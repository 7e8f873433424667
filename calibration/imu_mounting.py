"""How the IMU sits on the platter: its tilt against the table's axis, its levels, and how late it tells.

While the table turns, the rate is along its axis: the direction of the integrated rate in the sensor's frame is the
axis, whatever gravity says. At rest the accelerometer shows gravity: what of its mean over a turn is not along the axis
is its own zero error, and what goes round with the table is the table's axis out of the vertical. On a move whose play
is taken up, the encoder is ahead of the gyro by the rate times the delay.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import degrees, hypot, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.recording import Recording, recording
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.core.errors import LimitExceeded
from rig.events.events import Moved
from rig.motion.turntable import Turntable
from rig.plans.capture import moved

NAME = "imu.mounting"
VALID_DAYS = 180

STEPS = 8
READINGS = 60
SPACING_S = 0.025
"""Between readings of the accelerometer: what its low-pass of some 40 Hz remembers of the last is gone."""
MAX_TILT_DEG = 10.0
"""The cosine of more costs 1.5 % of the rate: more than the gyro's own scale error."""
MAX_LEVEL_DEG = 5.0
AXIS_GAIN_SIGMA = 0.015
"""How much the scales of two of the gyro's axes differ, from part to part."""
MIN_RATE_DPS = 5.0
"""Readings on the way count from this rate on: the play is taken up long before."""

REST_IN_PLAY_DEG = 0.04


@dataclass(frozen=True, slots=True)
class Turn:
    """One move upwards, play taken up.

    ``rotation_deg`` float64 (3,): the integrated rate about the sensor's axes, without the zero; ``sigma_deg`` of each
    of them; ``encoder_deg`` the table's rotation; ``lead_deg`` and ``rate_dps`` float64 (n,): by how much encoder
    readings on the way were ahead of the gyro, and the table's rate then.
    """

    encoder_deg: float
    rotation_deg: NDArray[np.float64]
    sigma_deg: float
    lead_deg: NDArray[np.float64]
    rate_dps: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Level:
    """The accelerometer at rest: the table's angle, mean (3,) in g, and the standard uncertainty of each component."""

    table_deg: float
    mean_g: NDArray[np.float64]
    sigma_g: float


def live(bench: Bench) -> Generator[Moved | CalibrationResult, None, CalibrationResult]:
    """Turn the table once, in eight steps, and listen at each stop; yields each move, then the fact.

    Raises
    ------
    LimitExceeded
        The cable leaves less than a turn; before anything moves.
    MotionTimeout, DeviceFault, DeviceSilent
        See `rig.motion.turntable`.
    """
    when_utc, config = bench.clock.utc(), bench.config
    low, high = config.table.limits_deg
    first_deg = max(low + config.table.approach_deg, min(0.0, high - 360.0))
    if first_deg + 360.0 > high:
        raise LimitExceeded(
            f"The cable leaves {high - low:.0f}°, the procedure needs a whole turn and table.approach_deg.",
            next_step="Where the cable allows it, widen table.limits_deg.",
            evidence={"limits_deg": [low, high]},
        )
    column = "xyz".index(config.imu.axis)
    turns: list[Turn] = []
    levels: list[Level] = []
    with recording(bench) as kept, Turntable(bench) as table:
        start_deg, may_return = table.rest_deg, True
        try:
            for index in range(STEPS + 1):
                may_return = False
                if index == 0:
                    yield moved(0, table.goto(first_deg))
                    may_return = True
                else:
                    kept.clear()
                    _listen(bench, table)
                    before_ns = bench.clock.now_ns()
                    move = table.goto(first_deg + index * 360.0 / STEPS)
                    may_return = True
                    turn = _turn(kept, before_ns, column, config.imu.sign, config.table.direction)
                    if turn is not None:
                        turns.append(turn)
                    yield moved(index, move)
                if index < STEPS:
                    readings = np.array([bench.imu.read_gravity_g() for _ in _paced(bench, table)])
                    sigma = float(readings.std(axis=0, ddof=1).max()) / sqrt(READINGS)
                    levels.append(Level(table.rest_deg, readings.mean(axis=0), sigma))
        finally:
            if may_return:
                table.goto(start_deg)
    fact = from_data(
        turns,
        levels,
        column=column,
        sign=config.imu.sign,
        when_utc=when_utc,
        device=bench.apparatus("servo", "imu"),
    )
    yield fact
    return fact


def from_data(
    turns: Sequence[Turn],
    levels: Sequence[Level],
    *,
    column: int,
    sign: int,
    when_utc: datetime,
    device: Mapping[str, Any],
) -> CalibrationResult:
    """Find tilt, levels and delay, and judge them.

    Parameters
    ----------
    turns, levels
        What was measured, over a whole turn.
    column, sign
        Which of the sensor's axes is along the table's, and +1 where it points up.
    when_utc, device
        Kept with the fact.
    """
    refusals: list[str] = []
    estimates: dict[str, Estimate] = {}
    residual = limit = None
    if len(turns) < STEPS // 2:
        refusals.append(
            f"Only {len(turns)} of {STEPS} moves can be used: the sensor lost samples. Close what runs beside this and "
            "calibrate again."
        )
    else:
        total = np.sum([turn.rotation_deg for turn in turns], axis=0)
        length = float(np.linalg.norm(total))
        axis = total / length  # of a counter-clockwise turn: upwards
        sigma = sqrt(sum(turn.sigma_deg**2 for turn in turns)) / length
        others = [i for i in range(3) if i != column]
        tilt_sigma = {i: hypot(sigma, AXIS_GAIN_SIGMA * float(axis[i])) for i in others}
        for i in others:
            estimates[f"tilt_{'xyz'[i]}"] = Estimate(degrees(float(axis[i])), degrees(tilt_sigma[i]), "°")
        tilt_deg = degrees(float(np.arccos(np.clip(sign * axis[column], -1.0, 1.0))))
        residual, limit = tilt_deg, MAX_TILT_DEG
        refusals += _judge_tilt(tilt_deg, axis, column)
        estimates |= _levels(levels, axis, column, tilt_sigma)
        estimates["delay"] = _delay(turns)
        level_deg = hypot(estimates["axis_x"].value, estimates["axis_y"].value)
        if level_deg > MAX_LEVEL_DEG:
            refusals.append(
                f"The table's axis is {level_deg:.1f}° off the vertical, more than {MAX_LEVEL_DEG:g}°: put something "
                "under the base, or does the accelerometer's range not fit?"
            )
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=residual,
        limit=limit,
        residual_unit="° of tilt",
        refusals=tuple(refusals),
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={
            "rotations_deg": [turn.rotation_deg.tolist() for turn in turns],
            "encoder_deg": [turn.encoder_deg for turn in turns],
            "levels": [{"table_deg": level.table_deg, "mean_g": level.mean_g.tolist()} for level in levels],
        },
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return what the accelerometer reads across the axis over the turn: a tilt and an offset make a circle of it."""
    levels = fact.evidence["levels"]
    if not levels or not fact.estimates:
        return None
    mean_g = np.array([level["mean_g"] for level in levels])
    angles = [level["table_deg"] for level in levels]
    across = [(i, colour) for i, colour in enumerate((MEASURED, OTHER, MODEL)) if np.abs(mean_g[:, i]).mean() < 0.5]
    return Chart(
        "Gravity across the table's axis",
        Axis("table, °"),
        Axis("accelerometer, g"),
        [Series(f"{'xyz'[i]} axis", angles, mean_g[:, i].tolist(), colour, curve=True) for i, colour in across],
    )


def _judge_tilt(tilt_deg: float, axis: NDArray[np.float64], column: int) -> list[str]:
    if tilt_deg <= MAX_TILT_DEG:
        return []
    nearest = int(np.argmax(np.abs(axis)))
    wanted = f'imu.axis = "{"xyz"[nearest]}" and imu.sign = {1 if axis[nearest] > 0 else -1}'
    if nearest != column or tilt_deg > 90.0:
        return [f"The table turns about the sensor's {'xyz'[nearest]} axis: set {wanted}."]
    return [
        f"The sensor is tilted by {tilt_deg:.1f}° against the table's axis, more than {MAX_TILT_DEG:g}°: mount it "
        "flat on the platter."
    ]


def _levels(
    levels: Sequence[Level], axis: NDArray[np.float64], column: int, tilt_sigma: Mapping[int, float]
) -> dict[str, Estimate]:
    """Return the accelerometer's zero errors (g), and the table's axis out of the vertical (°)."""
    turn = np.radians([level.table_deg for level in levels])
    readings = np.array([level.mean_g for level in levels])
    design = np.column_stack([np.ones(turn.size), np.cos(turn), np.sin(turn)])
    (mean, cosine, sine), *_ = np.linalg.lstsq(design, readings, rcond=None)
    noise = sqrt(sum(level.sigma_g**2 for level in levels)) / len(levels)
    estimates = {}
    for i, name in enumerate("xyz"):
        sigma = hypot(noise, tilt_sigma.get(i, 0.0))
        estimates[f"accel_zero_{name}"] = Estimate(float(mean[i] - axis[i]), sigma, "g")
    # Gravity's horizontal part goes round in the platter's frame: two axes a quarter turn apart show it.
    a, b = (column + 1) % 3, (column + 2) % 3
    if axis[column] < 0:
        a, b = b, a
    sigma_deg = degrees(noise)
    estimates["axis_x"] = Estimate(degrees(float(cosine[a] - sine[b]) / 2), sigma_deg, "° off the vertical")
    estimates["axis_y"] = Estimate(degrees(float(sine[a] + cosine[b]) / 2), sigma_deg, "° off the vertical")
    return estimates


def _delay(turns: Sequence[Turn]) -> Estimate:
    """Return by how much the gyro's samples are dated later than the encoder's readings."""
    lead = np.concatenate([turn.lead_deg for turn in turns])
    rate = np.concatenate([turn.rate_dps for turn in turns])
    norm = float((rate**2).sum())
    delay = float((rate * lead).sum()) / norm
    each = [
        float((turn.rate_dps * turn.lead_deg).sum() / (turn.rate_dps**2).sum()) for turn in turns if turn.rate_dps.size
    ]
    # Readings of one move share what the encoder read at its rest: the moves are what is independent. A platter that
    # rings comes to rest somewhat inside the play, always on the same side.
    scatter = float(np.std(each, ddof=1)) / sqrt(len(each))
    return Estimate(delay, hypot(scatter, REST_IN_PLAY_DEG / float(np.median(rate))), "s")


def _listen(bench: Bench, table: Turntable) -> None:
    """Let the gyro see a rest, from which its zero is taken."""
    for _ in range(5):
        bench.clock.sleep(0.2)
        table.check_still()


def _paced(bench: Bench, table: Turntable) -> Generator[None, None, None]:
    """Pace readings of the accelerometer; meanwhile the gyro's samples must not overflow."""
    for index in range(READINGS):
        yield
        bench.clock.sleep(SPACING_S)
        if index % 10 == 9:
            table.check_still()


def _turn(kept: Recording, before_ns: int, column: int, sign: int, direction: int) -> Turn | None:
    """Return what was recorded of a move that began after ``before_ns``; None where samples were lost."""
    times, rates, lost = kept.gyro()
    if lost or not len(kept.states):
        return None
    at_rest = times < before_ns
    moving = ~at_rest
    if at_rest.sum() < 50 or moving.sum() < 50:
        return None
    zero = rates[at_rest].mean(axis=0)
    noise = rates[at_rest].std(axis=0, ddof=1)[column]
    step_s = float(np.diff(times).mean()) * 1e-9
    net = (rates[moving] - zero) * step_s
    angle = np.concatenate([[0.0], np.cumsum(net[:, column])]) * sign
    moments = np.concatenate([[times[moving][0] - round(step_s * 1e9)], times[moving]])
    states = [state for state in kept.states if moments[0] <= state.time_ns <= moments[-1]]
    state_ns = np.array([state.time_ns for state in states])
    position = np.array([direction * state.position_deg for state in states])
    gyro_deg = np.interp(state_ns, moments, angle)
    rate_dps = np.interp(state_ns, times, (rates[:, column] - zero[column]) * sign)
    start = np.mean([direction * state.position_deg for state in kept.states if state.time_ns < before_ns])
    rotation = float(position[-1] - start)
    # Scale of gyro against encoder, from the whole move: what is left on the way is the delay.
    scale = rotation / float(angle[-1]) if angle[-1] else 1.0
    cruising = np.abs(rate_dps) > MIN_RATE_DPS
    span_s = float(moving.sum()) * step_s
    sigma = float(noise) * sqrt(step_s * span_s + (step_s * span_s**2) / (float(at_rest.sum()) * step_s))
    return Turn(
        rotation,
        net.sum(axis=0),
        sigma,
        (position - start - scale * gyro_deg)[cruising],
        rate_dps[cruising],
    )
