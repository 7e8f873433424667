"""What the camera makes of light: its noise, its flat field, and whether light and settings stay as they are.

Photon transfer (EMVA 1288): of a scene at rest the variance σ² of a pixel over frames grows with its mean μ,

    σ² = K·μ + σ_d²,    K levels an electron, σ_d the dark noise, quantisation (1/12) included,

so that a saturated pixel holds 255/K electrons. Flat field: a card that fills the frame shows the lens' loss towards
the corners, beside a gradient that is the lamp's. Drift: the card's brightness over minutes.
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import pictures
from calibration.events import Ask, Progress
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.devices.camera import CameraLocks
from rig.events.events import plain
from rig.views.capture import ImageQuality

NOISE, FLAT_FIELD, DRIFT, SHARPNESS = "camera.noise", "camera.flat_field", "camera.drift", "camera.sharpness"
VALID_DAYS = 180

CARD = "grey-card"
BOARD = "calibration-board upright"
PAIRS = 24
"""Frames of the scene at rest."""
CARD_FRAMES, CARD_SECONDS = 40, 240.0
BINS = 24
MIN_PIXELS = 50
REGIONS = (3, 4)
FRAME_GROUPS = 6
LEVELS = (8.0, 235.0)
"""Between them a pixel is neither cut off at black nor saturated."""
MIN_SPAN = 80.0
"""Grey levels that the scene must span for noise that grows and noise that does not to be told apart."""
BLOCK = 16
MAX_DRIFT_PERCENT = 1.0
MAX_FLICKER = 0.02
MAX_CAST = 0.15
MAX_LOSS = 0.5
MIN_SHARPNESS = 20.0
"""Squared levels: a board in focus has hundreds."""


@dataclass(frozen=True, slots=True)
class CardFrames:
    """A card that fills the frame: brightness of each frame as B, G, R, float64 (n, 3), when it was, and their mean.

    ``seconds`` float64 (n,); ``mean`` float64 (rows, columns), the mean grey level of blocks.
    """

    levels: NDArray[np.float64]
    seconds: NDArray[np.float64]
    mean: NDArray[np.float64]


def live_scene(bench: Bench) -> Generator[Ask | Progress | CalibrationResult, None, CalibrationResult]:
    """Look at the board at rest, and find the camera's noise; yields what to do, and the facts of noise and sharpness.

    Raises
    ------
    DeviceFault, DeviceSilent
        The camera fails.
    """
    when_utc = bench.clock.utc()
    yield Ask(
        "Put the calibration board upright in the middle of the platter, lit as usual; take your hands off.",
        pictures.BOARD_UPRIGHT,
    )
    bench.operator.place(BOARD)
    frames = [bench.camera.capture(bench.clock.now_ns()).image_bgr for _ in range(PAIRS)]
    yield Progress(1.0, f"{PAIRS} frames of the scene at rest")
    device = bench.apparatus("camera")
    view = bench.config.view
    yield sharpness([ImageQuality.of(frame, view).sharpness for frame in frames], when_utc=when_utc, device=device)
    fact = photon_transfer(np.stack(frames), when_utc=when_utc, device=device)
    yield fact
    return fact


def live_card(bench: Bench) -> Generator[Ask | Progress | CalibrationResult, None, CalibrationResult]:
    """Look at a card for some minutes; yields what to do, then the facts of the flat field and of the drift.

    Raises
    ------
    DeviceFault, DeviceSilent
        The camera fails.
    """
    when_utc = bench.clock.utc()
    yield Ask(
        "Hold or stand a plain grey or white card before the camera, so that it fills the frame, lit as usual.",
        pictures.CARD,
    )
    bench.operator.place(CARD)
    locks = bench.camera.read_locks()
    levels, seconds = [], []
    total: NDArray[np.float64] | None = None
    start_ns = bench.clock.now_ns()
    for index in range(CARD_FRAMES):
        image = bench.camera.capture(bench.clock.now_ns()).image_bgr
        levels.append(image.reshape(-1, 3).mean(axis=0))
        seconds.append((bench.clock.now_ns() - start_ns) * 1e-9)
        blocks = _blocks(image)
        total = blocks if total is None else total + blocks
        if index % 10 == 9:
            yield Progress((index + 1) / CARD_FRAMES, f"{seconds[-1]:.0f} of {CARD_SECONDS:g} s of the card")
        bench.clock.sleep(CARD_SECONDS / CARD_FRAMES)
    assert total is not None
    card = CardFrames(np.array(levels), np.array(seconds), total / CARD_FRAMES)
    device = bench.apparatus("camera")
    flat = flat_field(card, when_utc=when_utc, device=device)
    yield flat
    fact = drift(card, locks, bench.camera.read_locks(), when_utc=when_utc, device=device)
    yield fact
    return fact


def photon_transfer(frames: NDArray[np.uint8], *, when_utc: datetime, device: Mapping[str, Any]) -> CalibrationResult:
    """Fit gain and read noise to ``frames`` of a scene at rest, uint8 (n, H, W, 3), and judge them."""
    green = frames[..., 1].astype(np.float64)
    # The lamp's flicker moves all pixels together: each frame is brought to the brightness of all.
    brightness = green.mean(axis=(1, 2))
    green *= (brightness.mean() / np.maximum(brightness, 1e-9))[:, None, None]
    mean, variance = green.mean(axis=0).ravel(), green.var(axis=0, ddof=1).ravel()
    usable = (mean > LEVELS[0]) & (mean < LEVELS[1])
    mean, variance, region = mean[usable], variance[usable], _regions(green.shape[1:])[usable]
    refusals = []
    estimates = {}
    residual = None
    curve: list[list[float]] = []
    low, high = (np.quantile(mean, [0.02, 0.98]).tolist()) if mean.size else (0.0, 0.0)
    if high - low < MIN_SPAN:
        refusals.append(
            f"The scene spans {high - low:.0f} grey levels, {MIN_SPAN:g} are needed: put something black and white "
            "before the camera, and lock an exposure that neither saturates nor darkens."
        )
    else:
        edges = np.linspace(low, high, BINS + 1)
        cell = region * BINS + np.clip(np.digitize(mean, edges) - 1, 0, BINS - 1)
        cells = REGIONS[0] * REGIONS[1] * BINS
        # Pixels, and the sums of their means and variances: float64 (3, regions, bins).
        ones = np.ones_like(mean)
        sums = np.stack([np.bincount(cell, weights, cells) for weights in (ones, mean, variance)])
        sums = sums.reshape(3, -1, BINS)
        whole = sums.sum(axis=1)
        gain, floor = _line(whole, len(frames))
        # Neighbouring pixels are not strangers to each other, and frames not always: the uncertainty is what leaving
        # out a region changes, and what leaving out some frames does.
        covariance = _jackknife([_line(whole - sums[:, r], len(frames)) for r in range(sums.shape[1])])
        covariance += _jackknife(
            [
                _line(np.stack([np.bincount(cell % BINS, weights, BINS) for weights in (ones, few_mean, few)]), count)
                for few_mean, few, count in _without_frames(green, usable)
            ]
        )
        filled = whole[0] >= MIN_PIXELS
        at, noise = whole[1:, filled] / whole[0, filled]
        dark = max(float(floor) - 1 / 12, 0.0)
        curve = np.column_stack([at, noise]).round(4).tolist()
        residual = float(np.max(np.abs(noise - (gain * at + floor)) / noise))
        if gain <= 0:
            refusals.append(
                "The noise does not grow with the light: the frames are processed. Switch noise reduction off."
            )
        else:
            full_well = 255 / float(gain)
            full_well_sigma = full_well / float(gain) * sqrt(covariance[0, 0])
            read = sqrt(dark) / float(gain)
            # σ_r = √floor / K: its derivatives by both.
            slope = np.array([-read / gain, 1 / (2 * gain * max(sqrt(dark), 0.05))])
            estimates = {
                "full_well_e": Estimate(full_well, full_well_sigma, "electrons"),
                "read_noise_e": Estimate(read, sqrt(float(slope @ covariance @ slope)), "electrons"),
            }
    return CalibrationResult(
        name=NOISE,
        estimates=estimates,
        residual=residual,
        limit=None,
        residual_unit="of the variance",
        refusals=tuple(refusals),
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"frames": len(frames), "mean_variance": curve},
    )


def sharpness(values: Sequence[float], *, when_utc: datetime, device: Mapping[str, Any]) -> CalibrationResult:
    """Judge the sharpness of frames of the board: the reference by which a lens that shifted is noticed."""
    mean = float(np.mean(values))
    refusals: tuple[str, ...] = ()
    if mean < MIN_SHARPNESS:
        refusals = (
            f"The board's sharpness is {mean:.1f}, below {MIN_SHARPNESS:g}: focus the lens, and calibrate again.",
        )
    return CalibrationResult(
        name=SHARPNESS,
        estimates={"sharpness": Estimate(mean, float(np.std(values, ddof=1)), "squared levels")},
        residual=None,
        limit=None,
        residual_unit="squared levels",
        refusals=refusals,
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"sharpness": [round(float(value), 2) for value in values]},
    )


def flat_field(card: CardFrames, *, when_utc: datetime, device: Mapping[str, Any]) -> CalibrationResult:
    """Fit the loss of light towards the corners to a card that fills the frame, and judge it."""
    square, x, y = _shading(card.mean.shape)
    design = np.column_stack([np.ones(square.size), x.ravel(), y.ravel(), -square.ravel()])
    values = card.mean.ravel()
    found, *_ = np.linalg.lstsq(design, values, rcond=None)
    residuals = values - design @ found
    level = float(found[0])
    # Neighbouring blocks are not strangers to each other: the uncertainty is what leaving out a region changes.
    region = _regions(card.mean.shape)
    without = (np.linalg.lstsq(design[region != r], values[region != r])[0] for r in range(region.max() + 1))
    sigma = np.array([fit[1:] / max(fit[0], 1e-9) for fit in without]).std(axis=0) * sqrt(region.max())
    residual = float(np.abs(residuals).max()) / max(level, 1e-9)
    loss = float(found[3]) / max(level, 1e-9)
    refusals = []
    if not LEVELS[0] < level < LEVELS[1]:
        refusals.append(
            f"The card's level is {level:.0f}: it is too dark or saturated. Change camera.exposure_us, and calibrate "
            "again."
        )
    if residual > 0.05:
        refusals.append(
            f"Parts of the frame are off the card's smooth shading by {residual:.0%}: it does not fill the frame, is "
            "not plain, or a shadow lies on it."
        )
    if loss > MAX_LOSS:
        refusals.append(
            f"The corners lose {loss:.0%} of the light: something covers the lens, or the zoom is at its end."
        )
    return CalibrationResult(
        name=FLAT_FIELD,
        estimates={
            "vignetting": Estimate(loss, float(sigma[2]), "of the light in the corners"),
            "gradient_x": Estimate(float(found[1]) / max(level, 1e-9), float(sigma[0]), ""),
            "gradient_y": Estimate(float(found[2]) / max(level, 1e-9), float(sigma[1]), ""),
        },
        residual=residual,
        limit=0.05,
        residual_unit="of the level",
        refusals=tuple(refusals),
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"mean": card.mean.round(2).tolist()},
    )


def drift(
    card: CardFrames, before: CameraLocks, after: CameraLocks, *, when_utc: datetime, device: Mapping[str, Any]
) -> CalibrationResult:
    """Judge how steady light and settings are, and the white balance by the card's colour."""
    kept: dict[str, Any] = {"when_utc": when_utc, "device": device, "valid_days": VALID_DAYS}
    evidence = {
        "seconds": card.seconds.round(2).tolist(),
        "levels_bgr": card.levels.round(3).tolist(),
        "locks": plain(after),
    }
    grey = card.levels.mean(axis=1)
    if card.levels.min() < 1.0:
        return CalibrationResult(
            name=DRIFT,
            estimates={},
            residual=None,
            limit=None,
            residual_unit="",
            refusals=(
                "The card is black, or one of its colours: take the cap off the lens, light the card, or raise "
                "camera.exposure_us.",
            ),
            evidence=evidence,
            **kept,
        )
    relative = grey / grey.mean()
    minutes = card.seconds / 60
    design = np.column_stack([np.ones_like(minutes), minutes - minutes.mean()])
    (_, slope), *_ = np.linalg.lstsq(design, relative, rcond=None)
    residuals = relative - design @ (1.0, slope)
    flicker = float(residuals.std(ddof=2))
    slope_sigma = flicker / sqrt(float(((minutes - minutes.mean()) ** 2).sum()))
    blue, green, red = card.levels.mean(axis=0).tolist()
    n = len(grey)
    ratios = {"red_green": card.levels[:, 2] / card.levels[:, 1], "blue_green": card.levels[:, 0] / card.levels[:, 1]}
    estimates = {
        "drift": Estimate(100 * float(slope), 100 * slope_sigma, "% a minute"),
        "flicker": Estimate(flicker, flicker / sqrt(2 * (n - 2)), "of the light"),
        **{name: Estimate(float(r.mean()), float(r.std(ddof=1)) / sqrt(n), "") for name, r in ratios.items()},
    }
    refusals = []
    if before != after:
        refusals.append(f"The camera's settings changed by themselves: {before} became {after}. Lock them in [camera].")
    drifted = 100 * abs(float(slope)) * float(minutes[-1] - minutes[0])
    if drifted - 200 * slope_sigma * float(minutes[-1] - minutes[0]) > MAX_DRIFT_PERCENT:
        refusals.append(
            f"The light drifted by {drifted:.1f} % in {minutes[-1]:.0f} minutes, more than {MAX_DRIFT_PERCENT:g} %: "
            "let the lamps warm up, keep daylight out, and calibrate again."
        )
    if flicker > MAX_FLICKER:
        refusals.append(
            f"The light flickers by {flicker:.1%}, more than {MAX_FLICKER:.0%}: choose an exposure of whole periods "
            "of the mains (10 or 8.33 ms), or a lamp that does not."
        )
    cast = max(abs(red / green - 1), abs(blue / green - 1))
    if cast > MAX_CAST:
        refusals.append(
            f"The card looks coloured: red {red / green:.2f} and blue {blue / green:.2f} of green. Change "
            "camera.white_balance_k until they are near 1, or use a grey card."
        )
    return CalibrationResult(
        name=DRIFT,
        estimates=estimates,
        residual=drifted,
        limit=MAX_DRIFT_PERCENT,
        residual_unit="% in the time of the test",
        refusals=tuple(refusals),
        evidence=evidence,
        **kept,
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return what the fact of noise, sharpness, flat field or drift was fitted to."""
    evidence = fact.evidence
    if not fact.estimates:
        return None
    match fact.name:
        case "camera.noise":
            mean, variance = np.array(evidence["mean_variance"]).T
            gain = 255 / fact.estimates["full_well_e"].value
            floor = (gain * fact.estimates["read_noise_e"].value) ** 2 + 1 / 12
            ends = np.array([0.0, mean.max()])
            return Chart(
                "Photon transfer",
                Axis("mean, grey levels", span=(0.0,)),
                Axis("variance, squared levels", span=(0.0,)),
                [
                    Series("shot and read noise", ends.tolist(), (gain * ends + floor).tolist(), MODEL, False, True),
                    Series("measured", mean.tolist(), variance.tolist()),
                ],
            )
        case "camera.flat_field":
            square, _, _ = _shading(np.array(evidence["mean"]).shape)
            share = np.array(evidence["mean"]) / np.array(evidence["mean"]).max()
            rings = np.round(square * 20) / 20
            at = np.unique(rings)
            means = np.array([share[rings == ring].mean() for ring in at])
            level = float((means + fact.estimates["vignetting"].value * at * means[0]).mean())
            return Chart(
                "Light over the frame, by rings about its middle",
                Axis("squared distance from the middle (corner: 1)"),
                Axis("share of the light"),
                [
                    Series(
                        f"loses {fact.estimates['vignetting'].value:.0%}",
                        [0.0, 1.0],
                        [level, level * (1 - fact.estimates["vignetting"].value)],
                        MODEL,
                        dots=False,
                        curve=True,
                    ),
                    Series("mean of a ring", at.tolist(), means.tolist()),
                ],
            )
        case "camera.drift":
            grey = np.array(evidence["levels_bgr"]).mean(axis=1)
            minutes = np.array(evidence["seconds"]) / 60
            slope = fact.estimates["drift"].value
            return Chart(
                "Brightness of the card",
                Axis("minutes"),
                Axis("off the mean, %"),
                [
                    Series(
                        f"{fact.estimates['drift']}",
                        [minutes[0], minutes[-1]],
                        [slope * float(m - minutes.mean()) for m in (minutes[0], minutes[-1])],
                        MODEL,
                        dots=False,
                        curve=True,
                    ),
                    Series("frames", minutes.tolist(), (100 * (grey / grey.mean() - 1)).tolist()),
                ],
            )
        case _:
            return Chart(
                "Sharpness of the board",
                Axis("frame", whole=True),
                Axis("squared levels", span=(0.0,)),
                [Series("measured", list(range(1, len(evidence["sharpness"]) + 1)), evidence["sharpness"])],
            )


def _regions(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return in which region of the frame a pixel is, int (n,)."""
    rows, columns = (np.arange(side) * parts // side for side, parts in zip(shape, REGIONS, strict=True))
    return (rows[:, None] * REGIONS[1] + columns).ravel()


def _line(sums: NDArray[np.float64], frames: int) -> tuple[float, float]:
    """Return slope and offset of variance over mean; ``sums`` of pixels, means and variances, float64 (3, bins)."""
    count, mean, variance = sums[:, sums[0] >= MIN_PIXELS]
    at, noise = mean / count, variance / count
    # Scatter of a bin's variance: of n pixels and N frames each, relative √(2 / n(N−1)).
    sigma = noise * np.sqrt(2 / (count * (frames - 1)))
    design = np.column_stack([at, np.ones_like(at)]) / sigma[:, None]
    (gain, floor), *_ = np.linalg.lstsq(design, noise / sigma, rcond=None)
    return float(gain), float(floor)


def _jackknife(without: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    """Return the covariance (2, 2) of a line, of which ``without`` has what it is without each part of the data."""
    return np.asarray(np.cov(np.array(without).T, ddof=0) * (len(without) - 1))


def _without_frames(
    green: NDArray[np.float64], usable: NDArray[np.bool_]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], int]]:
    """Yield mean and variance of the usable pixels without each group of frames, and how many frames are left.

    A group is every ``FRAME_GROUPS``-th frame.
    """
    pixels = green.reshape(len(green), -1)[:, usable]
    offset = pixels.mean(axis=0)
    pixels = pixels - offset  # squares of small numbers keep their digits
    total, squares = pixels.sum(axis=0), np.einsum("ij,ij->j", pixels, pixels)
    for group in range(FRAME_GROUPS):
        out = pixels[group::FRAME_GROUPS]
        count = len(green) - len(out)
        mean = (total - out.sum(axis=0)) / count
        variance = (squares - np.einsum("ij,ij->j", out, out) - count * mean**2) / (count - 1)
        yield mean + offset, variance, count


def _shading(shape: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the squared distance of blocks from the middle, 1 in the corner pixels, and x and y, −1 to 1 across."""
    height, width = (side * BLOCK for side in shape)
    y, x = ((np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5) * BLOCK * 2 - np.array([height, width])[:, None, None]) / (
        width - 1
    )
    return (x**2 + y**2) / (1 + ((height - 1) / (width - 1)) ** 2), x, y


def _blocks(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the mean grey level of blocks, float64 (rows, columns); what does not fill a block is left out."""
    height, width = (side // BLOCK * BLOCK for side in image.shape[:2])
    grey = image[:height, :width].mean(axis=2)
    return np.asarray(grey.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(1, 3)), dtype=np.float64)
