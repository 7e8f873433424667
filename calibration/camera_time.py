"""Measure when a frame is exposed: the time from its time stamp to the middle of its exposure.

The table rotates over the same arc in both directions and at several speeds. The image of an object at a table angle is
the same in each pass, apart from noise. A frame that was exposed τ after its stamp shows the angle of that time. At the
speed ω this angle is ahead of the angle at the stamp by ω·τ, so two passes in opposite directions differ by 2·ω·τ.

The frames of the slow passes lie densely over the arc. The angle that a frame shows is the minimum of the sum of
squared differences to these frames. With the trajectory's angle θ at the stamps,

    shown − θ = τ·ω + constant,

where the constant of each direction is the part of the backlash that the trajectory does not contain. The slow frames
are corrected by their own τ·ω. Bands of rows are compared separately: with a rolling shutter τ grows from the top to
the bottom, and one fit to all bands gives the offset of the middle row and the read-out time. Bands with much texture
have more weight. The scatter of fast frames beyond that of slow ones is the jitter, which all bands of a frame share.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.procedure import Ask, Evaluation, Measured, Procedure, lower_end, returning
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode
from rig.charts.xy import MEASURED, MODEL, Axis, Chart, Series
from rig.core.phrases import filled
from rig.devices.camera import Frame
from rig.jobs.desk import Progress
from rig.motion.flight_views import FlightFrames
from rig.motion.trajectory import SLIP_DEG
from rig.motion.turntable import Turntable
from rig.views.description import within

NAME = "camera.time"
BOARD = "calibration-board upright"

ARC_DEG = 50.0  # longer: more frames of each pass; shorter: more benches have room for it within the cable budget
RAMP_S = 0.25
"""Time after the table has reached its speed in which frames are left out, because the platter vibrates."""
SPEEDS = (12.0, 45.0, 90.0)  # the slowest gives sharp references; the time is the slope over the others
"""Speeds of the passes in °/s; the first is that of the reference frames."""
SMALL_PX = 6  # larger: less noise; smaller: fine texture counts, too
"""Side of the squares that frames are averaged over before they are compared."""
MAX_UNCERTAINTY_MS = 1.0  # 0.09° at 90 °/s
MAX_LOST = 0.2  # with more, the computer or the USB port is too slow for views in motion
MAX_ANGLE_DEG = 0.15
"""Largest scatter of the angle that a frame of a slow pass shows."""


COMMON_S = 0.00025
"""Errors that all passes share: the times of encoder readings, and the trajectory."""


NEAR_DEG = 2.0
"""Largest distance, in degrees, of the reference frames that are compared with a frame."""
FEWEST_FRAMES = 40  # fewer leave the scatter, and so the uncertainty, to chance
BANDS = 4  # more bands show the read-out better and have less texture each
TEXTURE_SHARE = 0.1
"""Rows with less than this share of the texture of the best row are left out."""
READOUT_S = 0.03  # as long as a frame: it may be anything
"""Standard uncertainty of the read-out time before it is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """The frames of one rotation at a constant speed.

    ``angle_deg`` and ``rate_dps`` are those of the trajectory at the stamps, ``images`` the small grey frames
    (n, h, w).
    """

    angle_deg: NDArray[np.float64]
    rate_dps: NDArray[np.float64]
    images: NDArray[np.float32]


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


