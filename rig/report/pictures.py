"""Pictures of a report: a view in its box, and all views of an object in one picture, each with its azimuth."""

from base64 import b64encode
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.charts import svg
from rig.core.phrases import azimuth_words

Image = NDArray[np.uint8]
Region = tuple[int, int, int, int]

_JPEG_QUALITY: Final = 84  # lower: blocks hide grain and edges; higher: a report of many views becomes a large file
_COLUMNS: Final = 12  # more: the views are too small to compare by eye
_CAPTION_PX: Final = 17
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


def contact_sheet(tiles_bgr: Sequence[Image], azimuth_deg: Sequence[float], label: str) -> str:
    """Lay out views row by row, each with its azimuth below, as SVG with one JPEG: it is smaller than n of them.

    ``tiles_bgr`` are at least one image, uint8 (H, W, 3), all of one size; ``label`` is the alternative text.
    """
    height, width = tiles_bgr[0].shape[:2]
    columns = min(_COLUMNS, len(tiles_bgr))
    rows, down = -(-len(tiles_bgr) // columns), height + _CAPTION_PX
    sheet = np.full((rows * down, columns * width, 3), _PAPER, dtype=np.uint8)
    captions = []
    for k, (tile, azimuth) in enumerate(zip(tiles_bgr, azimuth_deg, strict=True)):
        x, y = (k % columns) * width, (k // columns) * down
        sheet[y : y + height, x : x + width] = tile
        captions.append(svg.text(f"{azimuth_words(azimuth)}°", (x + width / 2, y + down - 4), "caption"))
    image = svg.element("image", href=data_uri(sheet), width=columns * width, height=rows * down)
    return svg.drawing(columns * width, rows * down, label, [image, *captions])
