"""The sheet of empty-table images: one image for all azimuths, or one for each."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.views.table_sheet import MAX_AWAY_DEG, TableSheet, table_image


def images(count: int, height: int = 20, width: int = 30) -> list[np.ndarray]:
    return [np.full((height, width, 3), number + 1, np.uint8) for number in range(count)]


@given(st.integers(1, 80))
def test_images_of_a_sheet_are_those_that_were_joined(count: int) -> None:
    sheet = TableSheet.of(TableSheet.joined(images(count)).image_bgr, 20, 30)
    assert sheet is not None
    assert [int(sheet[number].max()) for number in range(len(sheet))] == list(range(1, count + 1))
    assert all(sheet[number].shape == (20, 30, 3) for number in range(count))


def test_single_image_is_itself_the_sheet_of_every_azimuth() -> None:
    (image,) = images(1)
    sheet = TableSheet.joined([image])
    assert np.array_equal(sheet.image_bgr, image)
    assert all(np.array_equal(table_image(image, image, azimuth_deg), image) for azimuth_deg in (0.0, 77.7, 359.9))
    assert sheet.rotation_deg(12.3, 45.6) == 45.6


@pytest.mark.parametrize("size", [(40, 60), (10, 15), (20, 29), (21, 30)])
def test_sheet_of_frames_of_another_size_is_recognised(size: tuple[int, int]) -> None:
    for count in (1, 6):
        assert TableSheet.of(TableSheet.joined(images(count)).image_bgr, *size) is None


def test_only_an_image_near_the_azimuth_is_used() -> None:
    taken = images(36)
    taken[7] = np.zeros_like(taken[7])  # the cable does not reach 70 degrees
    sheet = TableSheet.joined(taken).image_bgr
    for azimuth_deg, number in ((0.0, 0), (359.5, 0), (90.9, 9), (89.1, 9)):
        found = table_image(sheet, taken[0], azimuth_deg)
        assert found is not None
        assert int(found.max()) == number + 1
    for azimuth_deg in (90.0 + MAX_AWAY_DEG + 0.1, 95.0, 70.0):
        assert table_image(sheet, taken[0], azimuth_deg) is None


@given(st.integers(4, 72), st.floats(0.0, 359.9), st.floats(-180.0, 180.0).filter(lambda angle: abs(angle) > 1.0))
def test_rotation_ends_at_another_image(count: int, azimuth_deg: float, wanted_deg: float) -> None:
    sheet = TableSheet.joined(images(count, 2, 2))
    here, _ = sheet.nearest(azimuth_deg)
    rotation_deg = sheet.rotation_deg(azimuth_deg, wanted_deg)
    there, away_deg = sheet.nearest((azimuth_deg + rotation_deg) % 360.0)
    assert away_deg < 1e-6
    assert there != here or abs(wanted_deg) > 360.0 - 1.5 * sheet.step_deg
    assert abs(rotation_deg - wanted_deg) <= 1.5 * sheet.step_deg