def bands_of(passes: Sequence[Pass]) -> list[tuple[slice, float]]:
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


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Times of the middle row and of each band.

    ``middle_sigma_s`` and ``readout_sigma_s`` (2,) are the contributions to their standard uncertainties: of the
    scatter of the frames, and of what is only known before.
    ``ahead_deg`` (n,) is the angle that the middle row of each frame shows, minus the angle at the frame's stamp.
    """

    middle_s: float
    middle_sigma_s: NDArray[np.float64]
    readout_s: float
    readout_sigma_s: NDArray[np.float64]
    jitter_s: float
    jitter_sigma_s: float
    scatter_deg: float
    rate_dps: NDArray[np.float64]
    ahead_deg: NDArray[np.float64]


def _matches(passes: Sequence[Pass], rows: slice, expected_s: float) -> NDArray[np.float64]:
    """Compare some rows of all frames with the slow passes.

    Returns, for each frame and slow pass, (n, 5): the frame's number, its rate, its rate minus that of the slow pass,
    its direction relative to the slow pass, and the angle that it shows minus that at its stamp.
    """
    means = [float(one.rate_dps.mean()) if len(one.rate_dps) else 0.0 for one in passes]
    slow_dps = min((abs(mean) for mean in means if mean), default=0.0)
    found: list[tuple[float, ...]] = []
    first = 0
    for i, one in enumerate(passes):
        for k, reference in enumerate(passes):
            if k == i or not 0 < abs(means[k]) < 1.3 * slow_dps:
                continue
            down = (means[i] < 0) - (means[k] < 0)
            for j, (angle, rate) in enumerate(zip(one.angle_deg.tolist(), one.rate_dps.tolist(), strict=True)):
                start = angle + expected_s * (rate - means[k])  # near the minimum
                shown = shown_deg(one.images[j, rows], start, reference.images[:, rows], reference.angle_deg)
                if np.isfinite(shown):
                    found.append((first + j, rate, rate - means[k], down, shown - angle))
        first += len(one.angle_deg)
    return np.array(found).reshape(-1, 5)


def fit(passes: Sequence[Pass], bands: Sequence[tuple[slice, float]]) -> Fit | None:
    """Fit the time of the middle row and the read-out time to all bands; None if there are too few frames."""
    times_s = [0.0] * len(bands)
    for _ in range(2):  # the second time the search begins near the minimum
        parts = [_matches(passes, rows, time_s) for (rows, _), time_s in zip(bands, times_s, strict=True)]
        if sum(map(len, parts)) < FEWEST_FRAMES:
            return None
        band = np.repeat(np.arange(len(bands)), [len(part) for part in parts])
        frame, rates, x, down, y = np.concatenate(parts).T
        centre = np.array([centre for _, centre in bands])
        own = band[:, None] == np.arange(len(bands))
        # The times of middle row and read-out, and for each band the backlash between passes in opposite directions.
        design = np.column_stack([x, x * centre[band], -down[:, None] * own])
        known = np.zeros(design.shape[1])
        known[1] = 1 / READOUT_S  # a narrow object does not show the read-out time
        known[2:] = 1 / 90.0  # no slow pass in the other direction
        # Robust least squares: comparisons beyond 2.5 σ count less (Huber), and 1.4826 median deviations are one σ.
        weight = np.ones(len(x))
        for _ in range(5):
            rows = np.vstack([design * weight[:, None], np.diag(known)])
            inverse = np.linalg.inv(rows.T @ rows)
            values = inverse @ (design.T @ (y * np.square(weight)))
            residual = y - design @ values
            spread = np.array([1.4826 * np.median(np.abs(residual[of])) if of.any() else 1.0 for of in own.T])
            spread = np.maximum(spread, 1e-4)[band]
            weight = 1 / (spread * np.maximum(1, np.abs(residual) / (2.5 * spread)))
        times_s = (values[0] + values[1] * centre).tolist()
    # All comparisons of a frame share its jitter, so the scatter is computed over frames.
    number = frame.astype(int)
    scores = np.zeros((number.max() + 1, design.shape[1]))
    np.add.at(scores, number, design * (residual * np.square(weight))[:, None])
    sources = scores.T @ scores, np.diag(np.square(known))
    variances = np.array([np.diag(inverse @ source @ inverse)[:2] for source in sources])
    # The time of each band shows whether the times of the rows lie on a line.
    slopes, sigmas = [], []
    for of in own.T:
        power = float(np.square(x[of] * weight[of]).sum())
        slopes.append(float((x[of] * residual[of] * np.square(weight[of])).sum()) / max(power, 1e-12))
        part = np.bincount(number[of], x[of] * residual[of] * np.square(weight[of]))
        sigmas.append(sqrt(max(float(np.square(part).sum()), 1e-12)) / max(power, 1e-12))
    birge = max(1.0, float(np.square(np.divide(slopes, sigmas)).sum()) / max(len(bands) - 2, 1))
    middle_sigma_s, readout_sigma_s = np.sqrt(birge * variances).T
    # The mean over all comparisons of a frame. Its variance is that of the texture, which does not depend on the speed,
    # and that of the jitter, which grows with the square of the speed: a line shows both.
    precise = np.square(weight)
    total = np.bincount(number, precise)
    seen = total > 0
    mean = np.bincount(number, precise * residual)[seen] / total[seen]
    rate = np.bincount(number, precise * rates)[seen] / total[seen]
    spread_deg = max(1.4826 * float(np.median(np.abs(mean))), 1e-4)
    variance = np.square(mean / np.maximum(1, np.abs(mean) / (2.5 * spread_deg)))  # a frame may have no usable rows
    line = np.column_stack([np.ones_like(rate), np.square(rate)])
    (rest, growth), *_ = np.linalg.lstsq(line, variance, rcond=None)
    # The square of a normal deviation has twice the squared variance; its mean fourth power is three of these.
    noise = np.linalg.inv(line.T @ line)[1, 1] * 2 * float(np.square(variance).mean() / 3)
    jitter_s = sqrt(max(float(growth), 0.0))
    return Fit(
        float(values[0]),
        middle_sigma_s,
        float(values[1]),
        readout_sigma_s,
        jitter_s,
        sqrt(noise) / (2 * jitter_s) if jitter_s > 1e-4 else sqrt(sqrt(noise)),
        sqrt(max(float(rest), 0.0)),
        rate,
        mean + values[0] * rate,
    )


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the angle by which frames are ahead of the angle at their stamps, over the speed."""
    if not result.estimates or "rates_dps" not in result.evidence:
        return None
    rates, ahead = result.evidence["rates_dps"], result.evidence["ahead_deg"]
    slope = result.evidence["stamp_to_middle_ms"] * 1e-3
    ends = [min(rates), max(rates)]
    return Chart(
        "Angle at the middle row of a frame, minus the angle at its time stamp",
        Axis("speed, °/s"),
        Axis("angle, °"),
        [
            Series(filled("{:.2f} ms", slope * 1e3), ends, [slope * e for e in ends], MODEL, False, True),
            Series("frames", rates, ahead, MEASURED),
        ],
    )


