"""Checks of images."""

from typing import Final

import numpy as np

#: Smallest side of a frame that can be segmented.
MIN_SIDE_PX: Final = 16


def check_image(image: object) -> None:
    """Check that an image is a uint8 array of shape (H, W, 3) and not empty.

    Raises `TypeError`, `ValueError`: the image has another type or shape. The message names them, and the next step.
    """
    if not isinstance(image, np.ndarray):
        raise TypeError(
            f"the image is a {type(image).__name__}, not an array; cv2.imread returns None if it cannot read the file"
        )
    if image.dtype != np.uint8:
        raise TypeError(f"the image is of {image.dtype}; scale it to 0..255 and convert it with .astype(np.uint8)")
    if image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 1):
        raise ValueError(f"the image is grey, shape {image.shape}; use cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)")
    if image.ndim == 3 and image.shape[2] == 4:
        raise ValueError(f"the image has alpha, shape {image.shape}; composite it, or use cv2.COLOR_BGRA2BGR")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"the image has shape {image.shape}; one BGR image of shape (H, W, 3) is needed")
    if image.size == 0:
        raise ValueError(f"the image is empty, shape {image.shape}; check the capture or the crop")


def check_frame(image: object) -> None:
    """Check an image like `check_image`, and that it is large enough for a segmentation.

    Raises `TypeError`, `ValueError`: as `check_image`, or a side is shorter than 16 pixels.
    """
    check_image(image)
    assert isinstance(image, np.ndarray)
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise ValueError(
            f"the frame has {image.shape[1]} x {image.shape[0]} pixels; sides of at least {MIN_SIDE_PX} are needed"
        )
