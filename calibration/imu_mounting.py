"""Measure the mounting of the IMU on the platter: its tilt against the table's axis, its level, and its delay.

While the table rotates, the rate is along its axis: the direction of the integrated rate in the sensor's frame is the
axis, in any direction of gravity. At rest the accelerometer shows gravity. The part of its mean over a revolution
that is not along the axis is its own zero error; the part that rotates with the table is the deviation of the table's
axis from the vertical. During a rotation after the backlash, the encoder is ahead of the gyro by the rate times the
delay.
"""

from collections.abc import Generator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from math import degrees, hypot, radians, sqrt
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from calibration.procedure import Evaluation, Measured, Procedure, returning, too_little_room
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, Estimate, RejectionCode
from rig.charts.xy import MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.devices.imu import Imu, ImuSamples
from rig.devices.servo import Servo
from rig.motion.turntable import Turntable
from rig.plans.steps import moved

NAME = "imu.mounting"

STEPS = 8  # a first harmonic needs three angles; eight also average the second one
READINGS = 60  # a rest takes 1.5 s; more average more of the noise
SPACING_S = 0.025
"""Time between readings of the accelerometer, in which the memory of its low-pass filter of about 40 Hz decays."""
MAX_TILT_DEG = 10.0
"""Largest tilt; the cosine of this angle reduces the rate by 1.5 %, more than the gyro's own scale error."""
MAX_LEVEL_DEG = 5.0  # more is a bench on a slope: the views would show leaning objects
AXIS_GAIN_SIGMA = 0.015
"""Difference of the scales of two of the gyro's axes, from part to part."""
MIN_RATE_DPS = 5.0
"""Rate from which readings during a rotation count; the shaft has run through the backlash before."""
REST_IN_BACKLASH_DEG = 0.04  # a sixth of the backlash of an XL430's gears, 0.25°


@dataclass(frozen=True, slots=True)
class RecordedMove:
    """One rotation upwards: the integrated rate (3,) about the sensor's axes, without the zero, and the σ of each.

    ``lead_deg`` and ``rate_dps`` (n,): by how much the encoder is ahead of the gyro at its readings during the
    rotation, and the table's rate there.
    """

    rotation_deg: NDArray[np.float64]
    sigma_deg: float
    lead_deg: NDArray[np.float64]
    rate_dps: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GravityReading:
    """The accelerometer at rest: the table's angle, mean (3,) in g, and the standard uncertainty of each component."""

    table_deg: float
    mean_g: NDArray[np.float64]
    sigma_g: float


