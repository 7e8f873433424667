"""Networks compute what their layers say, by the kernel and by NumPy."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import correlate

from hbr.kernels import without_library
from hbr.kernels.nets import Net, SharedNet
from tests.fuzzing import examples

by_numpy = pytest.mark.parametrize("by_numpy", [False, True], ids=["kernel", "NumPy"])


def reference(image: np.ndarray, weights: np.ndarray, stride: int, dilation: int, before: int) -> np.ndarray:
    """Return the convolution of an image (h, w, channels) as PyTorch defines it."""
    outputs, channels, side, _ = weights.shape
    spread = np.zeros((outputs, channels, *[dilation * (side - 1) + 1] * 2))
    spread[:, :, ::dilation, ::dilation] = weights
    around = np.pad(image.astype(np.float64), ((before, 6), (before, 6), (0, 0))).transpose(2, 0, 1)
    if channels == 1 < image.shape[2]:  # each channel alone
        full = [correlate(around[n], spread[n, 0], "valid") for n in range(outputs)]
    else:
        full = [correlate(around, spread[n], "valid")[0] for n in range(outputs)]
    height, width = image.shape[0] // stride, image.shape[1] // stride
    return np.stack(full, axis=-1)[: stride * height : stride, : stride * width : stride]


@by_numpy
@examples(25)
@given(
    size=st.tuples(st.integers(1, 8), st.integers(1, 16)),
    channels=st.sampled_from([1, 3, 8, 13, 24]),
    outputs=st.sampled_from([8, 16, 24, 40, 48]),
    side=st.sampled_from([1, 2, 3, 5]),
    stride=st.sampled_from([1, 2]),
    is_alone=st.booleans(),
    is_added=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_convolution_is_that_of_scipy(
    by_numpy: bool,
    size: tuple[int, int],
    channels: int,
    outputs: int,
    side: int,
    stride: int,
    is_alone: bool,
    is_added: bool,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    height, width = (stride * part for part in size)
    channels = outputs if is_alone else channels
    dilation = 2 if side == 3 and stride == 1 else 1
    reach = dilation * (side - 1)
    before = int(rng.integers(max(0, reach - 1 - stride), min(2, reach) + 1))
    image = rng.normal(size=(height, width, channels)).astype(np.float32)
    weights = rng.normal(size=(outputs, 1 if is_alone else channels, side, side)).astype(np.float32)
    bias = rng.normal(size=outputs).astype(np.float32)
    expected = reference(image, weights, stride, dilation, before) + bias
    net = Net(height, width, channels)
    added = None
    if is_added:
        more = rng.normal(size=(outputs, channels, 1, 1)).astype(np.float32)
        added = net.convolve(net.input, more, np.zeros(outputs), stride=stride)
        expected = expected + reference(image, more, stride, 1, 0)
    net.convolve(
        net.input, weights, bias, stride=stride, dilation=dilation, before=before, added=added, low=-1.0, high=2.0
    )
    with without_library() if by_numpy else nullcontext():
        found = net(image)
        np.testing.assert_allclose(found, np.clip(expected, -1, 2), atol=1e-4)
        np.testing.assert_array_equal(net(image), found)  # nothing of the first image is left


@by_numpy
def test_each_pixel_is_doubled_and_added(by_numpy: bool) -> None:
    rng = np.random.default_rng(1)
    image = rng.normal(size=(12, 16, 8)).astype(np.float32)
    halved, weights, bias = rng.normal(size=(24, 8, 1, 1)), rng.normal(size=(24, 8, 2, 2)), rng.normal(size=8)
    net = Net(12, 16, 8)
    half = net.convolve(net.input, halved, np.zeros(24), stride=2)
    net.double(half, weights, bias, net.input)
    with without_library() if by_numpy else nullcontext():
        found = net(image)
    pixels = np.einsum("yxc,dc,doij->yixjo", image[::2, ::2], halved[..., 0, 0], weights).reshape(12, 16, 8)
    np.testing.assert_allclose(found, pixels + bias + image, atol=1e-4)


def test_layers_that_the_kernel_cannot_compute_are_rejected() -> None:
    net = Net(4, 5, 3)
    with pytest.raises(ValueError, match="a layer has 12 outputs; a multiple of 8 is needed"):
        net.convolve(net.input, np.zeros((12, 3, 1, 1)), np.zeros(12))
    for side, more in ((7, {}), (5, {"before": 1}), (3, {"before": 3}), (1, {"stride": 2})):
        with pytest.raises(ValueError, match="reaches more than 2 pixels beyond its image"):
            net.convolve(net.input, np.zeros((8, 3, side, side)), np.zeros(8), **more)


def test_threads_do_not_share_the_memory_of_a_network() -> None:
    def make() -> Net:
        net = Net(40, 40, 3)
        net.convolve(net.input, weights, np.zeros(16))
        return net

    rng = np.random.default_rng(2)
    weights, images = rng.normal(size=(16, 3, 5, 5)), rng.normal(size=(40, 40, 40, 3))
    net = SharedNet(make)
    alone = [net(image) for image in images]
    with ThreadPoolExecutor(4) as pool:
        np.testing.assert_array_equal(list(pool.map(net, images)), alone)
