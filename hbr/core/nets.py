"""Neural networks that OpenCV runs."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class SharedNet:
    """A network for several threads. One of OpenCV runs in one thread at a time, so there are as many as needed.

    ``content`` returns the ONNX file when the network is first used.
    """

    def __init__(self, content: Callable[[], bytes]) -> None:
        self._content = content
        self._idle: list[cv2.dnn.Net] = []

    def __call__(self, planes: Floats) -> Floats:
        """Return the network's only output for its input, both float32 (1, channels, h, w)."""
        try:
            net = self._idle.pop()
        except IndexError:  # other threads use all others
            net = cv2.dnn.readNetFromONNX(np.frombuffer(self._content(), np.uint8))
        net.setInput(planes)
        found: Floats = np.array(net.forward(), np.float32)
        self._idle.append(net)
        return found
