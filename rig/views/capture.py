"""A view is a frame with the evidence that it may be trusted; this module takes frames and judges them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import isfinite

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.config import ViewConfig
from rig.devices.camera import Camera, CameraLocks, Frame
from rig.safety.gyro_rotation import Stillness
from rig.views.description import within

DARK_LEVEL = 8
"""Grey levels below this carry no detail in an 8-bit frame."""
NOISE_GAIN = 20
"""What the Laplacian (-4 and four times 1) makes of the variance of independent pixels."""
MAX_NOISE = 0.3
"""Largest share of such variance in a picture; half a frame of random bytes has more."""
LIKENESS_PX = 4
"""Side of the squares that `image_similarity` averages over."""


@dataclass(frozen=True, slots=True)
class ViewEvidence:
    """The numbers a frame was judged by.

    ``settled_ns`` and ``exposed_ns`` are times on the bench's clock; ``sharpness`` is the variance of the Laplacian of
    the grey region, in squared levels; the shares are of the region's pixels.
    """

    settled_ns: int
    exposed_ns: int
    sharpness: float
    mean_level: float
    dark_share: float
    saturated_share: float
    repeated: bool
    locks: CameraLocks
    locks_hold: bool
    stillness: Stillness


@dataclass(frozen=True, slots=True)
class Attempt:
    """One frame, the ``number``-th for this view from 1 on, and why it was not taken (nothing: it was accepted)."""

    number: int
    image_bgr: NDArray[np.uint8]
    evidence: ViewEvidence
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        return not self.reasons


@dataclass(frozen=True, slots=True)
class Looks:
    """What the region of a frame looks like; see `ViewEvidence`.

    ``noise_share`` compares neighbouring pixels with distant ones: 1 where they have nothing in common, below 0.05 in
    pictures.
    """

    sharpness: float
    mean_level: float
    dark_share: float
    saturated_share: float
    noise_share: float

    def reasons(self, config: ViewConfig) -> list[str]:
        """Return why a frame that looks so is not taken."""
        reasons = []
        if self.mean_level < config.min_mean or self.dark_share > config.max_dark:
            reasons.append(f"too dark (mean level {self.mean_level:.1f}, {self.dark_share:.0%} black)")
        if self.saturated_share > config.max_saturated:
            reasons.append(f"overexposed ({self.saturated_share:.0%} saturated)")
        if self.sharpness < config.min_sharpness:
            reasons.append(f"blurred (sharpness {self.sharpness:.1f} < {config.min_sharpness:g})")
        elif self.noise_share > MAX_NOISE:
            reasons.append(f"noise instead of a picture ({self.noise_share:.0%} of its variance)")
        return reasons


def looks(image_bgr: NDArray[np.uint8], config: ViewConfig) -> Looks:
    """Measure the region of interest of a frame, uint8 (H, W, 3)."""
    grey = cv2.cvtColor(within(image_bgr, config.roi), cv2.COLOR_BGR2GRAY)
    sharpness = float(cv2.Laplacian(grey, cv2.CV_16S).var())
    return Looks(
        sharpness=sharpness,
        mean_level=float(grey.mean()),
        dark_share=float(np.count_nonzero(grey < DARK_LEVEL) / grey.size),
        saturated_share=float(np.count_nonzero(grey == 255) / grey.size),
        noise_share=sharpness / (NOISE_GAIN * max(float(grey.var()), 1.0)),
    )


def image_similarity(image_bgr: NDArray[np.uint8], other_bgr: NDArray[np.uint8], config: ViewConfig) -> float:
    """Return how much two frames show the same in their region of interest: 1 for the same, whatever the light.

    It is the correlation of their grey levels, averaged over a few pixels: noise and a tenth of a degree cost less
    than 0.01, an object that was taken away leaves less than 0.7.
    """
    small = [
        cv2.resize(
            cv2.cvtColor(within(image, config.roi), cv2.COLOR_BGR2GRAY),
            None,
            fx=1 / LIKENESS_PX,
            fy=1 / LIKENESS_PX,
            interpolation=cv2.INTER_AREA,
        )
        for image in (image_bgr, other_bgr)
    ]
    return float(cv2.matchTemplate(small[0], small[1], cv2.TM_CCOEFF_NORMED)[0, 0])


class Viewer:
    """Takes views with one camera, whose locks must stay as they were when the viewer was made."""

    def __init__(self, camera: Camera, config: ViewConfig) -> None:
        self._camera = camera
        self._config = config
        self._locks = camera.read_locks()
        self._last: NDArray[np.uint8] | None = None

    def attempts(
        self,
        settled_ns: int,
        check_still: Callable[[int], Stillness],
        meanwhile: Callable[[], object] | None = None,
    ) -> Iterator[Attempt]:
        """Capture until a frame is accepted or the retakes are used up; the last attempt tells which.

        Parameters
        ----------
        settled_ns
            When the table came to rest: no older exposure counts.
        check_still
            Looks at encoder and gyro again, after the exposure, from a given time on.
        meanwhile
            Called several times a second while a slow camera is waited for.
        """
        after_ns = settled_ns
        for number in range(1, 2 + self._config.retakes):
            frame = self._camera.capture(after_ns, meanwhile)
            attempt = self._judge(number, frame, settled_ns, check_still(after_ns))
            self._last = frame.image_bgr
            yield attempt
            if attempt.accepted:
                return
            after_ns = frame.exposed_ns + 1

    def _judge(self, number: int, frame: Frame, settled_ns: int, stillness: Stillness) -> Attempt:
        config = self._config
        seen = looks(frame.image_bgr, config)
        locks = self._camera.read_locks()
        evidence = ViewEvidence(
            settled_ns=settled_ns,
            exposed_ns=frame.exposed_ns,
            sharpness=seen.sharpness,
            mean_level=seen.mean_level,
            dark_share=seen.dark_share,
            saturated_share=seen.saturated_share,
            repeated=self._last is not None and np.array_equal(frame.image_bgr, self._last),
            locks=locks,
            locks_hold=locks == self._locks,
            stillness=stillness,
        )
        reasons = []
        if frame.exposed_ns < settled_ns:
            reasons.append("exposed before the table was at rest")
        if not isfinite(stillness.peak_rate_dps):
            reasons.append("the gyro's samples are not complete: whether the table stood still is unknown")
        elif not stillness.still:
            reasons.append(
                f"the table moved ({stillness.peak_rate_dps:.2f} °/s, shaft {stillness.encoder_change_deg:.2f}°, "
                f"platter {stillness.platter_change_deg:+.2f}°)"
            )
        if evidence.repeated:
            reasons.append("the camera repeated its last frame")
        if not evidence.locks_hold:
            reasons.append("exposure or white balance is not as locked")
        reasons += seen.reasons(config)
        return Attempt(number, frame.image_bgr, evidence, tuple(reasons))
