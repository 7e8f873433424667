"""Retrieval from descriptor to decision, with photographs of ten objects."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from hbr import ViewIndex, Views, describe, next_view, retrieve

OBJECTS = (3, 8, 15, 23, 31, 44, 57, 69, 84, 96)


@pytest.fixture(scope="module")
def model(rig_test_data: Path) -> Views:
    parts = []
    for number in OBJECTS:
        angles = [a for a in range(0, 360, 10) if (rig_test_data / f"coil-100/obj{number}__{a}.png").is_file()]
        images = [cv2.imread(str(rig_test_data / f"coil-100/obj{number}__{a}.png")) for a in angles]
        descriptors = np.stack([describe(image) for image in images])  # type: ignore[arg-type]
        parts.append(Views.of_object(str(number), descriptors, angles))
    return Views.concatenate(parts)


def query(folder: Path, number: int, angle: float) -> tuple[np.ndarray, int]:
    """Return descriptor and angle of the blurred photograph that is nearest to an angle and not in the model."""
    present = [a for a in range(5, 360, 10) if (folder / f"coil-100/obj{number}__{a}.png").is_file()]
    nearest = min(present, key=lambda a: abs((a - angle + 180) % 360 - 180))
    image = cv2.imread(str(folder / f"coil-100/obj{number}__{nearest}.png"))
    return describe(cv2.blur(image, (3, 3))), nearest  # type: ignore[arg-type]


def test_every_object_is_found_with_its_pose(model: Views, rig_test_data: Path) -> None:
    """Views are blurred and 5° off those of the model; the third view follows the decision."""
    rng = np.random.default_rng(0)
    index = ViewIndex(model)
    found, pose_errors = [], []
    for number in OBJECTS:
        start = int(rng.integers(36)) * 10 + 5
        seen = [query(rig_test_data, number, angle) for angle in (start, start + 90)]
        for _ in range(2):
            descriptors = np.stack([descriptor for descriptor, _ in seen])
            ranking = retrieve(descriptors, [angle - start for _, angle in seen], index)
            decision = next_view(ranking)
            seen.append(query(rig_test_data, number, start + decision.orientation_deg))
        found.append(ranking.names[0])
        pose_errors.append(abs((ranking.pose_deg[0] - seen[-2][1] + 180) % 360 - 180))
    assert sum(name == str(number) for name, number in zip(found, OBJECTS, strict=True)) >= 9
    assert np.median(pose_errors) <= 10
