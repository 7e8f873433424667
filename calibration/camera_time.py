"""Measure when a frame is exposed: the time from its time stamp to the middle of its exposure.

The table turns over the same arc in both directions and at several speeds. The image of an object at a table angle is
the same in each pass, apart from noise. A frame that was exposed τ after its stamp shows the angle of that time, so at
the speed ω it seems to be ahead by ω·τ of the angle at its stamp: two passes in opposite directions differ by 2·ω·τ.

The angle that a frame shows is where the sum of squared differences to the frames of the slow passes, which lie densely
over the arc, has its minimum. With the trajectory's angle θ at the stamps,

    shown − θ = τ·ω + constant,

where the constant of each direction is what the trajectory does not know of the backlash. The slow frames are moved by
their own τ·ω, and the fit is repeated until τ does not change. Bands of rows give a τ each: with a rolling shutter it
grows from the top to the bottom. The scatter of fast frames beyond that of slow ones is the jitter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration import pictures
from calibration.camera_light import BOARD
from calibration.procedure import Ask, Evaluation, Measured, Procedure, Progress, lower_end, returning
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MEASURED, MODEL, Axis, Chart, Series
from rig.motion.trajectory import SLIP_DEG
from rig.motion.turntable import Flight, Turntable
from rig.views.description import within
from rig.views.stream import FrameStream, irregular_stamps

NAME = "camera.time"

ARC_DEG = 50.0
RAMP_S = 0.25
"""Frames within so much time after the table has reached its speed are left out: the platter rings."""
SPEEDS = (12.0, 45.0, 90.0)
"""Speeds of the passes in °/s; the first is that of the reference frames."""
SMALL_PX = 6
"""Side of the squares that frames are averaged over before they are compared."""
NEAR_DEG = 2.0
"""Reference frames within so many degrees are compared with a frame."""
FEWEST_FRAMES = 40
BANDS = 4
TEXTURE_SHARE = 0.1
"""Rows with less than this share of the texture of the best row are left out."""
MAX_UNCERTAINTY_MS = 1.0
MAX_LOST = 0.2
MAX_ANGLE_DEG = 0.15
"""Largest scatter of the angle that a frame of a slow pass shows."""


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """Frames of one turn at a constant speed.

    ``angle_deg`` and ``rate_dps`` are those of the trajectory at the stamps, ``images`` the small grey frames
    (n, h, w).
    """

    angle_deg: NDArray[np.float64]
    rate_dps: NDArray[np.float64]
    images: NDArray[np.float32]


def plot(result: CalibrationResult) -> Chart | None:
    """Return how far frames are ahead of the angle at their stamps, over the speed."""
    if not result.estimates or "rates_dps" not in result.evidence:
        return None
    rates, ahead = result.evidence["rates_dps"], result.evidence["ahead_deg"]
    slope = result.evidence["stamp_to_middle_ms"] * 1e-3
    ends = [min(rates), max(rates)]
    return Chart(
        "What frames show, ahead of the angle at their time stamps",
        Axis("speed, °/s"),
        Axis("angle, °"),
        [
            Series(f"{slope * 1e3:.2f} ms", ends, [slope * e for e in ends], MODEL, False, True),
            Series("frames", rates, ahead, MEASURED),
        ],
    )


@dataclass(frozen=True)
class CameraTime(Procedure):
    """Measure the camera's time by turning an object with texture at several speeds in both directions."""

    names, title, devices, plots = (NAME,), "time of the frames", ("servo", "camera", "exposure"), (plot,)
    valid_days = 90
    """Time stamps depend on camera, driver and USB port; three months find a changed kernel."""
    thing: str = BOARD
    """What the simulated bench puts on the table: the board, or an object with texture."""
    rounds: int = 1

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        found = Evaluation(name=NAME, residual_unit="°", limit=MAX_ANGLE_DEG)
        config = bench.config
        if config.camera.exposure_us is None:
            yield found.reject(RejectionCode.EXPOSURE_NOT_LOCKED)
            return
        yield Ask(
            "Put the board upright in the middle of the platter, or any object with texture. Take your hands off.",
            pictures.BOARD_UPRIGHT,
        )
        bench.operator.place(self.thing)
        speeds = [speed for speed in SPEEDS if speed < config.table.velocity_dps] + [config.table.velocity_dps]
        passes: list[Pass] = []
        lost = frames = 0
        with Turntable(bench) as table, returning(table) as goto:
            length_deg = ARC_DEG + 2 * _ramp_deg(max(speeds), bench)
            middle_deg = lower_end(bench, table.rest_deg, length_deg) + length_deg / 2
            stream = FrameStream(bench.camera, bench.clock)
            worst_deg = 0.0
            turns = [speed for _ in range(self.rounds) for speed in sorted({*speeds, speeds[0]})]
            for number, speed in enumerate(turns):
                half_deg = ARC_DEG / 2 + _ramp_deg(speed, bench)
                ends_deg = middle_deg - half_deg, middle_deg + half_deg
                goto(ends_deg[0])
                for way in (1, -1):
                    taken = _take_pass(table, stream, bench, ends_deg, speed, way)
                    if taken is None:
                        yield found.reject(RejectionCode.STAMPS_UNUSABLE)
                        return
                    one, residual_deg, missing = taken
                    worst_deg, lost, frames = max(worst_deg, residual_deg), lost + missing, frames + len(one.angle_deg)
                    passes.append(one)
                yield Progress((number + 1) / len(turns), f"{speed:.0f} °/s in both directions")
        share = lost / max(lost + frames, 1)
        found = evaluate(passes, exposure_ms=config.camera.exposure_us * 1e-3, fastest_dps=max(speeds), bench=bench)
        found.reject_if(worst_deg > SLIP_DEG, RejectionCode.PLATTER_SLIPPED, residual_deg=worst_deg)
        found.reject_if(share > MAX_LOST, RejectionCode.FRAMES_LOST, lost=share, limit=MAX_LOST)
        if found.estimates:
            found.estimate("lost_frames", share, sqrt(max(share, 1 / (frames + 1)) / (frames + 1)), "")
        yield found


