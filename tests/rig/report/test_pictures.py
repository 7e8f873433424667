"""Contact sheets show every image in its place over its azimuth; thumbnails are undistorted."""

from base64 import b64decode
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.report.pictures import contact_sheet, thumbnail


def flat(level: int, shape: tuple[int, int] = (30, 30)) -> np.ndarray:
    return np.full((*shape, 3), level, dtype=np.uint8)


def parts(sheet: str) -> tuple[np.ndarray, list[ET.Element]]:
    """Return the picture of a contact sheet, and its captions."""
    root = ET.fromstring(sheet)
    (image,) = (e for e in root.iter() if e.tag.endswith("image"))
    encoded = np.frombuffer(b64decode(image.get("href", "").split(",")[1]), np.uint8)
    pixels = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert pixels is not None
    assert root.get("viewBox") == f"0 0 {pixels.shape[1]} {pixels.shape[0]}"
    return pixels, [e for e in root.iter() if e.get("class") == "caption"]


@given(n=st.integers(1, 30))
def test_tile_k_is_image_k_over_its_azimuth(n: int) -> None:
    pixels, captions = parts(contact_sheet([flat(100 + 5 * k) for k in range(n)], [7.0 * k for k in range(n)], "all"))
    assert [e.text for e in captions] == [f"{7.0 * k:.1f}°" for k in range(n)]
    for k, caption in enumerate(captions):
        x, y = (round(float(caption.get(key, ""))) for key in ("x", "y"))
        assert abs(int(pixels[y - 30, x, 0]) - (100 + 5 * k)) < 3, "the tile above the caption"


@pytest.mark.parametrize("azimuth_deg", [359.97, -0.02, 0.04])
def test_azimuth_is_never_written_as_360_or_minus_zero(azimuth_deg: float) -> None:
    _, (caption,) = parts(contact_sheet([flat(0)], [azimuth_deg], ""))
    assert caption.text == "0.0°"


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
