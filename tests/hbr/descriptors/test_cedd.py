import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import cedd, describe
from hbr.descriptors.cedd import (
    VOTE_BINS,
    _areas,
    _colour_outputs,
    _covered_size,
    _grid,
    _hsv,
    _luminance,
    _row_sums,
    _texture_votes,
    covered,
)
from tests.fuzzing import examples
from tests.hbr.descriptors.cedd_reference import area, cedd_reference, colours, hsv, texture_classes

Image = np.ndarray[Any, np.dtype[np.uint8]]


def flat(bgr: tuple[int, int, int], height: int = 80, width: int = 80) -> Image:
    return np.full((height, width, 3), bgr, np.uint8)


def noise(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def areas(image: Image) -> np.ndarray[Any, np.dtype[np.float64]]:
    grid = _grid(*image.shape[:2])
    return _areas(image, _luminance(_row_sums(image, grid), grid), grid)


def test_equals_the_golden_vectors(rig_test_data: Path) -> None:
    folder = rig_test_data / "cedd-golden"
    images = json.loads((folder / "cedd_lire.json").read_text())["images"]
    assert len(images) == 78
    different = [
        image["file"]
        for image in images
        if cedd(cv2.imread(str(folder / image["file"]))).tolist() != image["cedd"]  # type: ignore[arg-type]
    ]
    assert different == []


side = st.one_of(st.integers(1, 45), st.sampled_from([2, 39, 40, 41, 79, 80, 81, 119, 120, 121, 160, 163]))


@st.composite
def images(draw: st.DrawFn) -> Image:
    """Draw noise, patches of few colours, gradients and greys, which together reach every branch of the definition."""
    height, width = draw(side), draw(side)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    patch = draw(st.sampled_from([1, 2, 3, 5, 16]))
    low, high = sorted((draw(st.integers(0, 255)), draw(st.integers(0, 255))))
    coarse = (height // patch + 1, width // patch + 1)
    pixels = rng.integers(low, high + 1, (*coarse, 3), dtype=np.uint8)
    if draw(st.booleans()):  # grey: the true mean is a whole number, so rounding decides
        pixels[:] = pixels[:, :, :1]
    image: Image = np.kron(pixels, np.ones((patch, patch, 1), np.uint8))[:height, :width]
    return np.ascontiguousarray(image)


@examples(10)
@given(images())
def test_equals_the_literal_definition(image: Image) -> None:
    assert cedd(image).tolist() == cedd_reference(image)


@pytest.mark.parametrize(
    ("height", "width"),
    [(480, 640), (100, 3000), *(pytest.param(*size, marks=pytest.mark.nightly) for size in ((560, 568), (1080, 200)))],
)
def test_equals_the_literal_definition_on_large_images(height: int, width: int) -> None:
    image = noise(height, width)
    image[: height // 2] = image[: height // 2, :, :1] // 128 * 118  # greys where exact means are whole numbers
    assert cedd(image).tolist() == cedd_reference(image)


def test_sums_of_tall_blocks_do_not_overflow() -> None:
    """Quarters of 260 rows: the sums of white need more than 16 bits."""
    image = noise(10_400, 40) | np.uint8(254)
    assert cedd(image).tolist() == cedd_reference(image)


def test_areas_with_a_whole_mean_round_like_the_reference() -> None:
    """Colours whose luminance is an integer: the order of the additions decides the rounding."""
    colours_bgr = np.random.default_rng(4).integers(0, 256, (800_000, 3), dtype=np.uint8)
    whole = colours_bgr[(colours_bgr @ np.array([114, 587, 299])) % 1000 == 0][:800].reshape(2, -1, 3)
    quarters = areas(whole)
    assert quarters.shape == (4, 200)
    found = quarters.reshape(2, 2, 200).transpose(0, 2, 1).reshape(2, -1)
    expected = [[area(whole[i : i + 1, j : j + 1], 2, 2) for j in range(400)] for i in range(2)]
    assert found.tolist() == expected


def drawing(name: str, height: int, width: int) -> Image:
    """Return greys with mostly integer sums, and many equal quarters of blocks."""
    y, x = np.mgrid[:height, :width]
    grey = {
        "flat": 127 + 0 * x,
        "two halves": np.where(x < width // 2, 118, 241),
        "gradient along x": x * 255 // width,
        "gradient along y": y * 255 // height,
        "stripes as wide as a quarter": np.where(x // (width // 80) % 2, 57, 228),
        "chequers": (x // 5 + y // 5) % 2 * 100 + 27,
        "one dot": 205 + (x == width // 3) * (y == height // 3),
        "same sums, other pixels": np.where((x + x // (width // 80)) % 2, 127, 46),
    }[name]
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)


@pytest.mark.parametrize(
    "name",
    [
        *("flat", "two halves", "gradient along x", "gradient along y", "stripes as wide as a quarter"),
        *("chequers", "one dot", "same sums, other pixels"),
    ],
)
@pytest.mark.parametrize(
    ("height", "width"),
    [(160, 240), (203, 170), *(pytest.param(n, n, marks=pytest.mark.nightly) for n in (80, 320))],
)
def test_areas_of_drawings_round_like_the_reference(name: str, height: int, width: int) -> None:
    image = drawing(name, height, width)
    y, x = height // 80, width // 80
    expected = [[area(image[i * y :, j * x :][:y, :x], 2 * x, 2 * y) for j in range(80)] for i in range(80)]
    assert areas(image).reshape(2, 2, 40, 40).transpose(2, 0, 3, 1).reshape(80, 80).tolist() == expected


def test_texture_classes_equal_the_literal_definition() -> None:
    """Small areas, so that ratios fall on the thresholds (49 / 50 is not above 0.98)."""
    quarters = np.random.default_rng(3).integers(0, 60, (4, 20_000))
    quarters[:, 0] = 50, 0, 1, 0
    found: list[list[int]] = [[] for _ in quarters.T]
    for texture, block in zip(*_texture_votes(quarters.astype(np.float64)), strict=True):
        found[block].append(int(texture))
    expected = [texture_classes(*column) for column in quarters.T.tolist()]
    assert found == expected


@pytest.mark.parametrize("height", [560, 568])
def test_white_rounds_like_the_reference(height: int) -> None:
    """The reciprocal of 49 pixels (560 x 560) is rounded so that white has luminance 254."""
    image = noise(height, height)
    image[:, height // 3 :] = 255
    assert cedd(image).tolist() == cedd_reference(image)
    (luminance,) = set(areas(image)[:, -1].tolist())
    assert luminance == area(image[-7:, -7:], 14, 14)


def test_all_colour_outputs_equal_the_literal_definition() -> None:
    """Bit for bit on the cube's surface, its diagonal and a lattice through all hue, saturation and value borders."""
    lattice = np.array(np.meshgrid(*[range(0, 256, 15)] * 3)).reshape(3, -1)
    rng = np.random.default_rng(1)
    near_grey = np.clip(rng.integers(0, 256, 2000) + rng.integers(-12, 13, (3, 2000)), 0, 255)
    bgr = np.concatenate([lattice, near_grey, rng.integers(0, 256, (3, 4000)), [range(256)] * 3], axis=1)
    hue, outputs = _colour_outputs(np.ascontiguousarray(bgr.T, np.float32))
    bins = VOTE_BINS[hue]
    for column, (b, g, r) in enumerate(bgr.T.tolist()):
        dense = np.zeros(24)
        np.add.at(dense, bins[column], outputs[column])
        assert dense.tolist() == colours(r, g, b), (b, g, r)


def test_hsv_of_every_shade_equals_the_literal_definition() -> None:
    """All 256 x 256 pairs of maximum and minimum, in each of the six orders of the channels, middle drawn at random."""
    high, low = (x.ravel() for x in np.triu_indices(256)[::-1])
    middle = np.random.default_rng(2).integers(low, high + 1)
    for order in itertools.permutations((high, middle, low)):
        found = _hsv(np.column_stack(order).astype(np.float32))[:, ::7]
        blue, green, red = (channel[::7].tolist() for channel in order)
        assert found.T.tolist() == [list(hsv(*rgb)) for rgb in zip(red, green, blue, strict=True)]


def test_pixels_outside_the_grid_are_ignored() -> None:
    image = noise(128, 128)
    changed = image.copy()
    changed[80:] = changed[:, 80:] = 7
    assert (cedd(image) == cedd(changed)).all()
    assert (describe(image) != describe(changed)).any()  # scales the whole image to the grid
    changed[79, 79] ^= 255
    changed[:40, :40] = 255
    assert (cedd(image) != cedd(changed)).any()


@pytest.mark.parametrize(
    "view",
    [
        *(lambda x: x[::-1], lambda x: x[:, ::-1], lambda x: x[:, :, ::-1], lambda x: x[3:-5, 7:-2]),
        *(lambda x: x[::2, ::3], lambda x: x.transpose(1, 0, 2), np.asfortranarray),
    ],
)
def test_memory_layout_does_not_matter(view: Callable[[Image], Image]) -> None:
    image = noise(200, 260) // 64 * 64
    assert (cedd(view(image)) == cedd(np.ascontiguousarray(view(image)))).all()


def test_image_is_not_changed() -> None:
    image = noise(130, 90)
    before = image.copy()
    image.flags.writeable = False
    cedd(image)
    describe(image)
    assert (image == before).all()


@pytest.mark.parametrize("function", [cedd, describe])
@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (None, TypeError, "cv2.imread returns None"),
        ([[1]], TypeError, "not an array"),
        (np.zeros((80, 80, 3)), TypeError, "astype(np.uint8)"),
        (np.zeros((80, 80, 3), np.uint16), TypeError, "uint16"),
        (np.zeros((80, 80), np.uint8), ValueError, "COLOR_GRAY2BGR"),
        (np.zeros((80, 80, 1), np.uint8), ValueError, "COLOR_GRAY2BGR"),
        (np.zeros((80, 80, 4), np.uint8), ValueError, "alpha"),
        (np.zeros((2, 80, 80, 3), np.uint8), ValueError, "one BGR image"),
        (np.zeros((3, 80, 80), np.uint8), ValueError, "(H, W, 3)"),
        (np.zeros((0, 80, 3), np.uint8), ValueError, "empty"),
    ],
)
def test_invalid_images_are_rejected(
    function: Callable[[Any], Image], image: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=re.escape(message)):
        function(image)


@pytest.mark.parametrize(
    ("size", "brought_to"),
    [
        *(((640, 480), (640, 480)), ((160, 160), (160, 160)), ((128, 128), (160, 160)), ((384, 288), (400, 320))),
        *(((1920, 1080), (640, 400)), ((1080, 1920), (400, 640)), ((119, 120), (80, 160))),
        *(((1, 1), (80, 80)), ((3000, 40), (640, 80))),
    ],
)
def test_describe_scales_to_covered_sides(size: tuple[int, int], brought_to: tuple[int, int]) -> None:
    image = flat((0, 0, 0), size[1], size[0])
    assert _covered_size(*size) == brought_to
    assert covered(image).shape == (brought_to[1], brought_to[0], 3)
    same = noise(480, 640)
    assert (describe(same) == cedd(same)).all()


@examples(9)
@given(st.integers(1, 2000), st.integers(1, 2000))
def test_scaled_sides_are_covered_and_close(width: int, height: int) -> None:
    size = _covered_size(width, height)
    scale = min(1.0, 640 / max(width, height))
    for side, result in zip((width, height), size, strict=True):
        assert result % 80 == 0
        assert 80 <= result <= 640
        assert abs(result - side * scale) <= 40 or result == 80
