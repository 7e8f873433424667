"""Contact sheets: all views of an object in one image, each with its azimuth."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core.phrases import azimuth_words

Image = NDArray[np.uint8]
Region = tuple[int, int, int, int]

CAPTION_PX: Final = 17
GAP_PX: Final = 2
_PAPER: Final = 24
_INK: Final = 224
_OUTLINE: Final = (60, 170, 230)
_CAP_HEIGHT_PX: Final = 9
_OVERSAMPLING: Final = 4


def thumbnail(
    image_bgr: Image, size: tuple[int, int], region: Region | None = None, box: Sequence[int] | None = None
) -> Image:
    """Fit an image into ``size`` (width, height) without distortion, centred on dark grey.

    Parameters
    ----------
    image_bgr
        uint8 (H, W, 3).
    size
        Width and height in pixels.
    region
        The part to show: x, y, width, height in pixels; None shows all.
    box
        Box to outline in it: x, y, width, height in pixels of the part.

    Returns
    -------
    uint8 (height, width, 3) BGR, a new array.

    Raises
    ------
    ValueError
        The image is not uint8 (H, W, 3), or the region contains no part of it.
    """
    if image_bgr.dtype != np.uint8 or image_bgr.ndim != 3 or image_bgr.shape[2] != 3:
        raise ValueError(f"the image is {image_bgr.dtype} {image_bgr.shape}; give uint8 (H, W, 3) BGR")
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


def contact_sheet(
    images_bgr: Sequence[Image], azimuth_deg: Sequence[float], *, columns: int = 12, tile: tuple[int, int] = (96, 96)
) -> Image:
    """Lay out views row by row, each with its azimuth below.

    Parameters
    ----------
    images_bgr
        n images, uint8 (H, W, 3) each, of any size.
    azimuth_deg
        Their n azimuths in degrees.
    columns
        Views in a row.
    tile
        Width and height of a view in pixels; its caption takes `CAPTION_PX` more below.

    Returns
    -------
    uint8 (rows · (tile height + CAPTION_PX + GAP_PX) + GAP_PX, columns · (tile width + GAP_PX) + GAP_PX, 3) BGR, where
    rows = ⌈n / columns⌉.

    Raises
    ------
    ValueError
        There are no images, not as many azimuths as images, no columns, or an image is not uint8 (H, W, 3).
    """
    if not images_bgr or len(images_bgr) != len(azimuth_deg):
        raise ValueError(f"{len(images_bgr)} images and {len(azimuth_deg)} azimuths; give one azimuth an image")
    if columns < 1:
        raise ValueError(f"columns is {columns}; give at least 1")
    width, height = tile
    across, down = width + GAP_PX, height + CAPTION_PX + GAP_PX
    rows = -(-len(images_bgr) // columns)
    sheet = np.full((rows * down + GAP_PX, columns * across + GAP_PX, 3), _PAPER, dtype=np.uint8)
    for k, (image, azimuth) in enumerate(zip(images_bgr, azimuth_deg, strict=True)):
        y, x = GAP_PX + (k // columns) * down, GAP_PX + (k % columns) * across
        sheet[y : y + height, x : x + width] = thumbnail(image, tile)
        sheet[y + height : y + height + CAPTION_PX, x : x + width] = _caption(azimuth_words(azimuth), width)
    return sheet


@lru_cache(maxsize=1024)
def _caption(number: str, width: int) -> Image:
    """Draw a centred number with a degree sign, large and then shrunk, because small letters of OpenCV are blurred."""
    fine = _OVERSAMPLING
    canvas = np.zeros((CAPTION_PX * fine, width * fine), dtype=np.uint8)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cap = _CAP_HEIGHT_PX * fine
    scale = cap / cv2.getTextSize("0", font, 1.0, 1)[0][1]
    thickness = round(1.1 * fine)
    text_width = cv2.getTextSize(number, font, scale, thickness)[0][0]
    ring = round(0.16 * cap)
    left = (canvas.shape[1] - text_width - 3 * ring) // 2
    base = (canvas.shape[0] + cap) // 2
    cv2.putText(canvas, number, (left, base), font, scale, 255, thickness, cv2.LINE_AA)
    # the Hershey fonts have no degree sign
    cv2.circle(canvas, (left + text_width + 2 * ring, base - cap + ring), ring, 255, round(0.8 * fine), cv2.LINE_AA)
    cover = cv2.resize(canvas, (width, CAPTION_PX), interpolation=cv2.INTER_AREA).astype(np.float64)[..., None] / 255
    caption = np.broadcast_to(np.rint(_PAPER + (_INK - _PAPER) * cover), (CAPTION_PX, width, 3)).astype(np.uint8)
    caption.flags.writeable = False
    return caption
