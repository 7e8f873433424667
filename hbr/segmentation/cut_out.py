"""Segmentations: an object cut out of its frame, with the evidence."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.kernels import calls
from hbr.segmentation.background import BoxMethod, Illumination, Issue, SegmentedFrame

#: Side of the square crop around an object.
CROP_PX: Final = 160
#: Side of the crop, as a multiple of the longer side of the box.
_MARGIN: Final = 1.1
#: Brightness of the grey that replaces the background, as a share of the object's brightness.
_SURROUND: Final = 0.5

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Segmentation:
    """An object cut out of its frame, with the evidence."""

    crop: ImageArray
    """uint8 array (160, 160, 3): square around the object, in BGR, after illumination correction."""
    mask: NDArray[np.uint8]
    """uint8 array (160, 160): share of each pixel that belongs to the object, 0..255; 255 everywhere if no object was
    found."""
    box: Box | None
    """(int, int, int, int) or None: the object's x, y, width and height in pixels of the frame; None if no object was
    found."""
    gains: tuple[float, float, float] | None
    """(float, float, float) or None: factors of the illumination correction for B, G, R; None without correction."""
    agreement: float | None
    """Share of the frame's border that looks like the empty-table image; None without such an image."""
    method: BoxMethod
    """Method by which the box was found."""
    issues: tuple[Issue, ...] = ()
    """Steps that were not possible, with their reasons."""
    correction: Illumination | None = field(default=None, repr=False)
    """The illumination correction."""
    silhouette: NDArray[np.bool_] | None = field(default=None, repr=False)
    """bool array (h, w) or None: the object's pixels in the small image (`hbr.segmentation.background.shrunk`); None if
    they are not known."""
    frame: SegmentedFrame | None = field(default=None, repr=False)
    """The frame; None if it was dropped to save memory."""

    def evidence(self) -> dict[str, Any]:
        """Return method, box, gains, agreement and issues as JSON values, to be stored with the view."""
        return {
            "method": self.method.value,
            "box_px": None if self.box is None else list(self.box),
            "gains_bgr": None if self.gains is None else [round(gain, 4) for gain in self.gains],
            "agreement": None if self.agreement is None else round(self.agreement, 3),
            "issues": [issue.as_json() for issue in self.issues],
        }

    def frame_mask(self, width: int, height: int) -> NDArray[np.bool_]:
        """Return the object's pixels in its frame of this size, bool (height, width); none if no object was found."""
        whole = np.zeros((height, width), np.bool_)
        if self.box is None:
            return whole
        left, top, side = _square_around(self.box)
        scale = CROP_PX / side
        move = np.array([[scale, 0, scale * (0.5 - left) - 0.5], [0, scale, scale * (0.5 - top) - 0.5]])
        share = cv2.warpAffine(self.mask, move, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        x, y, w, h = self.box
        whole[y : y + h, x : x + w] = share[y : y + h, x : x + w] > 127
        return whole

    @cached_property
    def alone(self) -> ImageArray:
        """The crop with an even grey instead of the background, half as bright as the object, uint8 (160, 160, 3)."""
        if self.box is None:
            return self.crop
        level = _SURROUND * float(np.mean(cv2.mean(self.crop, mask=(self.mask > 127).astype(np.uint8))[:3]))
        share = cv2.GaussianBlur(self.mask, (0, 0), 2.5)
        ground = np.full_like(self.crop, round(level))
        weight = share.astype(np.float32) * np.float32(1 / 255)
        return cv2.blendLinear(self.crop, ground, weight, 1 - weight).astype(np.uint8, copy=False)


@dataclass(frozen=True, eq=False)
class Found:
    """A silhouette that was found in a frame; the object is cut out only if it is needed.

    Its attributes are those of `Segmentation`.
    """

    frame: SegmentedFrame
    silhouette: NDArray[np.bool_] | None
    correction: Illumination | None
    agreement: float | None
    method: BoxMethod
    issues: tuple[Issue, ...]

    @cached_property
    def box(self) -> Box | None:
        """The object's x, y, width and height in pixels of the frame; None if no object was found."""
        if self.silhouette is None:
            return None
        height, width = self.frame.image.shape[:2]
        return _box_of(self.silhouette, width, height)

    def cut_out(self) -> Segmentation:
        """Return the segmentation of the frame."""
        height, width = self.frame.image.shape[:2]
        box, found, correction = self.box, self.silhouette, self.correction
        if box is None:
            side = float(min(height, width))
            left, top = (width - side) / 2, (height - side) / 2
        else:
            left, top, side = _square_around(box)
        crop = _square(self.frame.image, left, top, side)
        if correction is not None:
            crop = _corrected(crop, correction, left, top, side, width, height)
        if found is not None:
            ratio = found.shape[1] / width
            mask = _square(found.astype(np.uint8) * 255, left * ratio, top * ratio, side * ratio, cv2.BORDER_CONSTANT)
        else:
            mask = np.full((CROP_PX, CROP_PX), 255, np.uint8)
        gains = None if correction is None else correction.gains
        return Segmentation(
            crop, mask, box, gains, self.agreement, self.method, self.issues, correction, found, self.frame
        )


def _square_around(box: Box) -> tuple[float, float, float]:
    """Return left, top and side of the square that is cropped."""
    side = max(box[2], box[3]) * _MARGIN
    return box[0] + (box[2] - side) / 2, box[1] + (box[3] - side) / 2, side


def _box_of(found: NDArray[np.bool_], width: int, height: int) -> Box:
    x, y, w, h = cv2.boundingRect(found.astype(np.uint8))
    across, down = width / found.shape[1], height / found.shape[0]
    left, top = int(x * across), int(y * down)
    return left, top, min(width, round((x + w) * across)) - left, min(height, round((y + h) * down)) - top


def _square(
    image: NDArray[np.uint8], left: float, top: float, side: float, border: int = cv2.BORDER_REPLICATE
) -> NDArray[np.uint8]:
    """Return a square of the image, scaled to `CROP_PX`: averaged by area if it shrinks, linearly if it grows."""
    scale = CROP_PX / side
    if scale < 1:
        # whole pixels, because INTER_AREA needs an integer region
        x, y, size = round(left), round(top), max(1, round(side))
        height, width = image.shape[:2]
        out = max(0, -x), max(0, -y), max(0, x + size - width), max(0, y + size - height)
        part = image[max(0, y) : y + size, max(0, x) : x + size]
        if any(out):
            part = cv2.copyMakeBorder(part, out[1], out[3], out[0], out[2], border).astype(np.uint8, copy=False)
        by_kernel = calls.average(part, CROP_PX) if part.ndim == 3 else None
        if by_kernel is not None:
            return by_kernel
        return cv2.resize(part, (CROP_PX, CROP_PX), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    shift = (scale - 1) / 2
    move = np.array([[scale, 0, shift - scale * left], [0, scale, shift - scale * top]])
    return cv2.warpAffine(image, move, (CROP_PX, CROP_PX), flags=cv2.INTER_LINEAR, borderMode=border).astype(
        np.uint8, copy=False
    )


def _corrected(
    crop: ImageArray, correction: Illumination, left: float, top: float, side: float, width: int, height: int
) -> ImageArray:
    """Apply to the crop the correction, whose planes extend over the whole frame."""
    local = correction.slopes.copy()
    local[0] += local[1] * ((left + side / 2) / width - 0.5) + local[2] * ((top + side / 2) / height - 0.5)
    local[1] *= side / width
    local[2] *= side / height
    coarse = cv2.exp(Illumination(local).over(8, 8))
    factors = cv2.resize(coarse, (CROP_PX, CROP_PX), interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(crop, factors, dtype=cv2.CV_8U).astype(np.uint8, copy=False)