class _Recorded:
    """A device that keeps what one of its functions has returned."""

    def __init__(self, device: object, reading: str) -> None:
        self._device, self._reading = device, reading
        self.kept: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._device, name)
        return self._read if name == self._reading else found

    def _read(self) -> Any:
        self.kept.append(getattr(self._device, self._reading)())
        return self.kept[-1]


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the accelerometer across the axis over the revolution; a tilt and an offset give a circle."""
    levels = result.evidence["levels"]
    if not levels or not result.estimates:
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


@dataclass(frozen=True)
class ImuMounting(Procedure):
    """A procedure that rotates the table once, in eight steps, and reads the sensor at each stop."""

    result_name, devices, valid_days, plots = NAME, ("servo", "imu"), 180, (plot,)
    reference = "gravity, and the axis about which the table rotates; of the delay, encoder of the servo"

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        config = bench.config
        low, high = config.table.limits_deg
        first_deg = max(low + config.table.approach_deg, min(0.0, high - 360.0))
        if first_deg + 360.0 > high:
            raise too_little_room(bench, "a whole revolution and table.approach_deg")
        column, sign = "xyz".index(config.imu.axis), config.imu.sign
        moves: list[RecordedMove] = []
        levels: list[GravityReading] = []
        # A turntable keeps the rate about its own axis only; the tilt needs all three.
        recorded_bench = copy(bench)
        servo, imu = _Recorded(bench.servo, "read_state"), _Recorded(bench.imu, "read_samples")
        recorded_bench.servo, recorded_bench.imu = cast(Servo, servo), cast(Imu, imu)
        with Turntable(recorded_bench) as table, returning(table) as goto:
            for index in range(STEPS + 1):
                if index == 0:
                    yield moved(0, goto(first_deg))
                else:
                    servo.kept.clear()
                    imu.kept.clear()
                    _observe_rest(bench, table)
                    before_ns = bench.clock.now_ns()
                    move = goto(first_deg + index * 360.0 / STEPS)
                    encoder = [(state.time_ns, config.table.direction * state.position_deg) for state in servo.kept]
                    recorded = _recorded_move(imu.kept, encoder, before_ns, column, sign)
                    if recorded is not None:
                        moves.append(recorded)
                    yield moved(index, move)
                if index < STEPS:
                    readings = np.array([bench.imu.read_gravity_g() for _ in _paced(bench, table)])
                    sigma = float(readings.std(axis=0, ddof=1).max()) / sqrt(READINGS)
                    levels.append(GravityReading(table.rest_deg, readings.mean(axis=0), sigma))
        return evaluate(moves, levels, column=column, sign=sign)


def evaluate(moves: Sequence[RecordedMove], levels: Sequence[GravityReading], *, column: int, sign: int) -> Evaluation:
    """Evaluate the tilt, the levels and the delay.

    ``moves`` and ``levels`` are the measurements over a whole revolution. ``column`` and ``sign`` are the sensor's axis
    that is along the table's axis, and +1 if it points up.
    """
    found = Evaluation(name=NAME, residual_unit="° of tilt")
    found.evidence = {
        "rotations_deg": [move.rotation_deg.tolist() for move in moves],
        "levels": [{"table_deg": level.table_deg, "mean_g": level.mean_g.tolist()} for level in levels],
    }
    if len(moves) < STEPS // 2:
        return found.reject(RejectionCode.TOO_FEW_RECORDED_MOVES, used=len(moves), planned=STEPS)
    total = np.sum([move.rotation_deg for move in moves], axis=0)
    length = float(np.linalg.norm(total))
    axis = total / length  # of a counter-clockwise rotation: upwards
    noise_deg = sqrt(sum(move.sigma_deg**2 for move in moves))
    noise = Contribution("noise and zero of the gyro, summed over the moves", "A", noise_deg, "°", degrees(1 / length))
    tilts = {}
    for i in (i for i in range(3) if i != column):
        tilt_deg = degrees(float(axis[i]))
        gain = Contribution("difference of the scales of two axes of the gyro", "B", AXIS_GAIN_SIGMA, "1", tilt_deg)
        tilts[i] = found.estimate(f"tilt_{'xyz'[i]}", tilt_deg, "°", noise, gain)
    tilt_deg = degrees(float(np.arccos(np.clip(sign * axis[column], -1.0, 1.0))))
    found.residual, found.limit = tilt_deg, MAX_TILT_DEG
    if tilt_deg > MAX_TILT_DEG:
        nearest = int(np.argmax(np.abs(axis)))
        wrong = nearest != column or tilt_deg > 90.0
        right_sign = 1 if axis[nearest] > 0 else -1
        found.reject_if(wrong, RejectionCode.WRONG_AXIS, axis="xyz"[nearest], sign=right_sign)
        found.reject_if(not wrong, RejectionCode.TILT_TOO_LARGE, tilt_deg=tilt_deg, limit_deg=MAX_TILT_DEG)
    found.estimates |= _levels(levels, axis, column, tilts)
    _estimate_delay(found, moves)
    level_deg = hypot(found.estimates["axis_x"].value, found.estimates["axis_y"].value)
    found.reject_above(MAX_LEVEL_DEG, RejectionCode.NOT_LEVEL, level_deg=level_deg)
    return found


def _levels(
    levels: Sequence[GravityReading], axis: NDArray[np.float64], column: int, tilts: Mapping[int, Estimate]
) -> dict[str, Estimate]:
    """Return the accelerometer's zero errors (g), and the deviation of the table's axis from the vertical (°).

    ``tilts`` are those of the sensor, by column.
    """
    angle = np.radians([level.table_deg for level in levels])
    readings = np.array([level.mean_g for level in levels])
    design = np.column_stack([np.ones(angle.size), np.cos(angle), np.sin(angle)])
    (mean, cosine, sine), *_ = np.linalg.lstsq(design, readings, rcond=None)
    noise_g = sqrt(sum(level.sigma_g**2 for level in levels)) / len(levels)
    noise = Contribution("noise of the accelerometer, averaged over the rests", "A", noise_g, "g")
    estimates = {}
    for i, name in enumerate("xyz"):
        # A tilt of 1 rad is seen as 1 g.
        tilt = [replace(one, sensitivity=radians(one.sensitivity)) for one in tilts[i].budget] if i in tilts else ()
        estimates[f"accel_zero_{name}"] = Estimate(float(mean[i] - axis[i]), (noise, *tilt), "g")
    # Gravity's horizontal part rotates in the platter's frame: two axes 90° apart show it.
    a, b = (column + 1) % 3, (column + 2) % 3
    if axis[column] < 0:
        a, b = b, a
    noise = replace(noise, sensitivity=degrees(1.0))
    for name, slope in (("axis_x", cosine[a] - sine[b]), ("axis_y", sine[a] + cosine[b])):
        estimates[name] = Estimate(degrees(float(slope) / 2), (noise,), "° off the vertical")
    return estimates


def _estimate_delay(found: Evaluation, moves: Sequence[RecordedMove]) -> None:
    """Estimate the delay of the gyro's time stamps relative to the encoder's readings."""
    rate = np.concatenate([move.rate_dps for move in moves])
    lead = np.concatenate([move.lead_deg for move in moves])
    # Readings of one rotation share the encoder's error at its rest, so the rotations are the independent data. A
    # vibrating platter comes to rest a little inside the backlash, always on the same side.
    each = [(move.rate_dps @ move.lead_deg) / (move.rate_dps @ move.rate_dps) for move in moves if move.rate_dps.size]
    scatter_s = float(np.std(each, ddof=1)) / sqrt(len(each))
    found.estimate(
        "delay",
        rate @ lead / (rate @ rate),
        "s",
        Contribution("scatter of the moves", "A", scatter_s, "s"),
        Contribution("rest of the platter in the backlash", "B", REST_IN_BACKLASH_DEG, "°", 1 / float(np.median(rate))),
    )


def _observe_rest(bench: Bench, table: Turntable) -> None:
    """Wait at rest until the gyro's zero is measured."""
    for _ in range(5):
        bench.clock.sleep(0.2)
        table.check_still()


