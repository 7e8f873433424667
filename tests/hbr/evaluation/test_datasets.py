from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hbr.evaluation.photographs import Dataset, DatasetError, load_coil, read_photograph


def picture(path: Path, size: int = 8) -> Path:
    image = np.random.default_rng(size).integers(0, 256, (size, size, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), image)
    return path


def test_views_are_found_sorted_and_the_missing_counted(tmp_path: Path) -> None:
    for name in ("obj10__0", "obj10__90", "obj10__180", "obj10__270", "obj2__270", "obj2__0", "obj2__90.5"):
        picture(tmp_path / f"{name}.png")
    picture(tmp_path / "obj2__180.jpg")
    picture(tmp_path / "obj3__0.png")
    picture(tmp_path / "sheet.png")
    (tmp_path / "MISSING.txt").write_text("nothing")
    dataset = load_coil(tmp_path)
    assert [item.name for item in dataset.objects] == ["obj2", "obj3", "obj10"]
    assert dataset.objects[0].azimuth_deg.tolist() == [0, 90.5, 180, 270]
    assert (dataset.views, dataset.spacing_deg, dataset.missing, dataset.ignored) == (9, 90, 3, 1)
    assert [item.name for item in dataset.subset(2, 3).objects] == ["obj3", "obj10"]
    assert dataset.every(2).objects[0].azimuth_deg.tolist() == [0, 180]
    with pytest.raises(DatasetError, match="3-4"):
        dataset.subset(3, 4)


def test_no_view_is_missing_from_irregular_steps(tmp_path: Path) -> None:
    """Encoders err, views are lost, and both leave a step; a hand-held camera has none."""
    for number, azimuths in enumerate(([0, 10.9, 20, 29.1], [0.4, 6.13, 47.83, 120.5, 121, 250, 359.999999])):
        for azimuth in [*azimuths, *range(40, 340, 10)][: 34 if number == 0 else 7]:
            picture(tmp_path / f"obj{number}__{azimuth}.png")
    dataset = load_coil(tmp_path)
    regular, irregular = (Dataset("one", (item, replace(item, name="again"))) for item in dataset.objects)
    assert (regular.missing, irregular.missing, len(irregular.objects[0].photographs)) == (4, None, 7)


def test_duplicate_view_is_named(tmp_path: Path) -> None:
    for name in ("obj1__5.png", "obj1__5.0.jpg", "obj2__0.png"):
        picture(tmp_path / name)
    with pytest.raises(DatasetError, match=r"obj1__5\.0\.jpg and .*obj1__5\.png"):
        load_coil(tmp_path)


def test_missing_or_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="nowhere"):
        load_coil(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=f"{tmp_path.name} contains no view"):
        load_coil(tmp_path)
    picture(tmp_path / "obj1__0.png")
    with pytest.raises(DatasetError, match="at least two"):
        load_coil(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_files_are_named(tmp_path: Path, suffix: str) -> None:
    path = picture(tmp_path / f"obj1__0{suffix}", 64)
    assert read_photograph(path).shape == (64, 64, 3)
    whole = path.read_bytes()
    for keep in (0, 10, len(whole) // 2, len(whole) - 2):
        path.write_bytes(whole[:keep])
        with pytest.raises(DatasetError, match=f"obj1__0{suffix} is cut off"):
            read_photograph(path)


def test_other_files_and_sizes_are_named(tmp_path: Path) -> None:
    path = picture(tmp_path / "obj1__0.png")
    with pytest.raises(DatasetError, match=r"obj1__0\.png has 8 x 8 pixels, the first image 9 x 8"):
        read_photograph(path, (9, 8))
    path.write_bytes(b"no picture IEND\xaeB`\x82")
    with pytest.raises(DatasetError, match="OpenCV"):
        read_photograph(path)
    with pytest.raises(DatasetError, match="gone"):
        read_photograph(tmp_path / "gone.png")
