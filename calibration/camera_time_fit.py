"""The fit of `rig calibrate camera-time`: compares frames of several passes, and fits the times of their rows.

`calibration.camera_time` describes the method.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import numpy as np
from numpy.typing import NDArray

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

    ``ahead_deg`` (n,) is the angle that the middle row of each frame shows, minus the angle at the frame's stamp.
    """

    middle_s: float
    middle_sigma_s: float
    readout_s: float
    readout_sigma_s: float
    jitter_s: float
    jitter_sigma_s: float
    scatter_deg: float
    rows_s: list[float]
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
        design = np.column_stack([x, x * centre[band], -down[:, None] * own])
        known = np.zeros(design.shape[1])
        known[1] = 1 / READOUT_S  # a narrow object does not show the read-out time
        known[2:] = 1 / 90.0  # no slow pass in the other direction
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
    covariance = inverse @ (scores.T @ scores + np.diag(np.square(known))) @ inverse
    # The time of each band shows whether the times of the rows lie on a line.
    slopes, sigmas = [], []
    for of in own.T:
        power = float(np.square(x[of] * weight[of]).sum())
        slopes.append(float((x[of] * residual[of] * np.square(weight[of])).sum()) / max(power, 1e-12))
        part = np.bincount(number[of], x[of] * residual[of] * np.square(weight[of]))
        sigmas.append(sqrt(max(float(np.square(part).sum()), 1e-12)) / max(power, 1e-12))
    birge = max(1.0, float(np.square(np.divide(slopes, sigmas)).sum()) / max(len(bands) - 2, 1))
    middle_sigma_s, readout_sigma_s = np.sqrt(birge * np.diag(covariance)[:2]).tolist()
    # The mean over all comparisons of a frame.
    precise = np.square(weight)
    total = np.bincount(number, precise)
    seen = total > 0
    mean = np.bincount(number, precise * residual)[seen] / total[seen]
    rate = np.bincount(number, precise * rates)[seen] / total[seen]
    spread_deg = max(1.4826 * float(np.median(np.abs(mean))), 1e-4)
    variance = np.square(mean / np.maximum(1, np.abs(mean) / (2.5 * spread_deg)))  # a frame may have no usable rows
    line = np.column_stack([np.ones_like(rate), np.square(rate)])
    (rest, growth), *_ = np.linalg.lstsq(line, variance, rcond=None)
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
        [float(value) + slope for value, slope in zip(times_s, slopes, strict=True)],
        rate,
        mean + values[0] * rate,
    )
