"""Evaluated searches compare pixels as the bench does."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from hbr.evaluation.condition import Condition, levels_of
from hbr.evaluation.photographs import load_coil
from hbr.evaluation.protocol import METHODS, Protocol
from hbr.evaluation.trials import LocalPhotographs, run_object
from hbr.model.views import Views


def drawn(kind: int, angle_deg: int, *, sticker: bool) -> np.ndarray:
    """Draw an object with a texture around it, before a dark background; one twin has a sticker on it."""
    around = np.random.default_rng(kind).integers(40, 255, (6, 24, 3)).astype(np.uint8)
    if sticker:
        around[2:4, 6:8] = 30, 30, 250
    image = np.zeros((96, 96, 3), np.uint8)
    seen = np.roll(around, -angle_deg // 15, axis=1)[:, :8]
    image[12:84, 20:76] = cv2.resize(seen, (56, 72), interpolation=cv2.INTER_NEAREST)
    return image


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photographs")
    for number, (kind, sticker) in enumerate([(0, False), (0, True), (1, False)], 1):
        for angle_deg in range(0, 360, 15):
            assert cv2.imwrite(str(path / f"obj{number}__{angle_deg}.png"), drawn(kind, angle_deg, sticker=sticker))
    return path


def test_views_are_compared_with_both_near_twins(folder: Path) -> None:
    dataset, condition = load_coil(folder), Condition(descriptor="edges+colours+cedd")
    levels = [levels_of(dataset, j, condition) for j in range(3)]
    views = Views.concatenate(
        [
            Views.of_object(item.name, own, item.azimuth_deg, condition.descriptor)
            for item, own in zip(dataset.objects, levels, strict=True)
        ]
    )
    protocol = Protocol(trials=1, max_views=2, removal="queries", sigma_deg=0.5, enrolled=12)
    photographs = LocalPhotographs(dataset, condition, protocol.seed)
    assert photographs.possible
    assert not LocalPhotographs(dataset, Condition(), 0).possible  # plain CEDD cuts nothing out
    queries = levels_of(dataset, 1, condition, protocol.seed)
    runs = run_object(1, queries, views, [METHODS["dense-90"]], protocol, photographs=photographs)
    assert runs.named[0, 0, 0, -1]
    assert {object_index for object_index, _ in photographs._known} >= {0, 1}  # enrolled views of both twins
