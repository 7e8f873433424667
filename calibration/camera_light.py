"""Measure the camera's response to light: noise, sharpness and flat field, and the stability of light and settings.

Photon transfer (EMVA 1288): in a scene at rest the variance σ² of a pixel over frames grows with its mean μ,

    σ² = K·μ + σ_d²,    K levels per electron, σ_d the dark noise including quantisation (1/12),

so that a saturated pixel holds 255/K electrons. Flat field: a card that fills the frame shows the lens' loss towards
the corners, and a gradient of the lamp. Drift: the card's brightness over minutes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from calibration.procedure import Ask, Evaluation, Measured, Procedure
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.json_form import plain
from rig.core.phrases import percent
from rig.devices.camera import CameraLocks
from rig.jobs.desk import Progress
from rig.views.capture import ImageQuality

NOISE, FLAT_FIELD, DRIFT, SHARPNESS = "camera.noise", "camera.flat_field", "camera.drift", "camera.sharpness"

CARD = "grey-card"
BOARD = "calibration-board upright"
PAIRS = 24  # more: smaller uncertainty of the noise, at a frame each
"""Frames of the scene at rest."""
HANDS_S = 1.0
"""Time from the operator's answer to the first frame: the bench is quiet again, and no frame shows the former scene."""
# a lamp that warms up drifts over minutes; more frames only make the operator wait
CARD_FRAMES, CARD_SECONDS = 40, 240.0
# Photon transfer: bins of brightness, in each region of the frame, because a lens darkens the corners. More bins and
# regions have fewer pixels each.
BINS = 24
MIN_PIXELS = 50
REGIONS = (3, 4)
# Leaving out groups of frames gives the uncertainty: regions alone had given a too small one
# (docs/explanation/calibration.md).
FRAME_GROUPS = 6
LEVELS = (8.0, 235.0)
"""Grey levels between which a pixel is neither black nor saturated."""
MIN_SPAN = 80.0
"""Grey levels that the scene must span to separate noise that grows with light from noise that does not."""
BLOCK = 16  # px: averages the noise; vignetting changes slowly over the frame
# Limits of a scene that is a grey card in steady, white light. Larger: a shadow on the card is measured as the lens;
# smaller: lamps of a laboratory fail.
MAX_UNEVEN = 0.05
MAX_DRIFT_PERCENT = 1.0
MAX_FLICKER = 0.02
MAX_CAST = 0.15
MAX_LOSS = 0.5
MIN_SHARPNESS = 20.0
"""Smallest sharpness in squared levels; a board in focus has hundreds."""