def _paced(bench: Bench, table: Turntable) -> Generator[None, None, None]:
    """Pace readings of the accelerometer, and read the gyro's samples so that they do not overflow."""
    for index in range(READINGS):
        yield
        bench.clock.sleep(SPACING_S)
        if index % 10 == 9:
            table.check_still()


def _recorded_move(
    samples: Sequence[ImuSamples], encoder: Sequence[tuple[int, float]], before_ns: int, column: int, sign: int
) -> RecordedMove | None:
    """Return the record of a rotation that began after ``before_ns``; None if samples were lost.

    ``encoder`` has the times of the encoder's readings, and the table's angles.
    """
    if not samples or any(part.lost for part in samples):
        return None
    times = np.concatenate([part.time_ns for part in samples])
    rates = np.concatenate([part.gyro_dps for part in samples])
    at_rest = times < before_ns
    moving = ~at_rest
    if at_rest.sum() < 50 or moving.sum() < 50:
        return None
    noise = float(rates[at_rest].std(axis=0, ddof=1)[column])
    step_s = float(np.diff(times).mean()) * 1e-9
    # The noise of the rotation itself, and that of the zero from the rest before, over the same time.
    span_s, rest_s = float(moving.sum()) * step_s, float(at_rest.sum()) * step_s
    sigma_deg = noise * sqrt(step_s * span_s + step_s * span_s**2 / rest_s)
    net_dps = rates - rates[at_rest].mean(axis=0)
    # The whole rotation gives the scale of the gyro relative to the encoder; what remains during it is the delay.
    read_ns, read_deg = np.array([one for one in encoder if one[0] <= times[-1]]).T
    since = read_ns >= before_ns
    encoder_deg = read_deg[since] - read_deg[~since].mean()
    own_dps = sign * net_dps[:, column]
    gyro_deg = np.interp(read_ns[since], times[moving], np.cumsum(own_dps[moving]) * step_s)
    rate_dps = np.interp(read_ns[since], times, own_dps)
    cruising = np.abs(rate_dps) > MIN_RATE_DPS
    lead_deg = encoder_deg - encoder_deg[-1] / gyro_deg[-1] * gyro_deg
    return RecordedMove(net_dps[moving].sum(axis=0) * step_s, sigma_deg, lead_deg[cruising], rate_dps[cruising])
