"""Images of views: encoding and file names."""

import hashlib
import re
import unicodedata
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.errors import CatalogError, UsageError
from rig.files import sync_folder

IMAGE_FOLDER: Final = "images"
MAX_SLUG_LENGTH: Final = 40

# The fastest lossless settings for camera frames, and among the smallest: noise hides the repeats that the other
# strategies search for. OpenCV before 4.12 chooses its filter by itself.
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
        The image has another type or shape, or is empty.
    """
    if image_bgr.dtype != np.uint8 or image_bgr.ndim != 3 or image_bgr.shape[2] != 3 or not image_bgr.size:
        raise UsageError(
            f"an image of {image_bgr.dtype} with shape {image_bgr.shape}",
            next_step="store BGR images as uint8 with shape (H, W, 3)",
        )
    encoded, png = cv2.imencode(".png", np.ascontiguousarray(image_bgr), PNG_SETTINGS)
    if not encoded:
        raise UsageError(
            f"an image of shape {image_bgr.shape} cannot be encoded as PNG", next_step="store a smaller image"
        )
    return png.tobytes()


def digest(png: bytes) -> str:
    """Return the SHA-256 of an image file, 64 hexadecimal digits."""
    return hashlib.sha256(png).hexdigest()


def read(path: Path, sha256: str) -> NDArray[np.uint8]:
    """Return the stored pixels, uint8 (H, W, 3) BGR.

    Raises
    ------
    CatalogError
        The file is missing or is not the one that was stored.
    """
    mend = "restore the image from a backup, or enroll the object again with --replace"
    try:
        png = path.read_bytes()
    except FileNotFoundError as error:
        raise CatalogError(f"the image {path} is missing", next_step=mend) from error
    if digest(png) != sha256:
        raise CatalogError(f"the image {path} is not the one that was stored", next_step=mend)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(image, np.uint8)


def folder(object_id: int, object_name: str, enrollment_id: int) -> Path:
    """Return an enrollment's folder, relative to the catalog; the id makes it unique, the name is for people."""
    ascii_name = unicodedata.normalize("NFKD", object_name).encode("ascii", "ignore").decode().lower()
    slug = re.sub(r"[^a-z0-9]+", "-", ascii_name)[:MAX_SLUG_LENGTH].strip("-")
    return Path(IMAGE_FOLDER, f"{object_id:06d}-{slug}".rstrip("-"), f"{enrollment_id:06d}")


def make_folder(path: Path, *, within: Path) -> None:
    """Create ``path`` and the folders between it and ``within``, each durably known to the one above it."""
    path.mkdir(parents=True, exist_ok=True)
    for above in path.parents:
        sync_folder(above)
        if above == within:
            return