@dataclass(frozen=True, slots=True)
class CardFrames:
    """A card that fills the frame: brightness of each frame as B, G, R, float64 (n, 3), its times, and the mean frame.

    ``seconds`` float64 (n,); ``mean`` float64 (rows, columns), the mean grey level of blocks.
    """

    levels: NDArray[np.float64]
    seconds: NDArray[np.float64]
    mean: NDArray[np.float64]


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the data of noise, sharpness, flat field or drift, and of the fit."""
    evidence = result.evidence
    if not result.estimates:
        return None
    match result.name:
        case "camera.noise":
            # Shot noise grows with the light, read noise does not: a straight line, with 1/12 for the rounding to
            # levels.
            mean, variance = np.array(evidence["mean_variance"]).T
            gain = 255 / result.estimates["full_well_e"].value
            floor = (gain * result.estimates["read_noise_e"].value) ** 2 + 1 / 12
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
            # Lenses lose light with the square of the distance from the middle, nearly.
            square, _, _ = _shading(np.array(evidence["mean"]).shape)
            share = np.array(evidence["mean"]) / np.array(evidence["mean"]).max()
            rings = np.round(square * 20) / 20
            at = np.unique(rings)
            means = np.array([share[rings == ring].mean() for ring in at])
            loss = result.estimates["vignetting"].value
            level = float((means + loss * at * means[0]).mean())
            return Chart(
                "Light over the frame, by rings about its middle",
                Axis("squared distance from the middle (corner: 1)"),
                Axis("share of the light"),
                [
                    Series(
                        f"loses {percent(loss, 0)}",
                        [0.0, 1.0],
                        [level, level * (1 - loss)],
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
            begin_end = [minutes[0], minutes[-1]]
            slope = [result.estimates["drift"].value * float(m - minutes.mean()) for m in begin_end]
            return Chart(
                "Brightness of the card",
                Axis("minutes"),
                Axis("off the mean, %"),
                [
                    Series(f"{result.estimates['drift']}", begin_end, slope, MODEL, dots=False, curve=True),
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


@dataclass(frozen=True)
class CameraNoise(Procedure):
    """A procedure that takes frames of the board at rest: sharpness and noise of the camera."""

    names, title, devices, valid_days, plots = (SHARPNESS, NOISE), "sharpness and noise", ("camera",), 180, (plot,)

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        yield Ask(
            "Put the board upright in the middle of the platter, with the usual light. Take your hands off.",
        )
        bench.place(BOARD)
        bench.clock.sleep(HANDS_S)
        frames = [bench.camera.capture(bench.clock.now_ns()).image_bgr for _ in range(PAIRS)]
        yield Progress(1.0, f"{PAIRS} frames of the scene at rest")
        yield sharpness([ImageQuality.of(frame, bench.config.view).sharpness for frame in frames])
        yield photon_transfer(np.stack(frames))


@dataclass(frozen=True)
class CameraCard(Procedure):
    """A procedure that takes frames of a plain card for some minutes: flat field, and stability of the light."""

    names, title, devices, valid_days, plots = (FLAT_FIELD, DRIFT), "flat field and light", ("camera",), 180, (plot,)

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        yield Ask(
            "Hold a plain grey or white card near the lens so that it fills the frame, lit evenly by the usual light.",
        )
        bench.place(CARD)
        bench.clock.sleep(HANDS_S)
        locks = bench.camera.read_locks()
        levels, seconds, blocks = [], [], []
        start_ns = bench.clock.now_ns()
        for index in range(CARD_FRAMES):
            image = bench.camera.capture(bench.clock.now_ns()).image_bgr
            levels.append(image.reshape(-1, 3).mean(axis=0))
            seconds.append((bench.clock.now_ns() - start_ns) * 1e-9)
            blocks.append(_blocks(image))
            if index % 10 == 9:
                yield Progress((index + 1) / CARD_FRAMES, f"{seconds[-1]:.0f} of {CARD_SECONDS:g} s of the card")
            bench.clock.sleep(CARD_SECONDS / CARD_FRAMES)
        card = CardFrames(np.array(levels), np.array(seconds), sum(blocks[1:], start=blocks[0]) / CARD_FRAMES)
        yield flat_field(card)
        yield drift(card, locks, bench.camera.read_locks())


def photon_transfer(frames: NDArray[np.uint8]) -> Evaluation:
    """Fit gain and read noise to ``frames`` of a scene at rest, uint8 (n, H, W, 3)."""
    found = Evaluation(name=NOISE, residual_unit="of the variance")
    found.evidence = {"frames": len(frames), "mean_variance": []}
    # The lamp's flicker changes all pixels together: scale each frame to the common brightness.
    green = frames[..., 1].astype(np.float64)
    brightness = green.mean(axis=(1, 2))
    green *= (brightness.mean() / np.maximum(brightness, 1e-9))[:, None, None]
    mean, variance = green.mean(axis=0).ravel(), green.var(axis=0, ddof=1).ravel()
    usable = (mean > LEVELS[0]) & (mean < LEVELS[1])
    mean, variance, region = mean[usable], variance[usable], _regions(green.shape[1:])[usable]
    low, high = (np.quantile(mean, [0.02, 0.98]).tolist()) if mean.size else (0.0, 0.0)
    if high - low < MIN_SPAN:
        return found.reject(RejectionCode.CONTRAST_TOO_LOW, span=high - low, needed=MIN_SPAN)
    # Bin the pixels by their mean, in each region. Sums of pixels, means and variances: float64 (3, regions, bins).
    edges = np.linspace(low, high, BINS + 1)
    cell = region * BINS + np.clip(np.digitize(mean, edges) - 1, 0, BINS - 1)
    cells = REGIONS[0] * REGIONS[1] * BINS
    ones = np.ones_like(mean)
    sums = np.stack([np.bincount(cell, weights, cells) for weights in (ones, mean, variance)])
    sums = sums.reshape(3, -1, BINS)
    whole = sums.sum(axis=1)
    gain, floor = _line(whole, len(frames))
    # Neighbouring pixels depend on each other, and sometimes frames do. The uncertainty is therefore the change of the
    # fit when a region is left out, and when some frames are left out.
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
    found.evidence["mean_variance"] = np.column_stack([at, noise]).round(4).tolist()
    found.residual = float(np.max(np.abs(noise - (gain * at + floor)) / noise))
    found.reject_if(gain <= 0, RejectionCode.NOISE_INDEPENDENT_OF_LIGHT)
    if gain > 0:
        full_well, read = 255 / float(gain), sqrt(dark) / float(gain)
        found.estimate("full_well_e", full_well, full_well / float(gain) * sqrt(covariance[0, 0]), "electrons")
        # σ_r = √floor / K: its derivatives by both.
        slope = np.array([-read / gain, 1 / (2 * gain * max(sqrt(dark), 0.05))])
        found.estimate("read_noise_e", read, sqrt(float(slope @ covariance @ slope)), "electrons")
    return found


def sharpness(values: Sequence[float]) -> Evaluation:
    """Evaluate the sharpness of frames of the board, with which a shift of the lens is noticed later."""
    found = Evaluation(name=SHARPNESS, residual_unit="squared levels")
    found.evidence = {"sharpness": [round(float(value), 2) for value in values]}
    mean = float(np.mean(values))
    found.estimate("sharpness", mean, np.std(values, ddof=1), "squared levels")
    found.reject_if(mean < MIN_SHARPNESS, RejectionCode.NOT_SHARP, sharpness=mean, needed=MIN_SHARPNESS)
    return found


def flat_field(card: CardFrames) -> Evaluation:
    """Fit the loss of light towards the corners to a card that fills the frame."""
    found = Evaluation(name=FLAT_FIELD, residual_unit="of the level", limit=MAX_UNEVEN)
    found.evidence = {"mean": card.mean.round(2).tolist()}
    square, x, y = _shading(card.mean.shape)
    design = np.column_stack([np.ones(square.size), x.ravel(), y.ravel(), -square.ravel()])
    values = card.mean.ravel()
    fitted, *_ = np.linalg.lstsq(design, values, rcond=None)
    level = float(fitted[0])
    # Neighbouring blocks depend on each other: the uncertainty is the change when a region is left out.
    region = _regions(card.mean.shape)
    without = (np.linalg.lstsq(design[region != r], values[region != r])[0] for r in range(region.max() + 1))
    sigma = np.array([fit[1:] / max(fit[0], 1e-9) for fit in without]).std(axis=0) * sqrt(region.max())
    found.residual = float(np.abs(values - design @ fitted).max()) / max(level, 1e-9)
    loss = float(fitted[3]) / max(level, 1e-9)
    found.estimate("vignetting", loss, sigma[2], "of the light in the corners")
    found.estimate("gradient_x", float(fitted[1]) / max(level, 1e-9), sigma[0])
    found.estimate("gradient_y", float(fitted[2]) / max(level, 1e-9), sigma[1])
    found.reject_if(not LEVELS[0] < level < LEVELS[1], RejectionCode.CARD_EXPOSURE, level=level)
    found.reject_if(found.residual > MAX_UNEVEN, RejectionCode.CARD_UNEVEN, residual=found.residual)
    found.reject_if(loss > MAX_LOSS, RejectionCode.VIGNETTING_TOO_LARGE, loss=loss)
    return found


def drift(card: CardFrames, before: CameraLocks, after: CameraLocks) -> Evaluation:
    """Evaluate the stability of light and settings, and the white balance by the card's colour."""
    found = Evaluation(name=DRIFT)
    found.evidence = {
        "seconds": card.seconds.round(2).tolist(),
        "levels_bgr": card.levels.round(3).tolist(),
        "locks": plain(after),
    }
    if card.levels.min() < 1.0:
        return found.reject(RejectionCode.CARD_BLACK)
    grey = card.levels.mean(axis=1)
    # A straight line through the brightness is the drift; what is left over is the flicker.
    relative = grey / grey.mean()
    minutes = card.seconds / 60
    design = np.column_stack([np.ones_like(minutes), minutes - minutes.mean()])
    (_, slope), *_ = np.linalg.lstsq(design, relative, rcond=None)
    flicker = float((relative - design @ (1.0, slope)).std(ddof=2))
    slope_sigma = flicker / sqrt(float(((minutes - minutes.mean()) ** 2).sum()))
    n = len(grey)
    found.estimate("drift", 100 * float(slope), 100 * slope_sigma, "% a minute")
    found.estimate("flicker", flicker, flicker / sqrt(2 * (n - 2)), "of the light")
    # The card is grey: unequal channels are the colour of the light.
    for name, channel in (("red_green", 2), ("blue_green", 0)):
        ratio = card.levels[:, channel] / card.levels[:, 1]
        found.estimate(name, ratio.mean(), float(ratio.std(ddof=1)) / sqrt(n))

    blue, green, red = card.levels.mean(axis=0).tolist()
    span = float(minutes[-1] - minutes[0])
    # Reject only a drift that exceeds the limit by more than its own uncertainty explains.
    drifted = 100 * abs(float(slope)) * span
    found.residual, found.limit, found.residual_unit = drifted, MAX_DRIFT_PERCENT, "% in the time of the test"
    found.reject_if(before != after, RejectionCode.LOCKS_CHANGED, before=plain(before), after=plain(after))
    found.reject_if(
        drifted - 200 * slope_sigma * span > MAX_DRIFT_PERCENT,
        RejectionCode.LIGHT_DRIFTED,
        drift_percent=drifted,
        minutes=minutes[-1],
        limit_percent=MAX_DRIFT_PERCENT,
    )
    found.reject_if(flicker > MAX_FLICKER, RejectionCode.LIGHT_FLICKERS, flicker=flicker, limit=MAX_FLICKER)
    cast = max(abs(red / green - 1), abs(blue / green - 1))
    found.reject_if(cast > MAX_CAST, RejectionCode.COLOUR_CAST, red=red / green, blue=blue / green)
    return found