@dataclass(frozen=True)
class CameraTime(Procedure):
    """A procedure that measures the camera's time by rotating an object at several speeds in both directions."""

    result_name, devices, plots = NAME, ("servo", "camera", "exposure"), (plot,)
    reference = "encoder of the servo; clock of the computer"
    valid_days = 90
    """Three months, because time stamps depend on camera, driver, USB port and kernel."""
    thing: str = BOARD
    """The object that the simulated bench puts on the table: the board, or an object with texture."""

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        found = Evaluation(name=NAME, residual_unit="°", limit=MAX_ANGLE_DEG)
        config = bench.config
        if config.camera.exposure_us is None:
            return found.reject(RejectionCode.EXPOSURE_NOT_LOCKED)
        yield Ask(
            "Put the board upright in the middle of the platter, or any object with texture. Take your hands off.",
        )
        bench.place(self.thing)
        cruise_dps = config.table.velocity_dps
        # Several speeds separate the time (an angle that grows with the speed) from an error of the angle.
        speeds_dps = sorted({*(speed for speed in SPEEDS if speed < cruise_dps), cruise_dps})
        passes: list[Pass] = []
        lost = frames = 0
        with Turntable(bench) as table, returning(table) as goto:
            length_deg = ARC_DEG + 2 * _ramp_deg(max(speeds_dps), bench)
            middle_deg = lower_end(bench, table.rest_deg, length_deg) + length_deg / 2
            flights = FlightFrames(bench, table)
            worst_deg = 0.0
            for number, speed in enumerate(speeds_dps):
                half_deg = ARC_DEG / 2 + _ramp_deg(speed, bench)
                ends_deg = middle_deg - half_deg, middle_deg + half_deg
                goto(ends_deg[0])
                # Both directions, because backlash and an off-centre object look like a time in one of them.
                for way in (1, -1):
                    taken = _take_pass(table, flights, bench, ends_deg, speed, way)
                    if taken is None:
                        return found.reject(RejectionCode.STAMPS_UNUSABLE)
                    one, residual_deg, missing = taken
                    worst_deg, lost, frames = max(worst_deg, residual_deg), lost + missing, frames + len(one.angle_deg)
                    passes.append(one)
                yield Progress((number + 1) / len(speeds_dps), f"{speed:.0f} °/s in both directions")
        # Check what the fit itself does not see: a slip, and lost frames.
        share = lost / max(lost + frames, 1)
        found = evaluate(passes, exposure_ms=config.camera.exposure_us * 1e-3, fastest_dps=max(speeds_dps), bench=bench)
        found.reject_if(worst_deg > SLIP_DEG, RejectionCode.PLATTER_SLIPPED, residual_deg=worst_deg)
        found.reject_above(MAX_LOST, RejectionCode.FRAMES_LOST, lost=share)
        if found.estimates:
            sigma = sqrt(max(share, 1 / (frames + 1)) / (frames + 1))
            found.estimate(
                "lost_frames", share, "", Contribution("chance in the number of lost frames", "A", sigma, "")
            )
        return found


