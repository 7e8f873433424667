"""Laying drawn pixels over an image."""

import cv2
import numpy as np

from sim.objects.projection import Floats, Image


def blend(below: Image, above: Image, cover: Image) -> None:
    """Lay ``above`` over ``below`` (in place), both uint8 (h, w, 3), where ``cover`` (h, w) is 255."""
    weight = cover.astype(np.float32) * np.float32(1 / 255)
    cv2.blendLinear(above, below, weight, 1 - weight, dst=below)


def place(image: Image, seen: Image, clear: Image, corner_px: Floats, scale: float) -> None:
    """Lay ``seen``, already weighted by its cover, on ``image`` at a corner between pixels.

    Parameters
    ----------
    image, seen, clear
        uint8 (H, W, 3), (h, w, 3), (h, w, 3); ``clear`` is what is left of the image below, 255 where nothing is laid.
    corner_px
        Position (x, y) of the upper left pixel's centre in the image.
    scale
        Magnification of ``seen``.
    """
    corner = np.floor(corner_px)
    rest = corner_px - corner
    if scale != 1.0 or rest.any():
        size = (int(np.ceil(seen.shape[1] * scale)) + 1, int(np.ceil(seen.shape[0] * scale)) + 1)
        move = np.array([[scale, 0.0, rest[0]], [0.0, scale, rest[1]]])
        seen = np.asarray(cv2.warpAffine(seen, move, size), dtype=np.uint8)
        clear = np.asarray(cv2.warpAffine(clear, move, size, borderValue=(255, 255, 255)), dtype=np.uint8)
    x, y = int(corner[0]), int(corner[1])
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + seen.shape[1], image.shape[1]), min(y + seen.shape[0], image.shape[0])
    if left >= right or top >= bottom:
        return
    part = np.s_[top - y : bottom - y, left - x : right - x]
    below = image[top:bottom, left:right]
    cv2.multiply(below, clear[part], dst=below, scale=1 / 255)
    cv2.add(below, seen[part], dst=below)
