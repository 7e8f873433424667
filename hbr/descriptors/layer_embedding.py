"""A middle layer of a neural network as a descriptor: pooled on a grid, whitened, and joined with another descriptor.

The descriptor is a file of its own, made by `fit_layer`: the ONNX file, cut off behind the layer, and the whitening
that was fitted to enrolled views. Every computer with this file can search a model set that was described by it. A
saved run identifies the file by its SHA-256.
"""

import io
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.cosine import Cosine
from hbr.descriptors.embedding import PREFIX, opened, output, to_levels, unit
from hbr.descriptors.joined import Joined
from hbr.descriptors.onnx_layers import cut_behind
from hbr.segmentation import Segmentation, segment

#: Beginning of such a file, which is a ZIP file of arrays.
MAGIC: Final = b"PK\x03\x04"
#: Cells of the grid on each side.
GRID: Final = 4
#: Number of levels, and share of the other descriptor in the similarity.
LENGTH: Final = 128
OWN_SHARE: Final = 0.5
#: Share of the mean variance that is added to all variances before whitening, as in `hbr.dense.whitening`.
_SHRINKAGE: Final = 0.3
_ARRAYS: Final = ("model", "mean", "transform", "own_share")


@dataclass(frozen=True, eq=False)
class GridLayer(Descriptor):
    """The output of a network on a grid of 4 x 4 cells, whitened, one byte for each number, compared by cosine."""

    net: cv2.dnn.Net
    mean: FloatArray
    transform: FloatArray
    name: str = ""
    version: int = 1

    @property
    def length(self) -> int:
        return int(self.transform.shape[1])

    @property
    def size_bytes(self) -> int:
        return self.length

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        return to_levels(((_features(self.net, _alone(view)) - self.mean) @ self.transform).astype(np.float32))

    def prepared(self, rows: LevelArray, /) -> Cosine:
        self.check_rows(rows)
        return Cosine.of(rows, unit)


@dataclass(frozen=True)
class LayerEmbedding(Joined):
    """A descriptor from a file: another descriptor and a layer side by side."""

    path: Path = Path()


def load_layer(path: Path, content: bytes, own: Descriptor) -> LayerEmbedding:
    """Return the descriptor of a file that `fit_layer` has written; it joins ``own`` with the layer.

    Raises
    ------
    ValueError
        The file is damaged, or OpenCV cannot run the network.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            model, mean, transform, own_share = (np.asarray(stored[name]) for name in _ARRAYS)
        share = float(own_share)
        if mean.ndim != 1 or transform.shape[:1] != mean.shape or transform.ndim != 2 or not 0 <= share <= 1:
            raise ValueError("its arrays do not fit together")
        layer = GridLayer(opened(path, model.tobytes()), mean.astype(np.float64), transform.astype(np.float64))
        if _features(layer.net, np.zeros((8, 8, 3), np.uint8)).shape != mean.shape:
            raise ValueError("its whitening is that of another layer")
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error, cv2.error) as error:
        raise ValueError(f"{path} is no descriptor that fit_layer has written: {error}") from error
    parts: tuple[Descriptor, ...] = (own, layer) if share else (layer,)
    weights = (share, 1 - share) if share else (1.0,)
    return LayerEmbedding(PREFIX + sha256(content).hexdigest(), 1, parts, weights, path)


def fit_layer(
    network: Path,
    layer: str,
    views: Iterable[ImageArray | Segmentation],
    target: Path,
    *,
    length: int = LENGTH,
    own_share: float = OWN_SHARE,
) -> None:
    """Write the descriptor of a layer, whitened on these views: `hbr.descriptors.load_model` and ``onnx:FILE`` read it.

    Parameters
    ----------
    network : Path
        An ONNX file for images as `hbr.descriptors.embedding.Embedding` gives them.
    layer : str
        Name of a node's output (`hbr.descriptors.onnx_layers.layers`). An early block distinguishes objects better than
        the last layer.
    views : iterable of uint8 arrays (H, W, 3), or Segmentation
        Enrolled views, of as many objects as possible; at least two.
    target : Path
        The file to write.
    length : int
        Largest number of levels, each one byte.
    own_share : float
        Share of the rig's own descriptor in the similarity, 0..1; 0 leaves it out.

    Raises
    ------
    ValueError
        There is no such layer, OpenCV cannot run the network, or there are too few views.
    """
    if not 0 <= own_share < 1:
        raise ValueError(f"own_share is {own_share}; a share from 0 to below 1 is needed")
    try:
        model = cut_behind(network.read_bytes(), layer)
    except OSError as error:
        raise ValueError(f"the model {network} cannot be read: {error.strerror}; check the path") from error
    net = opened(network, model)
    rows = np.array([_features(net, _alone(view)) for view in views])
    if len(rows) < 2:
        raise ValueError(f"there are {len(rows)} views; the whitening needs at least 2, better some hundreds")
    mean = rows.mean(axis=0)
    _, sizes, directions = np.linalg.svd(rows - mean, full_matrices=False)
    variances = sizes**2 / (len(rows) - 1)
    kept = min(length, int((variances > 1e-12 * max(variances.max(), 1e-300)).sum()))
    if kept < 2:
        raise ValueError(f"the layer {layer!r} is nearly the same for all views; choose another one")
    scale = 1 / np.sqrt(variances[:kept] + _SHRINKAGE * variances.sum() / len(mean))
    transform = (directions[:kept].T * scale).astype(np.float32)
    stored = np.frombuffer(model, np.uint8)
    with target.open("wb") as file:
        np.savez(file, model=stored, mean=mean.astype(np.float32), transform=transform, own_share=np.array(own_share))


def _alone(view: ImageArray | Segmentation) -> ImageArray:
    return (view if isinstance(view, Segmentation) else segment(view)).alone


def _features(net: cv2.dnn.Net, image: ImageArray) -> FloatArray:
    """Return the output of a network for an image, averaged over the cells of a grid, of unit length."""
    found = output(net, image)
    if found.ndim != 4 or min(found.shape[2:]) < GRID:
        raise ValueError(
            f"the layer has the shape {found.shape}; one with a picture of at least {GRID} x {GRID} is needed"
        )
    planes = np.moveaxis(found[0], 0, -1)
    rows, columns = (np.linspace(0, side, GRID + 1).astype(int) for side in planes.shape[:2])
    cells: NDArray[np.float32] = np.add.reduceat(np.add.reduceat(planes, rows[:-1], axis=0), columns[:-1], axis=1)
    means = (cells / (np.diff(rows)[:, None, None] * np.diff(columns)[:, None])).ravel().astype(np.float64)
    length = float(np.linalg.norm(means))
    scaled: FloatArray = means / length if length > 0 else means
    return scaled
