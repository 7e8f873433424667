"""Functions that draw pixels over an image."""

import cv2
import numpy as np

from sim.objects.projection import Floats, Image


def blend(below: Image, above: Image, cover: Image) -> None:
    """Draw ``above`` over ``below`` (in place), both uint8 (h, w, 3), weighted by ``cover`` (h, w), 255 for opaque."""
    weight = cv2.cvtColor(cover, cv2.COLOR_GRAY2BGR)
    laid = cv2.multiply(above, weight, scale=1 / 255)
    cv2.bitwise_not(weight, dst=weight)
    cv2.multiply(below, weight, dst=below, scale=1 / 255)
    cv2.add(below, laid, dst=below)


def place(image: Image, seen: Image, clear: Image, corner_px: Floats) -> None:
    """Draw ``seen``, already weighted by its cover, on ``image``, at a position that may be between pixels.

    They are uint8 (H, W, 3) and (h, w, 3); ``clear``, (h, w, 3), is the weight of the image below, 255 outside
    ``seen``. ``corner_px`` is the position (x, y) of the upper left pixel's centre in the image.
    """
    x, y = (int(c) for c in np.floor(corner_px))
    right, down = float(corner_px[0] - x), float(corner_px[1] - y)
    if right or down:
        seen, clear = _shifted(seen, right, down, 0), _shifted(clear, right, down, 255)
    left, top = max(x, 0), max(y, 0)
    end, bottom = min(x + seen.shape[1], image.shape[1]), min(y + seen.shape[0], image.shape[0])
    if left >= end or top >= bottom:
        return
    part = np.s_[top - y : bottom - y, left - x : end - x]
    below = image[top:bottom, left:end]
    cv2.multiply(below, clear[part], dst=below, scale=1 / 255)
    cv2.add(below, seen[part], dst=below)


def _shifted(plane: Image, right: float, down: float, beyond: int) -> Image:
    """Return ``plane`` moved by less than a pixel, bilinear, one pixel larger; new pixels are ``beyond``."""
    wide = cv2.copyMakeBorder(plane, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(beyond, beyond, beyond))
    across = cv2.addWeighted(wide[:, 1:], 1 - right, wide[:, :-1], right, 0)
    return np.asarray(cv2.addWeighted(across[1:], 1 - down, across[:-1], down, 0), dtype=np.uint8)
