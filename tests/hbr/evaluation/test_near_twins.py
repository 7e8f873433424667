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

SIZE = (96, 96)


def drawn(kind: int, angle_deg: float, *, sticker: bool) -> np.ndarray:
    """Draw a cylinder with spots before a dark background; the sticker is a spot that only one twin has."""
    image = np.zeros((*SIZE, 3), np.uint8)
    cv2.rectangle(image, (20, 12), (76, 84), (90 + 60 * kind, 150, 200 - 50 * kind), -1)
    rng = np.random.default_rng(kind)
    spots = [(*rng.uniform((0, 20), (360, 76)), rng.integers(40, 255, 3).tolist(), 6) for _ in range(14)]
    for around_deg, y, colour, radius in [*spots, *([(100.0, 48.0, [30, 30, 250], 9)] if sticker else [])]:
        angle = np.radians(around_deg - angle_deg)
        if np.cos(angle) > 0.2:
            cv2.circle(image, (round(48 + 24 * np.sin(angle)), round(y)), radius, colour, -1)
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
