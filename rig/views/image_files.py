"""Image files of views: encoding, decoding and names.

Decision: docs/decisions/0009.
"""

import hashlib
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core import files
from rig.core.errors import UsageError

IMAGE_FOLDER: Final = "images"

# a frame of `MAX_PIXELS` without compression nearly fits; a larger file is not read into memory
MAX_FILE_BYTES: Final = 256_000_000
MAX_SIDE: Final = 20_000  # a strip of `MAX_PIXELS` is no frame; cv2.remap fails from 32,767 on
MAX_PIXELS: Final = 100_000_000
"""Largest image: more pixels than any camera of such a bench has, and 300 MB decoded."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8\xff"

# JPEG markers (ITU T.81, table B.1): DHT, JPG and DAC lie between the frame headers SOF0 to SOF15
_NO_FRAME: Final = (0xC4, 0xC8, 0xCC)
_SCAN: Final = 0xDA

# The fastest lossless settings for camera frames. The files are nearly the smallest, because noise hides the
# repetitions that the other strategies search for. OpenCV before 4.12 chooses the filter itself.
PNG_SETTINGS: Final = [
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    *([cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG] if hasattr(cv2, "IMWRITE_PNG_FILTER") else []),
]


def encode(image_bgr: NDArray[np.uint8]) -> bytes:
    """Encode an image, uint8 (H, W, 3) BGR, as PNG, without loss.

    Raises `UsageError`: the array has another type or shape, is empty, or is too large.
    """
    shape = image_bgr.shape
    is_image = image_bgr.dtype == np.uint8 and image_bgr.ndim == 3 and shape[2] == 3 and image_bgr.size > 0
    if not is_image or max(shape) > MAX_SIDE or shape[0] * shape[1] > MAX_PIXELS:
        raise UsageError(
            f"An image of {image_bgr.dtype} with shape {shape} cannot be stored.",
            next_step=f"Store BGR images as uint8 with shape (H, W, 3), of at most {MAX_PIXELS} pixels.",
        )
    encoded, png = cv2.imencode(".png", np.ascontiguousarray(image_bgr), PNG_SETTINGS)
    assert encoded  # an array of this type and size always is
    return png.tobytes()


def read_file(path: Path) -> bytes:
    """Return the bytes of an image file. An `OSError` says why it cannot be read, or that it is too large."""
    return files.read(path, max_bytes=MAX_FILE_BYTES)


def digest(png: bytes) -> str:
    """Return the SHA-256 of an image file, 64 hexadecimal digits."""
    return hashlib.sha256(png).hexdigest()


class BadImage(ValueError):
    """Bytes that are not a valid image; the message says why."""


def decode(content: bytes) -> NDArray[np.uint8]:
    """Return the pixels of any PNG or JPEG file, uint8 (H, W, 3) BGR.

    The size in the file's header is checked before memory is allocated.

    Raises `BadImage`: the file has another type, is truncated, damaged or too large.
    """
    if len(content) > MAX_FILE_BYTES:
        raise BadImage(f"{len(content)} bytes, more than {MAX_FILE_BYTES}")
    if not content.startswith((_PNG, _JPEG)):
        raise BadImage("neither a PNG nor a JPEG file")
    found = header(content)
    end = b"IEND\xaeB`\x82" if content.startswith(_PNG) else b"\xff\xd9"
    if found is None or end not in content[-4096:]:  # padding after the end is legal
        raise BadImage("truncated or damaged")
    width, height, _ = found
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise BadImage(f"{width} x {height} pixels; at most {MAX_PIXELS} pixels and sides of {MAX_SIDE} are possible")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise BadImage("damaged") from error
    if image is None:
        raise BadImage("damaged")
    return np.asarray(image, np.uint8)


def suffix(content: bytes) -> str:
    """Return the suffix of the file name for a PNG or JPEG file."""
    return ".png" if content.startswith(_PNG) else ".jpg"


class Header(NamedTuple):
    """Width and height in pixels, and whether the pixels have colours; a grey image has one channel."""

    width: int
    height: int
    is_coloured: bool


def header(content: bytes) -> Header | None:
    """Return what the header of a PNG or JPEG file tells; None if it has none."""
    if not content.startswith(_PNG):
        return _jpeg_header(content) if content.startswith(_JPEG) else None
    if content[12:16] != b"IHDR" or len(content) < 26:
        return None
    is_coloured = bool(content[25] & 2)  # the colour type of ISO/IEC 15948, 11.2.1
    return Header(int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big"), is_coloured)


def _jpeg_header(content: bytes) -> Header | None:
    """Return what the frame header tells (ITU-T T.81, B.2.2); None if there is none before the first scan."""
    at = 2
    while content[at : at + 1] == b"\xff" and len(content) >= at + 10:
        marker = content[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width = (int.from_bytes(content[start : start + 2], "big") for start in (at + 5, at + 7))
            return Header(width, height, is_coloured=content[at + 9] > 1)
        if marker == _SCAN:
            return None
        at += 1 if marker == 0xFF else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return None
