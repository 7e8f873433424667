"""Captures frames for views and checks them: image quality, camera settings, and whether the table stood still."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import isfinite

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.config import RigConfig, ViewConfig
from rig.core.phrases import Worded, filled
from rig.devices.camera import Camera, CameraLocks, Frame
from rig.safety.gyro_rotation import Stillness
from rig.views.description import within
from rig.views.image_files import encode
from rig.views.stream import exposed_before_stamp_ns

DARK_LEVEL = 8
"""Pixels below this grey level carry no detail in an 8-bit frame."""
NOISE_GAIN = 20
"""Factor by which the Laplacian (-4 and four times 1) increases the variance of independent pixels."""
MOST_REPEATED = 10  # a camera that only repeats frames must still be reported
"""Repeated frames of one view that do not count as retakes: a camera on a busy bus sends some frames twice."""
SMEAR_MARGIN = 1.1
"""Allowed excess of the smear, because the speed varies about the chosen one."""
SIMILARITY_PX = 4
"""Side of the squares that `image_similarity` averages over."""


class RejectReason(Worded):
    """The reasons to reject a frame; the texts contain numbers of its `ViewEvidence`."""

    EXPOSED_EARLY = "exposed-early", "exposed before the table stood still"
    GYRO_INCOMPLETE = (
        "gyro-incomplete",
        "the gyro's samples are incomplete: it is unknown whether the table stood still",
    )
    TABLE_MOVED = (
        "table-moved",
        "the table moved ({0.stillness.peak_rate_dps:.2f} °/s, shaft {0.stillness.encoder_change_deg:.2f}°, "
        "platter {0.stillness.platter_change_deg:+.2f}°)",
    )
    REPEATED_FRAME = "repeated-frame", "the camera repeated its last frame"
    LOCKS_CHANGED = "locks-changed", "a setting of the camera has changed"
    TOO_DARK = "too-dark", "too dark (mean level {0.mean_level:.1f}, {0.dark_share:.0%} black)"
    OVEREXPOSED = "overexposed", "overexposed ({0.saturated_share:.0%} saturated)"
    BLURRED = "blurred", "blurred (sharpness {0.sharpness:.1f})"
    NOISE = "noise", "noise instead of an image"
    SMEARED = "smeared", "smeared by {0.motion.smear_px:.1f} px at {0.motion.speed_dps:.0f} °/s"
    ANGLE_UNCERTAIN = "angle-uncertain", "the angle is uncertain by {0.motion.angle_sigma_deg:.2f}°"
    TIME_UNCERTAIN = "time-uncertain", "the time stamp does not fit the camera's rhythm"


@dataclass(frozen=True, slots=True)
class MotionEvidence:
    """The motion of the table while a view was exposed."""

    middle_ns: int
    """Middle of the exposure of the object's middle row, or of the frame's if no object was found, in ns of the bench's
    clock."""
    angle_deg: float
    """Table angle at that time."""
    angle_sigma_deg: float
    """Standard uncertainty of ``angle_deg``."""
    speed_dps: float
    """Speed of the table at that time."""
    smear_px: float
    """Motion in the image during the exposure, at the edge of the region of interest, in pixels."""
    residual_deg: float
    """Largest difference between encoder and gyro during the motion."""


@dataclass(frozen=True, slots=True)
class ViewEvidence:
    """The measurements that decide whether a frame is accepted."""

    settled_ns: int
    """Time at which the table came to rest, in ns of the bench's clock; for a view in motion, the time at which the
    motion began."""
    exposed_ns: int
    """Time at which the exposure began, in ns of the bench's clock."""
    sharpness: float
    """Variance of the Laplacian of the region of interest in grey, in squared grey levels."""
    mean_level: float
    """Mean grey level of the region of interest, from 0 to 255."""
    dark_share: float
    """Share of the region's pixels with a grey level below 8, from 0 to 1."""
    saturated_share: float
    """Share of the region's pixels with the grey level 255, from 0 to 1."""
    repeated: bool
    """Whether the camera sent its last frame again."""
    locks: CameraLocks
    """Settings of the camera, as the camera reports them."""
    locks_hold: bool
    """Whether these settings are the same as at the beginning of the plan."""
    stillness: Stillness | None
    """Motion of the table from rest until the end of the exposure; null for a view in motion."""
    motion: MotionEvidence | None = None
    """Motion of the table during the exposure; null for a view at rest."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One frame, the ``number``-th for this view from 1 on, and the reasons to reject it; none if it is accepted.

    ``encoded`` is the frame as PNG, if the `Viewer` encodes its frames.
    """

    number: int
    image_bgr: NDArray[np.uint8]
    evidence: ViewEvidence
    reasons: tuple[RejectReason, ...]
    encoded: Future[bytes] | None = None

    @property
    def accepted(self) -> bool:
        return not self.reasons


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Quality of the region of interest of a frame; see `ViewEvidence`.

    ``noise_share`` compares neighbouring pixels with distant ones: 1 if they have nothing in common, below 0.05 in
    usual images.
    """

    sharpness: float
    mean_level: float
    dark_share: float
    saturated_share: float
    noise_share: float

    @classmethod
    def of(cls, image_bgr: NDArray[np.uint8], config: ViewConfig) -> "ImageQuality":
        """Measure the region of interest of a frame, uint8 (H, W, 3)."""
        grey = cv2.cvtColor(within(image_bgr, config.roi), cv2.COLOR_BGR2GRAY)
        laplacian = cv2.Laplacian(grey, cv2.CV_16S)
        pixels = grey.size
        counts = cv2.calcHist([grey], [0], None, [256], [0, 256]).ravel().astype(np.int64)
        level = np.arange(256)
        total = int(counts @ level)
        variance = _variance(total, int(counts @ level**2), pixels)
        squares = round(cv2.norm(laplacian, cv2.NORM_L2SQR))  # whole only after rounding: OpenCV squares a root
        sharpness = _variance(int(cv2.sumElems(laplacian)[0]), squares, pixels)
        return cls(
            sharpness=sharpness,
            mean_level=total / pixels,
            dark_share=int(counts[:DARK_LEVEL].sum()) / pixels,
            saturated_share=int(counts[255]) / pixels,
            noise_share=sharpness / (NOISE_GAIN * max(variance, 1.0)),
        )

    def reasons(self, config: ViewConfig) -> list[RejectReason]:
        """Return the reasons to reject a frame of this quality."""
        blurred = self.sharpness < config.min_sharpness
        exceeded = {
            RejectReason.TOO_DARK: self.mean_level < config.min_mean or self.dark_share > config.max_dark,
            RejectReason.OVEREXPOSED: self.saturated_share > config.max_saturated,
            RejectReason.BLURRED: blurred,
            RejectReason.NOISE: not blurred and self.noise_share > config.max_noise,
        }
        return [reason for reason, holds in exceeded.items() if holds]


def _variance(total: int, squares: int, count: int) -> float:
    """Return the variance of whole numbers, by their sum and the sum of their squares, rounded only once."""
    return (count * squares - total * total) / (count * count)


def image_similarity(image_bgr: NDArray[np.uint8], other_bgr: NDArray[np.uint8], config: ViewConfig) -> float:
    """Return how similar two frames are in their region of interest: 1 for equal frames in any illumination.

    The similarity is the correlation of grey levels, averaged over a few pixels. Noise and a rotation of 0.1° reduce it
    by less than 0.01. If the object was taken away, it is below 0.7.
    """
    small = [
        cv2.resize(
            cv2.cvtColor(within(image, config.roi), cv2.COLOR_BGR2GRAY),
            None,
            fx=1 / SIMILARITY_PX,
            fy=1 / SIMILARITY_PX,
            interpolation=cv2.INTER_AREA,
        )
        for image in (image_bgr, other_bgr)
    ]
    return float(cv2.matchTemplate(small[0], small[1], cv2.TM_CCOEFF_NORMED)[0, 0])


def checked(
    number: int,
    frame: Frame,
    config: ViewConfig,
    *,
    settled_ns: int,
    locks: CameraLocks,
    locks_hold: bool,
    stillness: Stillness | None = None,
    motion: MotionEvidence | None = None,
    early: bool = False,
    time_known: bool = True,
    angle_known: bool = True,
) -> Attempt:
    """Return a frame as an attempt at a view: its evidence (`ViewEvidence`), and which limits of a view this exceeds.

    A frame has either ``stillness`` or ``motion``. An ``early`` one was exposed before the table came to rest.
    ``time_known`` and ``angle_known`` say whether its time can be trusted, and whether encoder and gyro agree about its
    angle.
    """
    quality = ImageQuality.of(frame.image_bgr, config)
    evidence = ViewEvidence(
        settled_ns=settled_ns,
        exposed_ns=frame.exposed_ns,
        sharpness=quality.sharpness,
        mean_level=quality.mean_level,
        dark_share=quality.dark_share,
        saturated_share=quality.saturated_share,
        repeated=frame.repeated,
        locks=locks,
        locks_hold=locks_hold,
        stillness=stillness,
        motion=motion,
    )
    # Each limit of a view, apart from those of its image.
    unknown = stillness is not None and not isfinite(stillness.peak_rate_dps)
    exceeded = {
        RejectReason.EXPOSED_EARLY: early,
        RejectReason.GYRO_INCOMPLETE: unknown,
        RejectReason.TABLE_MOVED: stillness is not None and not unknown and not stillness.still,
        RejectReason.TIME_UNCERTAIN: not time_known,
        RejectReason.ANGLE_UNCERTAIN: motion is not None
        and (motion.angle_sigma_deg > config.max_angle_sigma_deg or not angle_known),
        RejectReason.SMEARED: motion is not None and motion.smear_px > SMEAR_MARGIN * config.max_smear_px,
        RejectReason.REPEATED_FRAME: frame.repeated,
        RejectReason.LOCKS_CHANGED: not locks_hold,
    }
    reasons = [reason for reason, holds in exceeded.items() if holds]
    return Attempt(number, frame.image_bgr, evidence, (*reasons, *quality.reasons(config)))


class Viewer:
    """Captures views with one camera, whose locked settings must not change after the viewer was made.

    A camera with an internal delay stamps its frames after their exposure. If the camera's time is calibrated, only
    frames count whose exposure began after the table came to rest. With ``encodes`` each frame is encoded as PNG, for
    storing, while it is checked.
    """

    def __init__(self, camera: Camera, config: RigConfig, *, encodes: bool = False) -> None:
        self._camera = camera
        # One thread, because encoding leaves the interpreter to the others; it ends with the last reference to it.
        self._encoder = ThreadPoolExecutor(1, "encoder") if encodes else None
        self._config = config.view
        self._early_ns = exposed_before_stamp_ns(config)
        self._locks = camera.read_locks()
        self._last: NDArray[np.uint8] | None = None

    def attempts(
        self, settled_ns: int, check_still: Callable[[int], Stillness], meanwhile: Callable[[], object] | None = None
    ) -> Iterator[Attempt]:
        """Capture frames until one is accepted or ``retakes`` is used up.

        Up to `MOST_REPEATED` frames that the camera only repeats do not count as retakes.

        Frames exposed before ``settled_ns`` are rejected. ``check_still`` checks encoder and gyro from a given time on,
        after the exposure. ``meanwhile`` is called several times a second while the program waits for a slow camera.
        """
        after_ns = settled_ns + self._early_ns
        number = repeated = 0
        while number - repeated <= self._config.retakes:
            number += 1
            frame = self._camera.capture(after_ns, meanwhile)
            encoded = None if self._encoder is None else self._encoder.submit(encode, frame.image_bgr)
            stillness, locks = check_still(after_ns - self._early_ns), self._camera.read_locks()
            attempt = checked(
                number,
                replace(frame, repeated=self._last is not None and np.array_equal(frame.image_bgr, self._last)),
                self._config,
                settled_ns=settled_ns,
                locks=locks,
                locks_hold=locks == self._locks,
                stillness=stillness,
                early=frame.exposed_ns < settled_ns + self._early_ns,
            )
            attempt = replace(attempt, encoded=encoded)
            self._last = frame.image_bgr
            yield attempt
            if attempt.accepted:
                return
            # A camera on a busy bus repeats frames; that is no failed attempt.
            if attempt.reasons == (RejectReason.REPEATED_FRAME,) and repeated < MOST_REPEATED:
                repeated += 1
            after_ns = frame.exposed_ns + 1


def rejection_text(reason: str, evidence: ViewEvidence | ImageQuality) -> str:
    """Return the text of a `RejectReason`, with the numbers of the evidence; an unknown one is returned as it is."""
    known = set(RejectReason)
    return filled(RejectReason(reason).words, evidence) if reason in known else str(reason)
