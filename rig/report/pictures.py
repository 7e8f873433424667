"""Pictures of a report."""

from base64 import b64encode
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Region = tuple[int, int, int, int]

_JPEG_QUALITY: Final = 84  # lower: blocks hide grain and edges; higher: a report of many views becomes a large file
_PAPER: Final = 24
_OUTLINE: Final = (60, 170, 230)


def thumbnail(
    image_bgr: Image, size: tuple[int, int], region: Region | None = None, box: Sequence[int] | None = None
) -> Image:
    """Fit an image into ``size`` (width, height) without distortion, centred on dark grey.

    ``image_bgr`` is uint8 (H, W, 3), and so is the new array. ``region`` is the part to show, and ``box`` is outlined
    in it: x, y, width, height in pixels, those of the box in the part.

    Raises `ValueError`: the region contains no part of the image.
    """
    if region is not None:
        x, y, w, h = region
        image_bgr = image_bgr[y : y + h, x : x + w]
    if not image_bgr.size:
        raise ValueError(f"the region {region} is outside the image; give one within it")
    height, width = image_bgr.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    fitted = (max(1, round(width * scale)), max(1, round(height * scale)))
    shrunk = cv2.resize(image_bgr, fitted, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    canvas = np.full((size[1], size[0], 3), _PAPER, dtype=np.uint8)
    left, top = (size[0] - fitted[0]) // 2, (size[1] - fitted[1]) // 2
    canvas[top : top + fitted[1], left : left + fitted[0]] = shrunk
    if box is not None:
        x, y, w, h = (round(side * scale) for side in box)
        cv2.rectangle(canvas, (left + x, top + y), (left + x + w - 1, top + y + h - 1), _OUTLINE, 1)
    return canvas


def data_uri(image_bgr: Image) -> str:
    """Return a picture as JPEG in an address for a page."""
    encoded, jpeg = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert encoded  # uint8 (H, W, 3) with pixels: `thumbnail` has made it
    return f"data:image/jpeg;base64,{b64encode(jpeg.tobytes()).decode('ascii')}"
