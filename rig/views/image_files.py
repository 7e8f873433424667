"""Image files of views: encoding, decoding and names; whether all rows of a JPEG file are there (ITU-T T.81).

libjpeg fills missing rows with grey and reports them only as a line on stderr.

Decision: docs/decisions/0009.
"""

import hashlib
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
_END: Final = 0xD9  # EOI and SOS
_SCAN: Final = 0xDA
_MORE: Final = bytes(range(254, 0, -5)) * 3
"""Data that no decoder needs after the last block of a complete image."""

# The fastest lossless settings for camera frames. The files are nearly the smallest, because noise hides the
# repetitions that the other strategies search for. OpenCV before 4.12 chooses the filter itself.
PNG_SETTINGS: Final = [
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    *([cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG] if hasattr(cv2, "IMWRITE_PNG_FILTER") else []),
]


def encode(image_bgr: NDArray[np.uint8]) -> bytes:
    """Encode an image, uint8 (H, W, 3) BGR, as PNG, without loss.

    Raises `UsageError`: the array has another type or shape, or is empty.
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
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= max_pixels):
        raise BadImage(f"{width} x {height} pixels; at most {max_pixels} pixels and sides of {MAX_SIDE} are possible")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise BadImage("damaged") from error
    if image is None:
        raise BadImage("damaged")
    if content.startswith(_JPEG) and not _is_complete(content, np.asarray(image, np.uint8)):
        raise BadImage("truncated: its last rows are missing")
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


class _Segment(NamedTuple):
    marker: int
    at: int
    """Position of the marker."""
    data: bytes


def _jpeg_header(content: bytes) -> Header | None:
    """Return what the frame header (B.2.2) tells; None if there is none."""
    for segment in _segments(content):
        if 0xC0 <= segment.marker <= 0xCF and segment.marker not in _NO_FRAME and len(segment.data) >= 6:
            height, width = (int.from_bytes(segment.data[at : at + 2], "big") for at in (1, 3))
            return Header(width, height, is_coloured=segment.data[5] > 1)
    return None


def _is_complete(content: bytes, image_bgr: NDArray[np.uint8]) -> bool:
    """Return whether a JPEG file that decodes to an image, uint8 (H, W, 3) BGR, contains all of its data.

    The function checks two properties. First, the image decodes to the same pixels with more data before its end, so no
    block lacks data. Second, the scans contain every coefficient of every component to its last bit.
    """
    segments = list(_segments(content))
    if not segments or segments[-1].marker != _END or not _has_all_scans(segments):
        return False
    at = len(content[: segments[-1].at].rstrip(b"\xff"))  # fill bytes before a marker
    with _quiet_stderr():
        longer = cv2.imdecode(np.frombuffer(content[:at] + _MORE + content[at:], np.uint8), cv2.IMREAD_COLOR)
    return longer is not None and np.array_equal(longer, image_bgr)


def _segments(content: bytes) -> Iterator[_Segment]:
    """Yield the segments from the start of the image to its end (B.1.1). The data of a scan belong to none."""
    at = 2
    while (at := content.find(b"\xff", at)) >= 0 and at + 1 < len(content):
        marker = content[at + 1]
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD7:  # a stuffed or fill byte, or a restart within a scan
            at += 1 if marker == 0xFF else 2
            continue
        length = 0 if marker == _END else int.from_bytes(content[at + 2 : at + 4], "big")
        yield _Segment(marker, at, content[at + 4 : at + 2 + length])
        if marker == _END:
            return
        at += 2 + length


def _has_all_scans(segments: list[_Segment]) -> bool:
    components: set[int] = set()
    progressive = False
    done: set[tuple[int, int]] = set()
    for segment in segments:
        data = segment.data
        if 0xC0 <= segment.marker <= 0xCF and segment.marker not in _NO_FRAME:
            progressive = segment.marker in (0xC2, 0xC6, 0xCA, 0xCE)
            components = set(data[6 : 6 + 3 * data[5] : 3]) if len(data) > 5 else set()
        elif segment.marker == _SCAN and data and len(data) >= 4 + 2 * data[0]:
            begin, end, precision = data[1 + 2 * data[0] : 4 + 2 * data[0]]
            if not progressive:
                begin, end, precision = 0, 63, 0
            if precision & 0x0F == 0:  # the last bit of these coefficients
                done |= {(one, k) for one in data[1 : 1 + 2 * data[0] : 2] for k in range(begin, min(end, 63) + 1)}
    # The standard lets an encoder leave out coefficients that are all zero. No common one does, and a file that was cut
    # between two scans looks the same.
    return bool(components) and all((one, k) in done for one in components for k in range(64))


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Discard what libraries write about the added data, and pass on everything else that is written to stderr."""
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (OSError, AttributeError, ValueError):  # there is no stderr
        yield
        return
    try:
        with tempfile.TemporaryFile() as caught:
            os.dup2(caught.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(kept, 2)
            caught.seek(0)
            other = b"".join(line for line in caught if not line.startswith(b"Corrupt JPEG data"))
        with suppress(OSError):
            os.write(kept, other)
    finally:
        os.close(kept)