def _ramp_deg(speed_dps: float, bench: Bench) -> float:
    """Return the rotation until the table has its speed and no longer vibrates."""
    return speed_dps**2 / (2 * bench.config.table.acceleration_dps2) + speed_dps * RAMP_S


def _take_pass(
    table: Turntable, flights: FlightFrames, bench: Bench, ends_deg: tuple[float, float], speed_dps: float, way: int
) -> tuple[Pass, float, int] | None:
    """Rotate over the arc; return the frames at constant speed, the trajectory's residual, and the lost frames.

    None if the time stamps cannot be used.
    """
    flights.recorder = table.recorder()  # each pass has a trajectory of its own
    stamps: list[int] = []
    images: list[NDArray[np.float32]] = []
    usable = True

    def take(frame: Frame) -> None:
        nonlocal usable
        usable = usable and frame.stamped
        if not frame.repeated:
            stamps.append(frame.exposed_ns)
            images.append(small(frame.image_bgr, bench))

    table.fly(ends_deg[1 if way > 0 else 0], flights.flight(take, ends_deg, speed_dps))
    trajectory = flights.recorder.fit()
    if not usable or trajectory is None:
        return None
    # Use frames at constant speed only, after the platter has stopped vibrating, with stamps in rhythm.
    motion = trajectory.at(stamps)
    steady = np.abs(np.abs(motion.rate_dps) - speed_dps) < 0.1 * speed_dps + 1.0
    begun = np.flatnonzero(steady)
    if len(begun):
        steady &= np.array(stamps) > np.array(stamps)[begun[0]] + round(RAMP_S * 1e9)
    used = np.flatnonzero(steady & ~np.isin(stamps, list(flights.irregular_ns())))
    # Gaps of whole periods between the used frames are lost frames.
    steps = np.diff(np.array(stamps)[used]) * 1e-9 / flights.stream.period_s if len(used) > 1 else np.zeros(0)
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
    """Return the region in grey, averaged over squares, with mean 0: smooth enough to interpolate over angles.

    It is not smoothed across rows, because with a rolling shutter rows show different times.
    """
    grey = cv2.cvtColor(within(image_bgr, bench.config.view.roi), cv2.COLOR_BGR2GRAY)
    size = max(grey.shape[1] // SMALL_PX, 8), max(grey.shape[0] // SMALL_PX, 8)
    reduced = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32), (9, 1), 1.0)
    return np.asarray(reduced - reduced.mean(), np.float32)


