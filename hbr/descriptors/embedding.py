"""Embedding of the object by a neural network, from a model file that the user provides."""

import re
from hashlib import sha256
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.similarity import Cosine
from hbr.segmentation import Segmentation, segment

#: The name of such a descriptor is this prefix and the SHA-256 of the model file.
PREFIX: Final = "onnx:"
#: The name of a model.
MODEL_NAME: Final = re.compile(PREFIX + "[0-9a-f]{64}")
#: Reading and running a larger model would need more than 1 GiB.
MAX_MODEL_BYTES: Final = 256_000_000
_SIDE_PX: Final = 224  # the usual input of networks that were trained with ImageNet
#: Mean and standard deviation of R, G, B in ImageNet, with which most models were trained.
_MEAN: Final = (0.485 * 255, 0.456 * 255, 0.406 * 255)
_DEVIATION: Final = np.array([0.229, 0.224, 0.225], np.float32).reshape(1, 3, 1, 1)
#: Number of levels in one standard deviation of an embedding's entries.
_STEPS: Final = 32.0


class Embedding(Descriptor):
    """Output of an ONNX model for the object's crop, one byte for each entry, compared by cosine.

    The model takes one image, float (1, 3, 224, 224) in R, G, B, normalised by ImageNet's mean and deviation, and
    returns one vector: the embedding before the classifier.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        content = read_model(path)
        self._digest = sha256(content).hexdigest()
        self._net = opened(path, content)
        self._length = output(self._net, np.zeros((8, 8, 3), np.uint8)).size
        if self._length < 2:
            raise ValueError(f"{path} returns {self._length} number; an embedding has more, export the layer before")

    @property
    def name(self) -> str:
        return f"{PREFIX}{self._digest}"

    @property
    def version(self) -> int:
        """Always 1: another model has another name."""
        return 1

    @property
    def length(self) -> int:
        return self._length

    @property
    def size_bytes(self) -> int:
        return self._length

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        return to_levels(output(self._net, (view if isinstance(view, Segmentation) else segment(view)).alone).ravel())

    def prepared(self, rows: LevelArray, /) -> Cosine:
        self.check_rows(rows)
        return Cosine.of(rows, unit)


def read_model(path: Path) -> bytes:
    """Return the content of a model file."""
    try:
        if path.exists() and not path.is_file():  # reading a pipe waits, and a device can have no end
            raise ValueError(f"the model {path} is not a regular file; check the path")
        with path.open("rb") as file:
            content = file.read(MAX_MODEL_BYTES + 1)
    except OSError as error:
        raise ValueError(f"the model {path} cannot be read: {error.strerror}; check the path") from error
    if len(content) > MAX_MODEL_BYTES:
        raise ValueError(f"the model {path} is larger than {MAX_MODEL_BYTES} bytes; use a smaller one")
    return content


def opened(path: Path, content: bytes) -> cv2.dnn.Net:
    """Return the network of an ONNX file after a first run.

    Raises `ValueError`: openCV cannot run it.
    """
    try:
        net = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
        output(net, np.zeros((8, 8, 3), np.uint8))
    except cv2.error as error:
        raise ValueError(f"{path} is no model that OpenCV can run: {error.err}; export it again as ONNX") from error
    return net


def output(net: cv2.dnn.Net, image: ImageArray) -> NDArray[np.float32]:
    """Return what a network returns for an image, uint8 (H, W, 3)."""
    blob = cv2.dnn.blobFromImage(image, 1 / 255, (_SIDE_PX, _SIDE_PX), _MEAN, swapRB=True)
    net.setInput(np.asarray(blob, np.float32) / _DEVIATION)
    return np.asarray(net.forward(), np.float32)


def to_levels(vector: NDArray[np.float32]) -> LevelArray:
    """Return the levels of a vector, for any length; 128 is 0."""
    length = float(np.sqrt((vector * vector).sum()))
    entries = vector * (_STEPS * np.sqrt(vector.size) / length) if length > 0 else vector
    levels: NDArray[np.float32] = np.clip(np.rint(entries) + 128, 0, 255)
    return levels.astype(np.uint8)


def unit(levels: LevelArray) -> NDArray[np.float32]:
    """Return levels, uint8 (n, length), as vectors of unit length, float32 (n, length)."""
    rows: NDArray[np.float32] = levels.astype(np.float32) - 128
    length = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))[:, None]
    scaled: NDArray[np.float32] = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    return scaled