def _ramp_deg(speed_dps: float, bench: Bench) -> float:
    """Return the rotation until the table has its speed and does not ring any more."""
    return speed_dps**2 / (2 * bench.config.table.acceleration_dps2) + speed_dps * RAMP_S


def _take_pass(
    table: Turntable, stream: FrameStream, bench: Bench, ends_deg: tuple[float, float], speed_dps: float, way: int
) -> tuple[Pass, float, int] | None:
    """Turn over the arc and return the frames at constant speed, the trajectory's residual, and lost frames.

    None if the time stamps cannot be used.
    """
    recorder = table.recorder()
    stamps: list[int] = []
    images: list[NDArray[np.float32]] = []
    usable = True

    def each() -> None:
        nonlocal usable
        frame = stream.next(table.collect_gyro)
        if frame is None:
            return
        usable = usable and frame.stamped
        if not frame.repeated:
            stamps.append(frame.stamp_ns)
            images.append(small(frame.image_bgr, bench))

    table.fly(ends_deg[1 if way > 0 else 0], Flight(each, ends_deg, recorder, speed_dps))
    trajectory = recorder.fit()
    if not usable or trajectory is None:
        return None
    off = irregular_stamps(stamps, stream.period_s, bench.config.camera_time.jitter_ms)
    motion = trajectory.at(stamps)
    steady = np.abs(np.abs(motion.rate_dps) - speed_dps) < 0.1 * speed_dps + 1.0
    begun = np.flatnonzero(steady)
    if len(begun):
        steady &= np.array(stamps) > np.array(stamps)[begun[0]] + round(RAMP_S * 1e9)
    used = np.flatnonzero(steady & ~off)
    steps = np.diff(np.array(stamps)[used]) * 1e-9 / stream.period_s if len(used) > 1 else np.zeros(0)
    missing = int((np.rint(steps) - 1).clip(0).sum())
    shape = (0, 1, 1) if not len(used) else (len(used), *images[0].shape)
    return (
        Pass(
            motion.angle_deg[used],
            motion.rate_dps[used],
            np.array([images[i] for i in used], np.float32).reshape(shape),
        ),
        trajectory.residual_deg,
        missing,
    )


def small(image_bgr: NDArray[np.uint8], bench: Bench) -> NDArray[np.float32]:
    """Return the region in grey, averaged over squares, with mean 0: smooth enough to interpolate over angles."""
    grey = cv2.cvtColor(within(image_bgr, bench.config.view.roi), cv2.COLOR_BGR2GRAY)
    size = max(grey.shape[1] // SMALL_PX, 8), max(grey.shape[0] // SMALL_PX, 8)
    reduced = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 1.0)
    return np.asarray(reduced - reduced.mean(), np.float32)


