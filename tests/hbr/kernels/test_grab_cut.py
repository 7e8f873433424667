"""The kernel of the cut by colours returns the mask of OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hbr.evaluation.changed_bench import HARD, Bench, Visit
from hbr.kernels import library, without_library
from hbr.kernels.images import grab_cut
from hbr.segmentation.background import shrunk
from hbr.segmentation.guess import guess_object
from tests.fuzzing import examples

compiled = pytest.mark.skipif(library() is None, reason="the kernels are not compiled: there is no C compiler")
seeds = st.integers(0, 2**32 - 1)

Image = NDArray[np.uint8]


def pictures(rng: np.random.Generator, height: int, width: int) -> list[Image]:
    """Return noise, smooth colours, discs, greys, few colours, nearly equal colours, and one colour."""
    shape = height, width, 3
    coarse = rng.integers(0, 256, (height // 20 + 2, width // 20 + 2, 3), np.uint8)
    discs = np.full(shape, rng.integers(256, size=3), np.uint8)
    for _ in range(rng.integers(1, 9)):
        middle, radius = (int(rng.integers(width)), int(rng.integers(height))), int(rng.integers(1, 40))
        cv2.circle(discs, middle, radius, rng.integers(0, 256, 3).tolist(), -1)
    return [
        rng.integers(0, 256, shape, np.uint8),
        cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC),
        discs,
        np.dstack([rng.normal(128, 30, shape[:2]).clip(0, 255).astype(np.uint8)] * 3),
        rng.choice(rng.integers(0, 256, (rng.integers(1, 8), 3), np.uint8), shape[:2]),
        (rng.integers(0, rng.integers(1, 8), shape) * rng.integers(1, 36)).astype(np.uint8),
        np.full(shape, rng.integers(256, size=3), np.uint8),
    ]


def frame(seed: int) -> Image:
    """Return a small frame of a disc of two colours on a drawn bench."""
    rng = np.random.default_rng(seed)
    photograph = np.zeros((128, 128, 3), np.uint8)
    cv2.circle(photograph, (64, 64), int(rng.integers(20, 60)), rng.integers(30, 256, 3).tolist(), -1)
    cv2.circle(photograph, (50, 50), 12, rng.integers(30, 256, 3).tolist(), -1)
    visit = Visit(Bench.drawn(rng), HARD, rng)
    return shrunk(visit.photograph(photograph, photograph.any(axis=2), float(rng.uniform(0, 360))).image)


def rectangle(height: int, width: int) -> tuple[int, int, int, int]:
    return int(0.2 * width), int(0.12 * height), int(0.8 * width), int(0.9 * height)


def by_opencv(image: Image, start: NDArray[np.bool_]) -> NDArray[np.bool_]:
    labels = np.full(start.shape, cv2.GC_BGD, np.uint8)
    left, top, right, bottom = rectangle(*start.shape)
    inner = np.where(start[top:bottom, left:right], cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    labels[top:bottom, left:right] = inner
    cv2.setRNGSeed(0)
    cv2.grabCut(image, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 1, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))


def middle(height: int, width: int, size: float) -> NDArray[np.bool_]:
    y, x = np.mgrid[:height, :width]
    ellipse: NDArray[np.bool_] = np.hypot(x / width - 0.5, 0.7 * (y / height - 0.56)) < size
    return ellipse


@compiled
@examples(10)
@given(
    seed=seeds,
    kind=st.integers(0, 6),
    shape=st.sampled_from([(96, 128), (32, 128), (77, 40), (32, 32)]),
    size=st.sampled_from([0.1, 0.19, 0.3, None]),
    smooth=st.booleans(),
)
def test_masks_of_drawn_images_are_those_of_opencv(
    seed: int, kind: int, shape: tuple[int, int], size: float | None, smooth: bool
) -> None:
    rng = np.random.default_rng(seed)
    image = pictures(rng, *shape)[kind]
    image = cv2.bilateralFilter(image, 5, 30, 3).astype(np.uint8) if smooth else image
    start = rng.random(shape) < 0.3 if size is None else middle(*shape, size)
    found = grab_cut(image, start, rectangle(*shape))
    assert found is not None
    np.testing.assert_array_equal(found, by_opencv(image, start))


@compiled
@examples(2)
@given(seed=seeds, size=st.sampled_from([0.1, 0.19, 0.3]))
def test_masks_of_frames_are_those_of_opencv(seed: int, size: float) -> None:
    image = frame(seed)
    start = middle(*image.shape[:2], size)
    np.testing.assert_array_equal(grab_cut(image, start, rectangle(*start.shape)), by_opencv(image, start))


@compiled
@examples(2)
@given(seeds)
def test_guesses_are_those_with_opencv(seed: int) -> None:
    image = frame(seed)
    with without_library():
        reference = guess_object(image)
    found = guess_object(image)
    assert (found is None) == (reference is None)
    if found is not None and reference is not None:
        np.testing.assert_array_equal(found, reference)


@compiled
def test_too_few_or_too_many_pixels_are_left_to_opencv() -> None:
    image, start = frame(2), np.zeros((96, 128), np.bool_)
    start[50, 60:64] = True
    assert grab_cut(image, start, rectangle(96, 128)) is None
    large = np.zeros((300, 300, 3), np.uint8)
    assert grab_cut(large, middle(300, 300, 0.2), rectangle(300, 300)) is None
