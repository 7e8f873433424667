"""The kernels of a view's segmentation and description have the bits of OpenCV and NumPy."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Background, descriptor, segment
from hbr.kernels import images, library, without_library
from hbr.segmentation.background import shrunk
from hbr.segmentation.cut_out import CROP_PX
from hbr.segmentation.silhouette import _cleaned as cleaned
from hbr.segmentation.silhouette import _filled as filled
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
    np.testing.assert_array_equal(images.average(part, CROP_PX), expected)


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
@examples(20)
@given(seeds, st.integers(2, 96), st.integers(2, 128), st.sampled_from([0.05, 0.5, 0.9]), st.booleans())
def test_silhouettes_are_those_by_opencv(seed: int, height: int, width: int, share: float, framed: bool) -> None:
    certain = np.random.default_rng(seed).random((height, width)) < share
    certain[height // 3 : -(height // 3), width // 3 : -(width // 3)] = True
    found, reference = both(lambda: silhouette(certain, framed=framed))
    assert (found is None) == (reference is None)
    if found is not None:
        np.testing.assert_array_equal(found, reference)


@compiled
@examples(40)
@given(seeds, st.integers(1, 100), st.integers(1, 200), st.sampled_from([0.05, 0.3, 0.6, 0.95]), st.booleans())
def test_masks_are_cleaned_and_filled_as_by_opencv(
    seed: int, height: int, width: int, share: float, fine: bool
) -> None:
    """Noise has many small parts, smooth masks have large ones with holes in holes, which touch the border."""
    values = np.random.default_rng(seed).random((height, width), np.float32)
    values = values if fine else cv2.GaussianBlur(values, (0, 0), 3).reshape(height, width)
    mask = (values <= np.quantile(values, share)).astype(np.uint8)
    np.testing.assert_array_equal(*both(lambda: cleaned(mask)))
    np.testing.assert_array_equal(*both(lambda: filled(mask)))


@compiled
@examples(20)
@given(seeds, st.integers(1, 40), st.integers(1, 60), st.sampled_from([0.03, 0.15, 0.4, 0.7]), st.booleans())
def test_parts_of_a_mask_are_those_of_opencv(seed: int, height: int, width: int, share: float, even: bool) -> None:
    rng = np.random.default_rng(seed)
    mask = (rng.random((height, width)) < share).astype(np.uint8)
    prior = np.ones_like(mask, np.float32) if even else rng.random(mask.shape, np.float32)  # even: many equal parts
    for least, of_border, part in ((1, 0.6, 0.08), (4, 1.5, 0.5)):
        labels = cv2.connectedComponents(mask)[1]
        for framed in (False, True):
            found = images.largest_parts(mask, framed, 5, least, of_border, part)
            np.testing.assert_array_equal(found, largest(labels, framed, 5, least, of_border, part))
        found = images.likely_parts(mask, prior, 3, part, 0.35)
        np.testing.assert_array_equal(found, likely(labels, prior, 3, part, 0.35))


def largest(labels: np.ndarray, framed: bool, near: int, least: float, of_border: float, share: float) -> np.ndarray:
    boxes = [cv2.boundingRect((labels == n).astype(np.uint8)) for n in range(1, labels.max() + 1)]
    areas = np.bincount(labels.ravel())[1:]
    height, width = labels.shape
    outside = [framed and (0 in box[:2] or box[0] + box[2] == width or box[1] + box[3] == height) for box in boxes]
    inner, outer = np.where(outside, 0, areas), np.where(outside, areas, 0)
    if not inner.any() or inner.max() < max(least, of_border * outer.max()):
        return np.empty(0, np.uint8)
    main = int(inner.argmax())
    kept = [
        n
        for n, box in enumerate(boxes)
        if inner[n] > share * inner[main] and (not framed or close(box, boxes[main], near))
    ]
    return np.isin(labels - 1, kept).astype(np.uint8)


def likely(labels: np.ndarray, prior: np.ndarray, near: int, share: float, mean: float) -> np.ndarray:
    boxes = [cv2.boundingRect((labels == n).astype(np.uint8)) for n in range(1, labels.max() + 1)]
    if not boxes:
        return np.empty(0, np.uint8)
    areas, weights = np.bincount(labels.ravel())[1:], np.bincount(labels.ravel(), prior.ravel())[1:]
    main = int(weights.argmax())
    kept = [
        n
        for n, box in enumerate(boxes)
        if areas[n] > share * areas[main] and weights[n] > mean * areas[n] and close(box, boxes[main], near)
    ]
    return np.isin(labels - 1, [main, *kept]).astype(np.uint8)


def close(a: tuple[int, ...], b: tuple[int, ...], away: int) -> bool:
    return all(a[k] < b[k] + b[k + 2] + away and b[k] < a[k] + a[k + 2] + away for k in (0, 1))


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