def shown_deg(
    frame: NDArray[np.float32], angle_deg: float, images: NDArray[np.float32], angles_deg: NDArray[np.float64]
) -> float:
    """Return the angle that a frame shows: the minimum of a parabola through the differences to reference frames.

    nan if the minimum is not within the reference frames near ``angle_deg``.
    """
    centre_deg = angle_deg
    for _ in range(2):
        near = np.flatnonzero(np.abs(angles_deg - centre_deg) < NEAR_DEG)
        if len(near) < 6:
            return float("nan")
        away = angles_deg[near] - centre_deg
        cost = np.square(images[near] - frame).mean(axis=(1, 2))
        best = away[int(cost.argmin())]
        close = np.abs(away - best) < NEAR_DEG / 2
        if close.sum() < 5:
            return float("nan")
        a, b, _ = np.polyfit(away[close] - best, cost[close], 2)
        if a <= 0 or abs(shift := -b / (2 * a)) > NEAR_DEG / 2:
            return float("nan")
        centre_deg += float(best + shift)
    return centre_deg


def evaluate(passes: Sequence[Pass], *, exposure_ms: float, fastest_dps: float, bench: Bench) -> Evaluation:
    """Fit offset, jitter and read-out time to passes at several speeds."""
    found = Evaluation(name=NAME, residual_unit="°", limit=MAX_ANGLE_DEG)
    bands = _bands(passes)
    whole = _fit(passes, slice(bands[0][0].start, bands[-1][0].stop)) if bands else None
    if whole is None:
        used = sum(len(one.angle_deg) for one in passes)
        return found.reject(RejectionCode.TOO_FEW_FRAMES, used=used, needed=FEWEST_FRAMES)
    tau_s, sigma_s, scatter_deg, jitter_s, jitter_sigma_s, rates, ahead = whole
    parts = [(centre, _fit(passes, rows)) for rows, centre in bands]
    seen = [(centre, part[0], max(part[1], 1e-5)) for centre, part in parts if part is not None]
    x, y, w = (np.array(column) for column in zip(*seen, strict=True))
    # The rows of the region, as shares of the frame's height; the time counts for the frame's middle row.
    height, roi = bench.config.camera.height, bench.config.view.roi
    top, span = (0.0, 1.0) if roi is None else (roi[1] / height, roi[3] / height)
    design = np.column_stack([np.ones_like(x), top + span * x - 0.5]) / w[:, None]
    # A read-out takes at most a frame period: known before, so that a narrow object does not leave it open.
    known = np.array([0.0, 1 / READOUT_S**2])
    covariance = np.linalg.inv(design.T @ design + np.diag(known))
    values = covariance @ (design.T @ (y / w))
    birge = max(1.0, float(np.square(y / w - design @ values).sum()) / max(len(x) - 2, 1))
    middle_s, readout_s = float(values[0]), float(values[1])
    sigma_s, readout_sigma_s = (float(one) for one in np.sqrt(birge * np.diag(covariance)))
    sigma_s = sqrt(sigma_s**2 + COMMON_S**2)
    found.residual = scatter_deg
    found.estimate("offset", middle_s * 1e3, sigma_s * 1e3, "ms")
    found.estimate("jitter", jitter_s * 1e3, jitter_sigma_s * 1e3, "ms")
    found.estimate("readout", readout_s * 1e3, readout_sigma_s * 1e3, "ms")
    found.proposed = {
        "camera_time.offset_ms": round(middle_s * 1e3, 4),
        "camera_time.uncertainty_ms": round(sigma_s * 1e3, 4),
        "camera_time.jitter_ms": round(jitter_s * 1e3, 4),
        "camera_time.readout_ms": round(max(readout_s, 0.0) * 1e3, 3),
    }
    found.evidence = {
        "rates_dps": np.round(rates, 2).tolist(),
        "ahead_deg": np.round(ahead, 4).tolist(),
        "stamp_to_middle_ms": tau_s * 1e3,
        "rows": [round(top + span * float(centre), 3) for centre in x],
        "rows_ms": [round(float(value) * 1e3, 3) for value in y],
        "exposure_ms": exposure_ms,
    }
    limit_deg = bench.config.view.max_angle_sigma_deg
    found.reject_if(
        scatter_deg > MAX_ANGLE_DEG,
        RejectionCode.TOO_LITTLE_TEXTURE,
        uncertainty_deg=scatter_deg,
        needed_deg=MAX_ANGLE_DEG,
    )
    found.reject_if(
        sigma_s * 1e3 > MAX_UNCERTAINTY_MS,
        RejectionCode.FRAME_TIME_UNCERTAIN,
        uncertainty_ms=sigma_s * 1e3,
        limit_ms=MAX_UNCERTAINTY_MS,
    )
    found.reject_if(
        jitter_s * fastest_dps > limit_deg,
        RejectionCode.FRAME_JITTER_TOO_LARGE,
        jitter_ms=jitter_s * 1e3,
        speed_dps=fastest_dps,
        jitter_deg=jitter_s * fastest_dps,
        limit_deg=limit_deg,
    )
    return found


