"""The kernels of a view's segmentation and description have the bits of OpenCV and NumPy."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Background, descriptor, segment
from hbr.kernels import library, view, without_library
from hbr.segmentation.background import shrunk
from hbr.segmentation.cut_out import CROP_PX
from hbr.segmentation.silhouette import silhouette
from tests.fuzzing import examples

compiled = pytest.mark.skipif(library() is None, reason="the kernels are not compiled: there is no C compiler")
seeds = st.integers(0, 2**32 - 1)


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return noise, smooth colours, or one colour, uint8 (height, width, 3)."""
    match rng.integers(3):
        case 0:
            return rng.integers(0, 256, (height, width, 3), np.uint8)
        case 1:
            coarse = rng.integers(0, 256, (height // 20 + 2, width // 20 + 2, 3), np.uint8)
            return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.full((height, width, 3), rng.integers(256), np.uint8)


def both(work: Callable[[], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    with without_library():
        reference = work()
    return work(), reference


@compiled
@examples(15)
@given(seeds, st.integers(3, 11), st.integers(20, 96), st.booleans())
def test_frames_are_shrunk_as_by_opencv(seed: int, factor: int, height: int, every_other: bool) -> None:
    frame = picture(np.random.default_rng(seed), height * factor, 128 * factor)
    if every_other:
        frame = np.repeat(frame, 2, axis=0)[::2]
    np.testing.assert_array_equal(*both(lambda: shrunk(frame)))


@compiled
@examples(15)
@given(seeds, st.integers(CROP_PX + 1, 500).filter(lambda size: size % CROP_PX), st.integers(0, 40))
def test_squares_are_averaged_as_by_opencv(seed: int, size: int, left: int) -> None:
    part = picture(np.random.default_rng(seed), size, size + 40)[:, left : left + size]
    expected = cv2.resize(part, (CROP_PX, CROP_PX), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(view.average(part, CROP_PX), expected)


@compiled
@examples(15)
@given(seeds, st.sampled_from([(96, 128), (50, 128), (128, 128), (17, 128)]), st.integers(0, 60))
def test_frames_differ_from_the_table_as_by_numpy(seed: int, shape: tuple[int, int], other: int) -> None:
    rng = np.random.default_rng(seed)
    frame = picture(rng, *shape)
    table = np.clip(frame + rng.integers(-other, other + 1, (*shape, 3)), 0, 255).astype(np.uint8)
    background = Background.learned(table, shape)
    found, reference = both(lambda: background.difference(frame))
    for name in ("agreement", "certain", "possible", "evenly", "coloured"):
        np.testing.assert_array_equal(getattr(found, name), getattr(reference, name), err_msg=name)
    np.testing.assert_array_equal(found.correction.slopes, reference.correction.slopes)


@compiled
@examples(15)
@given(seeds, st.integers(2, 96), st.integers(2, 128), st.sampled_from([0.05, 0.5, 0.9]))
def test_silhouettes_are_filled_as_by_opencv(seed: int, height: int, width: int, share: float) -> None:
    certain = np.random.default_rng(seed).random((height, width)) < share
    certain[height // 3 : -(height // 3), width // 3 : -(width // 3)] = True
    found, reference = both(lambda: silhouette(certain, framed=False))
    assert (found is None) == (reference is None)
    if found is not None:
        np.testing.assert_array_equal(found, reference)


@compiled
@examples(10)
@given(seeds)
def test_descriptors_of_the_object_have_the_bits_of_their_references(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = segment(picture(rng, 200, 200), box=(20, 30, 120, 150))
    found.mask[:] = picture(rng, CROP_PX, CROP_PX)[:, :, 0]
    for name in ("edges", "colours"):
        np.testing.assert_array_equal(*both(lambda name=name: descriptor(name).describe(found)))


@compiled
@examples(10)
@given(seeds, st.booleans())
def test_the_grey_around_the_object_has_the_bits_of_opencv(seed: int, sharp: bool) -> None:
    rng = np.random.default_rng(seed)
    crop, mask = picture(rng, CROP_PX, CROP_PX), picture(rng, CROP_PX, CROP_PX)[:, :, 0]
    mask = np.where(mask > 127, 255, 0).astype(np.uint8) if sharp else mask
    found = replace(segment(picture(rng, 40, 40), box=(5, 5, 20, 20)), crop=crop, mask=mask)
    np.testing.assert_array_equal(*both(lambda: replace(found).alone))
