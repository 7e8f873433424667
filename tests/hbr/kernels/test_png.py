"""PNG files of the kernel: every program reads the pixels that were written."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr.kernels import library, without_library
from hbr.kernels.png import png
from rig.views.image_files import decode, encode
from tests.fuzzing import examples
from tests.hbr.kernels.test_kernels import images

compiled = pytest.mark.skipif(library() is None, reason="the kernels are not compiled: there is no C compiler")


@compiled
@examples(30)
@given(images())
def test_pixels_are_read_as_they_were_written(image: np.ndarray) -> None:
    content = png(image)
    assert content is not None
    np.testing.assert_array_equal(decode(content), image)


@compiled
@given(st.integers(1, 400), st.integers(0, 255), st.integers(2, 25))
@examples(10)
def test_codes_of_very_rare_bytes_are_not_too_long(width: int, step: int, count: int) -> None:
    """The numbers of bytes grow as those of Fibonacci, for which Huffman's codes are the longest."""
    numbers = [1, 1]
    while len(numbers) < count:
        numbers.append(sum(numbers[-2:]))
    values = np.repeat(np.arange(count) * step % 256, numbers).astype(np.uint8)
    image = np.resize(np.cumsum(values, dtype=np.uint8), (len(values) // width + 1, width, 3))
    content = png(image)
    assert content is not None
    np.testing.assert_array_equal(decode(content), image)


def test_files_of_frames_are_nearly_as_small_as_those_of_opencv() -> None:
    rng = np.random.default_rng(1)
    smooth = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
    frame = np.clip(smooth + rng.normal(0, 3, smooth.shape), 0, 255).astype(np.uint8)
    with without_library():
        size = len(encode(frame))
    assert len(encode(frame)) < 1.02 * size
