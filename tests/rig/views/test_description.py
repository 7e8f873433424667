"""Pictures described by several descriptors at once, with and without the empty table."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import hbr
from rig.config import ViewConfig
from rig.core.errors import UsageError
from rig.views.description import BENCH_DESCRIPTOR, DESCRIPTORS, PAPER_DESCRIPTOR, Describer

WHOLE = ViewConfig(roi=None)


def _table(height: int = 120, width: int = 160) -> NDArray[np.uint8]:
    """A table with a pattern that nobody would call plain."""
    rng = np.random.default_rng(7)
    coarse = rng.integers(60, 200, (height // 10, width // 10, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def _with_object(table: NDArray[np.uint8], left: int = 60, gain: float = 1.0) -> NDArray[np.uint8]:
    image = table.copy()
    image[40:90, left : left + 40] = (30, 30, 220)
    image[55:70, left + 10 : left + 25] = (220, 220, 40)
    return np.clip(image * gain, 0, 255).astype(np.uint8)


def test_the_papers_descriptor_stays_the_whole_regions() -> None:
    frame = _with_object(_table())
    described = Describer(ViewConfig(roi=(20, 0, 120, 120)), empty_table=_table())(frame)
    assert tuple(described.levels) == DESCRIPTORS
    assert np.array_equal(described.levels[PAPER_DESCRIPTOR], hbr.describe(frame[:, 20:140]))


def test_the_object_is_found_in_the_region_of_frame_and_table() -> None:
    table = _table()
    described = Describer(ViewConfig(roi=(20, 0, 120, 120)), empty_table=table)(_with_object(table))
    assert described.segmentation is not None
    x, y, width, height = described.segmentation["box_px"]
    assert np.allclose((x, y, x + width, y + height), (40, 40, 80, 90), atol=4)
    assert described.segmentation["agreement"] > 0.9


def test_with_the_empty_table_another_place_and_light_change_little() -> None:
    table = _table()
    describer = Describer(WHOLE, (BENCH_DESCRIPTOR,), table)
    before = describer(_with_object(table)).levels[BENCH_DESCRIPTOR]
    after = describer(_with_object(table, left=72, gain=0.8)).levels[BENCH_DESCRIPTOR]
    other = describer(_with_object(table)[::-1, ::-1].copy()).levels[BENCH_DESCRIPTOR]
    kind = hbr.descriptor(BENCH_DESCRIPTOR)
    assert float(kind.similarity(before[None], after[None])[0, 0]) > 0.95
    assert float(kind.similarity(before[None], other[None])[0, 0]) < 0.9


def test_nothing_is_looked_for_where_nobody_asks() -> None:
    described = Describer(WHOLE, (PAPER_DESCRIPTOR, "cedd-blurred"))(_with_object(_table())[:12, :15])
    assert described.segmentation is None


def test_an_empty_table_of_another_size_is_left_alone_and_said() -> None:
    frame = _with_object(np.full((120, 160, 3), 128, np.uint8))
    without = Describer(WHOLE)(frame)
    described = Describer(WHOLE, empty_table=_table(240, 320))(frame)
    assert described.segmentation is not None
    assert "320 x 240" in described.segmentation["refused"][0]
    assert np.array_equal(described.levels[BENCH_DESCRIPTOR], without.levels[BENCH_DESCRIPTOR])


def test_a_region_outside_the_frame_is_told() -> None:
    with pytest.raises(UsageError, match="does not lie within"):
        Describer(ViewConfig(roi=(100, 0, 100, 100)))(_table())
