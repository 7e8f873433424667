"""Contact sheets show every image in its place, undistorted, over its azimuth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.report.contact_sheet import CAPTION_PX, GAP_PX, contact_sheet, thumbnail


def flat(level: int, shape: tuple[int, int] = (30, 30)) -> np.ndarray:
    return np.full((*shape, 3), level, dtype=np.uint8)


def tile(sheet: np.ndarray, k: int, columns: int, size: tuple[int, int]) -> np.ndarray:
    x, y = GAP_PX + (k % columns) * (size[0] + GAP_PX), GAP_PX + (k // columns) * (size[1] + CAPTION_PX + GAP_PX)
    return sheet[y : y + size[1], x : x + size[0]]


def caption(sheet: np.ndarray, k: int, columns: int, size: tuple[int, int]) -> np.ndarray:
    x = GAP_PX + (k % columns) * (size[0] + GAP_PX)
    y = GAP_PX + (k // columns) * (size[1] + CAPTION_PX + GAP_PX) + size[1]
    return sheet[y : y + CAPTION_PX, x : x + size[0]]


def test_seventy_two_views_fill_twelve_by_six_tiles() -> None:
    sheet = contact_sheet([flat(k) for k in range(72)], [5.0 * k for k in range(72)])
    assert sheet.shape == (6 * (96 + CAPTION_PX + GAP_PX) + GAP_PX, 12 * (96 + GAP_PX) + GAP_PX, 3)
    assert sheet.dtype == np.uint8
    for k in range(72):
        assert (tile(sheet, k, 12, (96, 96)) == k).all()


@given(n=st.integers(1, 15), columns=st.integers(1, 6))
def test_tile_k_is_image_k(n: int, columns: int) -> None:
    sheet = contact_sheet([flat(100 + k) for k in range(n)], [0.0] * n, columns=columns, tile=(40, 20))
    for k in range(n):
        # square images in wide tiles: the picture is the middle
        assert (tile(sheet, k, columns, (40, 20))[:, 10:30] == 100 + k).all()
        assert (tile(sheet, k, columns, (40, 20))[:, :10] != 100 + k).all()


def test_caption_shows_the_azimuth_legibly() -> None:
    sheet = contact_sheet([flat(0)] * 4, [5.0, 355.0, 5.0, 365.0], columns=4)
    first, second, third, fourth = (caption(sheet, k, 4, (96, 96)) for k in range(4))
    assert np.array_equal(first, third)
    assert np.array_equal(first, fourth)
    assert not np.array_equal(first, second)
    assert int(first.max()) - int(first.min()) > 150


@pytest.mark.parametrize("azimuth_deg", [359.97, -0.02, 0.04])
def test_azimuth_is_never_written_as_360_or_minus_zero(azimuth_deg: float) -> None:
    sheet = contact_sheet([flat(0)] * 2, [azimuth_deg, 0.0], columns=2)
    assert np.array_equal(caption(sheet, 0, 2, (96, 96)), caption(sheet, 1, 2, (96, 96)))


def test_thumbnails_keep_proportions() -> None:
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    image[:, :100] = 255
    small = thumbnail(image, (60, 60))
    assert (small[15:45, :29] == 255).all()
    assert (small[15:45, 31:] == 0).all()
    assert (small[:15] == small[0, 0]).all()
    assert (small[45:] == small[0, 0]).all()


def test_thumbnails_show_the_region() -> None:
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    image[10:30, 50:90] = (10, 20, 30)
    assert (thumbnail(image, (40, 20), (50, 10, 40, 20)) == (10, 20, 30)).all()


def test_thumbnails_are_copies() -> None:
    image = flat(7)
    thumbnail(image, (30, 30))[:] = 0
    assert (image == 7).all()


@pytest.mark.parametrize(
    "image", [np.zeros((3, 3), np.uint8), np.zeros((3, 3, 4), np.uint8), np.zeros((3, 3, 3)), np.zeros((0, 3, 3), "u1")]
)
def test_thumbnail_rejects_invalid_images(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match="give"):
        thumbnail(image, (10, 10))


def test_thumbnail_rejects_a_region_outside_the_image() -> None:
    with pytest.raises(ValueError, match="is outside the image"):
        thumbnail(flat(1), (10, 10), (50, 50, 5, 5))


def test_contact_sheet_needs_one_azimuth_for_each_image() -> None:
    with pytest.raises(ValueError, match="one azimuth an image"):
        contact_sheet([flat(1)], [1.0, 2.0])
    with pytest.raises(ValueError, match="one azimuth an image"):
        contact_sheet([], [])
    with pytest.raises(ValueError, match="at least 1"):
        contact_sheet([flat(1)], [1.0], columns=0)


def test_box_is_outlined_at_the_object():
    plain = thumbnail(flat(100, (100, 200)), (50, 50), region=(40, 0, 100, 100))
    boxed = thumbnail(flat(100, (100, 200)), (50, 50), region=(40, 0, 100, 100), box=(20, 40, 60, 20))
    rows, columns = np.nonzero((boxed != plain).any(axis=2))
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (10, 39, 20, 29)
    assert len(rows) == 2 * 30 + 2 * 8