def _regions(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the region of the frame of each pixel, int (n,)."""
    rows, columns = (np.arange(side) * parts // side for side, parts in zip(shape, REGIONS, strict=True))
    return (rows[:, None] * REGIONS[1] + columns).ravel()


def _line(sums: NDArray[np.float64], frames: int) -> tuple[float, float]:
    """Return slope and offset of variance over mean from sums of pixels, means and variances, float64 (3, bins)."""
    count, mean, variance = sums[:, sums[0] >= MIN_PIXELS]
    at, noise = mean / count, variance / count
    # Scatter of a bin's variance: of n pixels and N frames each, relative √(2 / n(N−1)).
    sigma = noise * np.sqrt(2 / (count * (frames - 1)))
    design = np.column_stack([at, np.ones_like(at)]) / sigma[:, None]
    (gain, floor), *_ = np.linalg.lstsq(design, noise / sigma, rcond=None)
    return float(gain), float(floor)


def _jackknife(without: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    """Return the covariance (2, 2) of a line from its values when each part of the data is left out."""
    return np.asarray(np.cov(np.array(without).T, ddof=0) * (len(without) - 1))


def _without_frames(
    green: NDArray[np.float64], usable: NDArray[np.bool_]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], int]]:
    """Yield mean and variance of the usable pixels without each group of frames, and the number of frames left.

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
    """Return the mean grey level of blocks, float64 (rows, columns); incomplete blocks are left out."""
    height, width = (side // BLOCK * BLOCK for side in image.shape[:2])
    grey = image[:height, :width].mean(axis=2)
    return np.asarray(grey.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(1, 3)), dtype=np.float64)