READOUT_S = 0.03
"""Standard uncertainty of the read-out time before it is measured."""
COMMON_S = 0.0005
"""What all passes have in common: the times of encoder readings, and rows that show another part of the object."""


def _bands(passes: Sequence[Pass]) -> list[tuple[slice, float]]:
    """Return bands of rows with about as much texture each, and the middle of each as a share of the height.

    Rows whose image hardly changes with the angle are left out.
    """
    longest = max(passes, key=lambda one: len(one.angle_deg))
    if len(longest.angle_deg) < FEWEST_FRAMES // 2:
        return []
    energy = np.square(longest.images[3:] - longest.images[:-3]).mean(axis=(0, 2))
    energy = np.clip(energy - np.percentile(energy, 10), 0, None)
    rows = np.flatnonzero(energy > TEXTURE_SHARE * energy.max())
    if not len(rows):
        return []
    energy = energy[: rows[-1] + 1]
    energy[: rows[0]] = 0
    total = np.cumsum(energy) / energy.sum()
    edges = np.searchsorted(total, np.linspace(0, 1, BANDS + 1)[1:-1]) + 1
    edges = np.unique(np.concatenate([[rows[0]], edges, [rows[-1] + 1]]))
    height = longest.images.shape[1]
    return [
        (slice(int(a), int(b)), float((energy[a:b] * (np.arange(a, b) + 0.5)).sum() / energy[a:b].sum() / height))
        for a, b in pairwise(edges)
        if energy[a:b].sum() > 0
    ]


def _fit(
    passes: Sequence[Pass], rows: slice
) -> tuple[float, float, float, float, float, NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit τ to some rows of the frames.

    Returns τ and its standard uncertainty, the scatter of slow frames, the jitter and its uncertainty, and rates and
    deviations of all frames; None if there are too few.
    """
    means = [float(one.rate_dps.mean()) if len(one.rate_dps) else 0.0 for one in passes]
    slow_dps = min((abs(mean) for mean in means if mean), default=0.0)
    references = [k for k, mean in enumerate(means) if mean and abs(mean) < 1.3 * slow_dps]
    rows_of: list[tuple[float, float, float, float]] = []  # own rate, rate and direction against the reference, shift
    expected_s = 0.0
    for _ in range(2):  # the second time the search begins near the minimum
        rows_of.clear()
        for i, one in enumerate(passes):
            for k in references:
                if k == i:
                    continue
                reference, against = passes[k], (means[i] < 0) - (means[k] < 0)
                for image, angle, rate in zip(one.images[:, rows], one.angle_deg, one.rate_dps, strict=True):
                    start = angle + expected_s * (rate - means[k])
                    shown = shown_deg(image, float(start), reference.images[:, rows], reference.angle_deg)
                    if np.isfinite(shown):
                        rows_of.append((rate, rate - means[k], float(against), shown - angle))
        if len(rows_of) < FEWEST_FRAMES:
            return None
        rates, x, down, y = (np.array(column) for column in zip(*rows_of, strict=True))
        weight = np.ones(len(x))
        for _ in range(4):
            design = np.column_stack([x, -down])
            weighted = design * weight[:, None]
            values, *_ = np.linalg.lstsq(weighted, y * weight, rcond=None)
            residual = y - design @ values
            spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
            weight = 1 / np.maximum(1, np.abs(residual) / (2.5 * spread))
        expected_s = float(values[0])
    # Each frame is compared with several references, so that the residuals are fewer than they seem.
    repeated = max(len(references) - 0.5, 1.0)
    variance = np.square(residual * weight)
    covariance = np.linalg.inv(weighted.T @ weighted) * float(variance.mean()) * repeated
    line = np.column_stack([np.ones_like(x), np.square(rates)])
    (rest, growth), *_ = np.linalg.lstsq(line, variance, rcond=None)
    noise = np.linalg.inv(line.T @ line)[1, 1] * 2 * float(np.square(variance).mean() / 3) * repeated
    jitter_s = sqrt(max(float(growth), 0.0))
    jitter_sigma_s = sqrt(noise) / (2 * jitter_s) if jitter_s > 1e-4 else sqrt(sqrt(noise))
    return (
        float(values[0]),
        sqrt(covariance[0, 0]),
        sqrt(max(float(rest), 0.0)),
        jitter_s,
        jitter_sigma_s,
        rates,
        y + float(values[0]) * (rates - x) + down * values[1],
    )
