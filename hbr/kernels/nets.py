"""Neural networks: convolutions of one image, by the compiled kernel, or by NumPy.

With the kernel, all computers with x86-64 processors with AVX2, or with aarch64, return the same bits. Images are
float32 (height, width, channels).
"""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hbr.kernels.library import address, run

Floats = NDArray[np.float32]

#: Zeros around each image: the largest kernel has 5 x 5 pixels.
_AROUND: Final = 2
#: The kernel computes so many channels at once, LANES in layers.c.
_LANES: Final = 8


class _Struct(ctypes.Structure):
    """A layer for the kernel, as in layers.c."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("input", "weights", "bias", "added", "output", "taps")),
        *((name, ctypes.c_int64) for name in ("tap_count", "is_alone", "height", "width", "channels", "outputs")),
        *((name, ctypes.c_int64) for name in ("row", "column", "output_row", "output_column")),
        *((name, ctypes.c_float) for name in ("low", "high")),
    )


@dataclass(frozen=True, eq=False)
class _Layer:
    padded: Floats
    """The input with the zeros around it."""
    weights: Floats
    """Of each tap, (taps, channels, outputs); (taps, outputs) if each channel is convolved alone."""
    bias: Floats
    added: Floats | None
    output: Floats
    """A view of the image that the layer computes."""
    taps: tuple[tuple[int, int], ...]
    """Row and column of each pixel of the kernel, in the padded input."""
    stride: int
    low: float
    high: float

    def struct(self) -> tuple[_Struct, NDArray[np.int64]]:
        """Return the layer for the kernel, and an array that must live as long."""
        row, column, _ = (step // 4 for step in self.padded.strides)
        output_row, output_column, _ = (step // 4 for step in self.output.strides)
        taps = np.array([y * row + x * column for y, x in self.taps], np.int64)
        added = None if self.added is None else address(self.added)
        pointers = address(self.padded), address(self.weights), address(self.bias), added
        counts = len(taps), self.weights.ndim == 2, *self.output.shape[:2], self.padded.shape[2], self.output.shape[2]
        steps = self.stride * row, self.stride * column, output_row, output_column
        return _Struct(*pointers, address(self.output), address(taps), *counts, *steps, self.low, self.high), taps

    def compute(self) -> None:
        """Compute the layer by NumPy."""
        height, width, _ = self.output.shape
        total = self.bias if self.added is None else self.bias + self.added
        for (y, x), weights in zip(self.taps, self.weights, strict=True):
            part = self.padded[y : y + self.stride * height : self.stride, x : x + self.stride * width : self.stride]
            total = total + (part @ weights if weights.ndim == 2 else part * weights)
        np.clip(total, self.low, self.high, out=self.output)


class Net:
    """A network for images of one size. One thread at a time may use it.

    Parameters
    ----------
    height, width, channels : int
        Of the image.
    """

    def __init__(self, height: int, width: int, channels: int) -> None:
        self._layers: list[_Layer] = []
        self._structs: ctypes.Array[_Struct] | None = None
        self._taps: list[NDArray[np.int64]] = []
        self.input = self._result = _image(height, width, channels)

    def convolve(
        self,
        image: Floats,
        weights: NDArray[Any],
        bias: NDArray[Any],
        *,
        stride: int = 1,
        dilation: int = 1,
        before: int | None = None,
        added: Floats | None = None,
        low: float = -np.inf,
        high: float = np.inf,
    ) -> Floats:
        """Add a convolution, and return the image that it computes, a ``stride``-th of the size.

        Parameters
        ----------
        image : float32 array (h, w, channels)
            The network's input, or what another layer computes.
        weights : array (outputs, channels, n, n)
            The kernel, as PyTorch has it; (channels, 1, n, n): each channel is convolved alone. The number of outputs
            is a multiple of 8.
        bias : array (outputs,)
            Added to each output.
        stride, dilation : int
            Steps between the pixels of the result, and between those of the kernel.
        before : int, optional
            Rows and columns of zeros before the image; by default the kernel's middle is at each pixel.
        added : float32 array, optional
            Another image of this network, of the size of the result, which is added to it.
        low, high : float
            The sums are clipped to these limits.

        Raises
        ------
        ValueError
            There is another number of outputs, the kernel reaches too far, or the size is no multiple of the stride.
        """
        outputs, channels, side, _ = weights.shape
        before = dilation * (side // 2) if before is None else before
        places = [_AROUND - before + dilation * place for place in range(side)]
        if places[0] < 0 or places[-1] >= 2 * _AROUND + stride or any(one % stride for one in image.shape[:2]):
            reason = f"the layer reaches more than {_AROUND} pixels beyond its image, or the image has no whole size"
            raise ValueError(reason)
        taps = tuple((y, x) for y in places for x in places)
        is_alone = channels == 1 < image.shape[2]
        ordered = weights.transpose(2, 3, 1, 0).reshape(side * side, *(() if is_alone else (channels,)), outputs)
        result = _image(image.shape[0] // stride, image.shape[1] // stride, outputs)
        self._add(image, ordered, bias, added, result, taps, stride, low, high)
        self._result = result
        return result

    def double(self, image: Floats, weights: NDArray[Any], bias: NDArray[Any], added: Floats) -> Floats:
        """Add a transposed convolution, and return the image of twice the size that it computes.

        ``weights`` are (channels, outputs, 2, 2), as PyTorch has them: each pixel becomes 2 x 2 pixels. ``added`` is
        another image of this network, of the size of the result.
        """
        height, width, _ = image.shape
        result = _image(2 * height, 2 * width, weights.shape[1])
        for y in range(2):
            for x in range(2):
                part = np.s_[y::2, x::2]
                taps = ((_AROUND, _AROUND),)
                self._add(image, weights[None, :, :, y, x], bias, added[part], result[part], taps, 1, -np.inf, np.inf)
        self._result = result
        return result

    def _add(self, image: Floats, weights: NDArray[Any], bias: NDArray[Any], *rest: Any) -> None:
        if weights.shape[-1] % _LANES:
            raise ValueError(f"a layer has {weights.shape[-1]} outputs; a multiple of {_LANES} is needed")
        own, offset = np.ascontiguousarray(weights, np.float32), np.ascontiguousarray(bias, np.float32)
        assert image.base is not None
        self._layers.append(_Layer(image.base, own, offset, *rest))
        self._structs = None

    def __call__(self, image: NDArray[Any]) -> Floats:
        """Return what the last layer computes for an image (height, width, channels); valid until the next call."""
        self.input[:] = image
        if self._structs is None:
            made = [layer.struct() for layer in self._layers]
            self._structs, self._taps = (_Struct * len(made))(*(one for one, _ in made)), [taps for _, taps in made]
        if not run("hbr_layers", ctypes.addressof(self._structs), len(self._structs)):
            for layer in self._layers:
                layer.compute()
        return self._result


def _image(height: int, width: int, channels: int) -> Floats:
    """Return an image, a view of one with zeros around it."""
    return np.zeros((height + 2 * _AROUND, width + 2 * _AROUND, channels), np.float32)[
        _AROUND:-_AROUND, _AROUND:-_AROUND
    ]


class SharedNet:
    """A network for several threads: one is made for each thread that needs it at the same time.

    ``make`` returns the network when it is first used.
    """

    def __init__(self, make: Callable[[], Net]) -> None:
        self._make = make
        self._idle: list[Net] = []

    def __call__(self, image: NDArray[Any]) -> Floats:
        """Return the network's result for its input."""
        try:
            net = self._idle.pop()
        except IndexError:  # other threads use all others
            net = self._make()
        found = net(image).copy()
        self._idle.append(net)
        return found
