"""Thumbnails are undistorted, and show the region with the object in its box."""

import numpy as np
import pytest

from rig.report.pictures import thumbnail


def flat(level: int, shape: tuple[int, int] = (30, 30)) -> np.ndarray:
    return np.full((*shape, 3), level, dtype=np.uint8)


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


def test_thumbnail_rejects_a_region_outside_the_image() -> None:
    with pytest.raises(ValueError, match="is outside the image"):
        thumbnail(flat(1), (10, 10), (50, 50, 5, 5))


def test_box_is_outlined_at_the_object() -> None:
    plain = thumbnail(flat(100, (100, 200)), (50, 50), region=(40, 0, 100, 100))
    boxed = thumbnail(flat(100, (100, 200)), (50, 50), region=(40, 0, 100, 100), box=(20, 40, 60, 20))
    rows, columns = np.nonzero((boxed != plain).any(axis=2))
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (10, 39, 20, 29)
    assert len(rows) == 2 * 30 + 2 * 8
