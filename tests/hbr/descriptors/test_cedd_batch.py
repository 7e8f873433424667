from pathlib import Path

import cv2
import numpy as np
import pytest

from hbr import describe
from hbr.descriptors.cedd_batch import describe_all

IMAGES = [np.random.default_rng(i).integers(0, 256, (40 + i, 60, 3), dtype=np.uint8) for i in range(20)]


@pytest.mark.parametrize("processes", [1, 2])
def test_arrays_and_files_are_described_in_their_order(tmp_path: Path, processes: int) -> None:
    mixed: list[np.ndarray | Path] = list(IMAGES)
    for i in (3, 17):
        mixed[i] = tmp_path / f"{i}.png"
        assert cv2.imwrite(str(mixed[i]), IMAGES[i])
    expected = np.stack([describe(image, size=(80, 160)) for image in IMAGES])
    np.testing.assert_array_equal(describe_all(mixed, size=(80, 160), processes=processes), expected)


def test_no_images_give_no_rows() -> None:
    assert describe_all([], processes=1).shape == (0, 144)


@pytest.mark.parametrize("processes", [1, 2])
def test_unreadable_file_is_named(tmp_path: Path, processes: int) -> None:
    with pytest.raises(ValueError, match=r"gone\.png is missing"):
        describe_all([IMAGES[0], tmp_path / "gone.png"], processes=processes)
    with pytest.raises(ValueError, match="processes is 0"):
        describe_all(IMAGES, processes=0)
