"""Image files of views: encoding, decoding and names.

Decision: docs/decisions/0005.
"""

import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core import files
from rig.core.errors import UsageError
from rig.views import jpeg_files

IMAGE_FOLDER: Final = "images"

MAX_FILE_BYTES: Final = 256_000_000
MAX_SIDE: Final = 20_000
MAX_PIXELS: Final = 100_000_000
"""Largest image: more pixels than any camera of such a bench has, and 300 MB decoded."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8\xff"

# The fastest lossless settings for camera frames. The files are nearly the smallest, because noise hides the
# repetitions that the other strategies search for. OpenCV before 4.12 chooses the filter itself.
PNG_SETTINGS: Final = [
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    *([cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG] if hasattr(cv2, "IMWRITE_PNG_FILTER") else []),
]


def encode(image_bgr: NDArray[np.uint8]) -> bytes:
    """Encode an image, uint8 (H, W, 3) BGR, as PNG, without loss.

    Raises
    ------
    UsageError
        The array has another type or shape, or is empty.
    """
    if image_bgr.dtype != np.uint8 or image_bgr.ndim != 3 or image_bgr.shape[2] != 3 or not image_bgr.size:
        raise UsageError(
            f"An image of {image_bgr.dtype} with shape {image_bgr.shape} cannot be stored.",
            next_step="Store BGR images as uint8 with shape (H, W, 3).",
        )
    if max(image_bgr.shape) > MAX_SIDE or image_bgr.shape[0] * image_bgr.shape[1] > MAX_PIXELS:
        raise UsageError(f"An image of shape {image_bgr.shape} cannot be stored.", next_step="Store a smaller image.")
    encoded, png = cv2.imencode(".png", np.ascontiguousarray(image_bgr), PNG_SETTINGS)
    if not encoded:
        raise UsageError(
            f"An image of shape {image_bgr.shape} cannot be encoded as PNG.", next_step="Store a smaller image."
        )
    return png.tobytes()


class Encoder:
    """Encodes images in a thread of its own, which leaves the interpreter to the other threads while it works.

    The thread ends with the last reference to this object.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "encoder")

    def begin(self, image_bgr: NDArray[np.uint8]) -> Future[bytes]:
        """Begin to encode an image, which must not change; the result is that of `encode`."""
        return self._thread.submit(encode, image_bgr)


def read_file(path: Path) -> bytes:
    """Return the bytes of an image file. An `OSError` says why it cannot be read, or that it is too large."""
    return files.read(path, max_bytes=MAX_FILE_BYTES)


def digest(png: bytes) -> str:
    """Return the SHA-256 of an image file, 64 hexadecimal digits."""
    return hashlib.sha256(png).hexdigest()


class BadImage(ValueError):
    """Bytes that are not a valid image; the message says why."""


def decode(content: bytes, *, max_pixels: int = MAX_PIXELS) -> NDArray[np.uint8]:
    """Return the pixels of any PNG or JPEG file, uint8 (H, W, 3) BGR.

    The size in the file's header is checked before memory is allocated.

    Raises
    ------
    BadImage
        The file has another type, is truncated, damaged or too large.
    """
    if len(content) > MAX_FILE_BYTES:
        raise BadImage(f"{len(content)} bytes, more than {MAX_FILE_BYTES}")
    if content.startswith(_PNG):
        size, end = _png_size(content), b"IEND\xaeB`\x82"
    elif content.startswith(_JPEG):
        size, end = jpeg_files.size(content), b"\xff\xd9"
    else:
        raise BadImage("neither a PNG nor a JPEG file")
    if size is None or end not in content[-4096:]:  # padding after the end is legal
        raise BadImage("truncated or damaged")
    width, height = size
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= max_pixels):
        raise BadImage(f"{width} x {height} pixels; at most {max_pixels} pixels and sides of {MAX_SIDE} are possible")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise BadImage("damaged") from error
    if image is None:
        raise BadImage("damaged")
    if content.startswith(_JPEG) and not jpeg_files.is_complete(content, np.asarray(image, np.uint8)):
        raise BadImage("truncated: its last rows are missing")
    return np.asarray(image, np.uint8)


def suffix(content: bytes) -> str:
    """Return the suffix of the file name for a PNG or JPEG file."""
    return ".png" if content.startswith(_PNG) else ".jpg"


def _png_size(content: bytes) -> tuple[int, int] | None:
    if content[12:16] != b"IHDR" or len(content) < 24:
        return None
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
