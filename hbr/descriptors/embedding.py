"""A network's embedding of the object, by a model file that the user brings."""

import zlib
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, LevelArray
from hbr.descriptors.cosine import Cosine
from hbr.descriptors.levels import check_levels
from hbr.segmentation import Segmentation, segment

#: Name of such a descriptor: this, and the model's file.
PREFIX: Final = "onnx:"
_SIDE_PX: Final = 224
#: Mean and standard deviation of R, G, B in ImageNet's photographs, which most models were trained with.
_MEAN: Final = (0.485 * 255, 0.456 * 255, 0.406 * 255)
_DEVIATION: Final = np.array([0.229, 0.224, 0.225], np.float32).reshape(1, 3, 1, 1)
#: Levels a standard deviation of an embedding's entries takes.
_STEPS: Final = 32.0


class Embedding:
    """The output of an ONNX model for the object's crop, one byte an entry, compared by cosine.

    The model takes one image, float (1, 3, 224, 224) in R, G, B, normalised as ImageNet's usually are, and returns one
    vector, the embedding before any classifier.

    Parameters
    ----------
    path : Path
        The model.

    Raises
    ------
    ValueError
        The file is missing, is no model that OpenCV can run, or does not return one vector.
    """

    def __init__(self, path: Path) -> None:
        self.name = f"{PREFIX}{path}"
        try:
            content = path.read_bytes()
        except OSError as error:
            raise ValueError(f"the model {path} cannot be read: {error.strerror}; check the path") from error
        #: Models differ by their content, whatever their file is called.
        self.version = zlib.crc32(content)
        try:
            self._net = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
            self.length = self._run(np.zeros((8, 8, 3), np.uint8)).size
        except cv2.error as error:
            raise ValueError(f"{path} is no model that OpenCV can run: {error.err}; export it again as ONNX") from error
        if self.length < 2:
            raise ValueError(f"{path} returns {self.length} number; an embedding has more, take the layer before")
        self.size_bytes = self.length

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        vector = self._run((view if isinstance(view, Segmentation) else segment(view)).alone)
        length = float(np.sqrt((vector * vector).sum()))
        entries = vector * (_STEPS * np.sqrt(self.length) / length) if length > 0 else vector
        levels: NDArray[np.float32] = np.clip(np.rint(entries) + 128, 0, 255)
        return levels.astype(np.uint8)

    def prepared(self, rows: LevelArray, /) -> Cosine:
        check_levels(self, rows)
        return Cosine(_unit(rows), _unit)

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        check_levels(self, a)
        return self.prepared(b).similarity(a)

    def pack(self, levels: LevelArray) -> bytes:
        check_levels(self, levels)
        return levels.tobytes()

    def unpack(self, packed: bytes) -> LevelArray:
        if len(packed) != self.size_bytes:
            raise ValueError(f"{len(packed)} bytes; {self.name} has {self.size_bytes}, check how it was stored")
        return np.frombuffer(packed, np.uint8)

    def _run(self, image: ImageArray) -> NDArray[np.float32]:
        blob = cv2.dnn.blobFromImage(image, 1 / 255, (_SIDE_PX, _SIDE_PX), _MEAN, swapRB=True)
        self._net.setInput(np.asarray(blob, np.float32) / _DEVIATION)
        return np.asarray(self._net.forward(), np.float32).ravel()


def _unit(levels: LevelArray) -> NDArray[np.float32]:
    rows: NDArray[np.float32] = levels.astype(np.float32) - 128
    length = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))[:, None]
    unit: NDArray[np.float32] = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    return unit
