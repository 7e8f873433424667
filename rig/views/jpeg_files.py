"""JPEG files: their size, and whether all their rows are there (ITU-T T.81).

libjpeg fills missing rows with grey and reports them only as a line on stderr.
"""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

_NO_FRAME: Final = (0xC4, 0xC8, 0xCC)
_END: Final = 0xD9
_SCAN: Final = 0xDA
_MORE: Final = bytes(range(254, 0, -5)) * 3
"""Data that no decoder needs after the last block of a complete image."""


class _Segment(NamedTuple):
    marker: int
    at: int
    """Position of the marker."""
    data: bytes


def size(content: bytes) -> tuple[int, int] | None:
    """Return width and height from the frame header (B.2.2); None if there is none."""
    for segment in _segments(content):
        if 0xC0 <= segment.marker <= 0xCF and segment.marker not in _NO_FRAME and len(segment.data) >= 5:
            return int.from_bytes(segment.data[3:5], "big"), int.from_bytes(segment.data[1:3], "big")
    return None


def is_complete(content: bytes, image_bgr: NDArray[np.uint8]) -> bool:
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