def evaluate(passes: Sequence[Pass], *, exposure_ms: float, fastest_dps: float, bench: Bench) -> Evaluation:
    """Fit offset, jitter and read-out time to passes at several speeds."""
    found = Evaluation(name=NAME, residual_unit="°", limit=MAX_ANGLE_DEG)
    # The rows of the region, as shares of the frame's height; the time counts for the frame's middle row.
    height, roi = bench.config.camera.height, bench.config.view.roi
    top, span = (0.0, 1.0) if roi is None else (roi[1] / height, roi[3] / height)
    bands = [(rows, top + span * centre - 0.5) for rows, centre in bands_of(passes)]
    times = fit(passes, bands) if bands else None
    if times is None:
        used = sum(len(one.angle_deg) for one in passes)
        return found.reject(RejectionCode.TOO_FEW_FRAMES, used=used, needed=FEWEST_FRAMES)
    middle_s, readout_s, scatter_deg = times.middle_s, times.readout_s, times.scatter_deg
    jitter_s = times.jitter_s
    found.residual = scatter_deg

    def budget(sigma_s: NDArray[np.float64]) -> tuple[Contribution, Contribution]:
        scatter_s, known_s = sigma_s.tolist()
        return (
            Contribution("scatter of the frames", "A", scatter_s * 1e3, "ms"),
            Contribution("backlash and read-out time, where frames do not show them", "B", known_s * 1e3, "ms"),
        )

    # The scatter of the passes does not show errors that all of them share.
    common = Contribution("times of the encoder's readings, and trajectory", "B", COMMON_S * 1e3, "ms")
    chance = Contribution("chance in the scatter of the frames", "A", times.jitter_sigma_s * 1e3, "ms")
    offset = found.estimate("offset", middle_s * 1e3, "ms", *budget(times.middle_sigma_s), common)
    found.estimate("jitter", jitter_s * 1e3, "ms", chance)
    found.estimate("readout", readout_s * 1e3, "ms", *budget(times.readout_sigma_s))
    found.proposed = {
        "camera_time.offset_ms": round(middle_s * 1e3, 4),
        "camera_time.uncertainty_ms": round(offset.uncertainty, 4),
        "camera_time.jitter_ms": round(jitter_s * 1e3, 4),
        "camera_time.readout_ms": round(max(readout_s, 0.0) * 1e3, 3),
    }
    found.evidence = {
        "rates_dps": np.round(times.rate_dps, 2).tolist(),
        "ahead_deg": np.round(times.ahead_deg, 4).tolist(),
        "stamp_to_middle_ms": middle_s * 1e3,
        "exposure_ms": exposure_ms,
    }
    # Reject: first too little texture, then what a view in motion would suffer from.
    limit_deg = bench.config.view.max_angle_sigma_deg
    found.reject_if(
        scatter_deg > MAX_ANGLE_DEG,
        RejectionCode.TOO_LITTLE_TEXTURE,
        uncertainty_deg=scatter_deg,
        needed_deg=MAX_ANGLE_DEG,
    )
    found.reject_above(MAX_UNCERTAINTY_MS, RejectionCode.FRAME_TIME_UNCERTAIN, uncertainty_ms=offset.uncertainty)
    jitter = {"jitter_deg": jitter_s * fastest_dps, "jitter_ms": jitter_s * 1e3, "speed_dps": fastest_dps}
    found.reject_above(limit_deg, RejectionCode.FRAME_JITTER_TOO_LARGE, **jitter)
    return found
