"""Segmentation by a small neural network: the object, the platter, and everything else.

The network sees a small frame and, where the background is known, the frame's difference from it. The background is
known from the empty-table image, or was learned while the table rotated. Its weights are in the wheel, and
How they were made says the model card: docs/explanation/segmentation-network.md.

Decision: docs/decisions/0048.
"""

from functools import cache
from importlib.resources import files
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.segmentation.background import Difference

#: Size of the network's input.
WIDTH: Final = 128
HEIGHT: Final = 96
WEIGHTS: Final = "network.onnx"
#: Scales of the difference, in logarithms: brightness, and colour.
EVENLY: Final = 1.0
COLOURED: Final = 0.7
#: Trust in a background that was learned from other views; 1 for an empty-table image.
LEARNED: Final = 0.5
#: A network of OpenCV runs in one thread at a time, so there are as many as threads that needed one at the same time.
_IDLE: Final[list[cv2.dnn.Net]] = []

Floats = NDArray[np.float32]


class Shares(NamedTuple):
    """The probability of each pixel of a small frame to show the object, and the platter; float32 (h, w)."""

    object: Floats
    platter: Floats


def shares(small: ImageArray, difference: Difference | None = None, *, learned: bool = False) -> Shares:
    """Return where a small frame shows the object and the platter.

    Parameters
    ----------
    small : uint8 array (h, w, 3)
        As `hbr.segmentation.background.shrunk` returns it.
    difference : Difference, optional
        Of the frame from its background.
    learned : bool
        Whether the background was learned from other views, which may show the object, too.
    """
    height, width = small.shape[:2]
    planes = np.zeros((1, 8, HEIGHT, WIDTH), np.float32)
    planes[0, :3] = _sized(small).transpose(2, 0, 1)
    planes[0, :3] *= np.float32(1 / 255)
    planes[0, :3] -= np.float32(0.5)
    planes[0, 3:5] = _places()
    if difference is not None:
        planes[0, 5] = np.clip(_sized(difference.evenly) * np.float32(1 / EVENLY), -1, 1)
        planes[0, 6] = np.clip(_sized(difference.coloured) * np.float32(1 / COLOURED), 0, 1)
        planes[0, 7] = LEARNED if learned else 1.0
    logits = _logits(planes)
    found = [1 / (1 + cv2.exp(-plane)) for plane in logits]
    if (height, width) != (HEIGHT, WIDTH):
        found = [cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) for share in found]
    return Shares(*(np.asarray(share, np.float32) for share in found))


def _sized(plane: NDArray[Any]) -> NDArray[Any]:
    if plane.shape[:2] == (HEIGHT, WIDTH):
        return plane
    return np.asarray(cv2.resize(plane, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


@cache
def _places() -> Floats:
    """Return each pixel's place from -1 to 1: across, and down."""
    y, x = np.meshgrid(np.linspace(-1, 1, HEIGHT), np.linspace(-1, 1, WIDTH), indexing="ij")
    return np.stack([x, y]).astype(np.float32)


def _logits(planes: Floats) -> Floats:
    """Return the network's answer to its input, float32 (2, HEIGHT, WIDTH)."""
    try:
        net = _IDLE.pop()
    except IndexError:  # other threads use all others
        net = cv2.dnn.readNetFromONNX(np.frombuffer(_weights(), np.uint8))
    net.setInput(planes)
    logits: Floats = np.array(net.forward(), np.float32)[0]
    _IDLE.append(net)
    return logits


@cache
def _weights() -> bytes:
    return files("hbr.segmentation").joinpath(WEIGHTS).read_bytes()
