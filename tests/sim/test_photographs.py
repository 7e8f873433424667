"""Photographs of real objects on the simulated platter."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.errors import UsageError
from sim.objects.photographs import PhotographsOnTable, photographs
from sim.objects.projection import Image, Visible


def save(path: Path, level: int, *, border: int = 0, size: tuple[int, int] = (60, 60)) -> None:
    image = np.full((*size, 3), border, np.uint8)
    image[size[0] // 4 : -size[0] // 4, size[1] // 4 : -size[1] // 4] = level
    assert cv2.imwrite(str(path), image)


def shown(solid: Visible, azimuth_deg: float) -> Image:
    image = np.full((480, 640, 3), 99, np.uint8)
    solid.draw(image, azimuth_deg, (0.0, 0.0))
    return image


def test_objects_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("obj10__0.png", "obj2__5.png", "obj2__0.JPG", "obj1__355.jpeg", "obj1__2.5.png", "obj3_0.png"):
        save(tmp_path / name, 200)
    (tmp_path / "notes.txt").write_text("obj")
    objects = photographs(tmp_path)
    assert list(objects) == ["obj1", "obj2", "obj10"]
    assert objects["obj1"].azimuth_deg.tolist() == [2.5, 355]
    assert all(isinstance(solid, Visible) for solid in objects.values())


def test_nearest_photograph_is_shown_around_the_circle(tmp_path: Path) -> None:
    for angle, level in ((0, 50), (90, 100), (182.5, 150), (270, 200)):
        save(tmp_path / f"obj1__{angle:g}.png", level)
    solid = photographs(tmp_path)["obj1"]
    for azimuth, level in (
        *((0, 50), (359, 50), (314, 200), (-50, 200)),
        *((136, 100), (137, 150), (720 + 44, 50), (-270, 100)),
    ):
        image = shown(solid, azimuth)
        assert image[240, 320].tolist() == [level] * 3
        image[:] = 0  # the next drawing must not see this


@given(st.lists(st.floats(0, 359.9), min_size=1, max_size=20, unique=True), st.floats(-1000, 1000))
def test_no_photograph_is_nearer_than_the_one_shown(angles: list[float], azimuth: float) -> None:
    solid = PhotographsOnTable("obj1", np.array(sorted(angles)), tuple(Path(str(a)) for a in sorted(angles)))
    apart = [abs(np.angle(np.exp(1j * np.radians(a - azimuth)), deg=True)) for a in sorted(angles)]
    assert apart[solid.nearest(azimuth)] == pytest.approx(min(apart), abs=1e-6)


@pytest.mark.parametrize(
    ("size", "filled"), [((128, 128), (480, 480)), ((100, 200), (320, 640)), ((960, 640), (480, 320))]
)
def test_photograph_is_centred_on_the_colour_of_its_border(
    tmp_path: Path, size: tuple[int, int], filled: tuple[int, int]
) -> None:
    save(tmp_path / "obj1__0.png", 220, border=33, size=size)
    image = shown(photographs(tmp_path)["obj1"], 0)
    assert image.shape == (480, 640, 3)
    assert (image[[0, -1]] == 33).all()
    assert (image[:, [0, -1]] == 33).all()
    rows, columns = np.nonzero(image[..., 0] > 120)
    assert (rows.min() + rows.max(), columns.min() + columns.max()) == pytest.approx((479, 639), abs=2)
    assert (np.ptp(rows), np.ptp(columns)) == pytest.approx((filled[0] / 2, filled[1] / 2), abs=4)


def test_invalid_folder_is_rejected_with_a_message(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        photographs(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="named like"):
        photographs(tmp_path)
    save(tmp_path / "obj1__0.png", 200)
    save(tmp_path / "obj1__360.jpg", 200)
    with pytest.raises(UsageError, match=r"obj1__0\.png and obj1__360\.jpg"):
        photographs(tmp_path)


def test_damaged_photograph_is_reported_with_its_path(tmp_path: Path) -> None:
    save(tmp_path / "obj1__0.png", 200)
    (tmp_path / "obj1__90.png").write_bytes(b"not an image")
    solid = photographs(tmp_path)["obj1"]
    shown(solid, 10)
    with pytest.raises(UsageError, match=r"obj1__90\.png"):
        shown(solid, 80)


def test_photographs_of_coil_100_are_found() -> None:
    folder = Path(os.environ.get("RIG_TEST_DATA", "../shared/data")) / "coil-100"
    if not folder.is_dir():
        pytest.skip(f"no photographs in {folder}")
    objects = photographs(folder)
    assert list(objects) == [f"obj{k}" for k in range(1, 101)]
    assert sum(len(solid.files) for solid in objects.values()) == 7178
    image = shown(objects["obj1"], 43.0)
    photo = cv2.imread(str(folder / "obj1__45.png"))
    assert photo is not None
    assert image[:, 80:560].mean() == pytest.approx(photo.mean(), abs=1)
