"""Segmentation of frames: box, mask, scale, illumination, and the issues."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import hbr
from hbr import Background, segment
from hbr.segmentation import CROP_PX, BoxMethod, Issue, IssueCode
from tests.hbr.segmentation.benches import other_bench, plain_bench

BOX = (130, 70, 60, 110)


def table(seed: int = 0, *, patterned: bool = False) -> np.ndarray:
    return np.clip((other_bench if patterned else plain_bench)(np.random.default_rng(seed)), 0, 255).astype(np.uint8)


def with_object(empty: np.ndarray, box: tuple[int, int, int, int] = BOX) -> np.ndarray:
    """Return the table with a bottle that has red and white stripes."""
    x, y, w, h = box
    image = empty.copy()
    cv2.rectangle(image, (x, y), (x + w - 1, y + h - 1), (40, 30, 200), -1)
    for row in range(y + 10, y + h - 10, 24):
        image[row : row + 10, x : x + w] = (235, 240, 245)
    return image


def relit(image: np.ndarray, gains: tuple[float, float, float], slope: float = 0.0) -> np.ndarray:
    side = 1 + slope * (np.arange(image.shape[1]) / image.shape[1] - 0.5)
    return np.clip(np.rint(image * np.array(gains) * side[:, None]), 0, 255).astype(np.uint8)


def box_error(found: Any, wanted: tuple[int, int, int, int] = BOX) -> float:
    """Return the largest error of an edge of the box, as a share of its longer side."""
    a, b = ((x, y, x + w, y + h) for x, y, w, h in (found, wanted))
    return float(np.abs(np.subtract(a, b)).max() / max(wanted[2:]))


@pytest.mark.parametrize("patterned", [False, True])
@pytest.mark.parametrize("gains", [(1, 1, 1), (0.8, 0.9, 1.05), (1.2, 1.0, 0.85)])
def test_object_is_found_by_the_empty_table_image_in_any_illumination(patterned: bool, gains: Any) -> None:
    empty = table(3, patterned=patterned)
    seen = segment(relit(with_object(empty), gains, 0.2), empty_table=empty)
    assert seen.box is not None
    assert seen.agreement == 1
    assert box_error(seen.box) < 0.06
    assert seen.crop.shape == (CROP_PX, CROP_PX, 3)
    if patterned:  # not accepted as grey
        same = segment(with_object(empty), empty_table=empty)
        assert same.issues == (Issue(IssueCode.BACKDROP_COLOURS),)
        np.testing.assert_allclose(same.gains, 1, atol=0.03)


def test_illumination_is_corrected_to_the_empty_table_image() -> None:
    empty = table(1)
    usual = segment(with_object(empty), empty_table=empty)
    other = segment(relit(with_object(empty), (0.75, 0.85, 0.95), 0.2), empty_table=empty)
    assert np.abs(usual.crop.astype(int) - other.crop)[40:120, 60:100].mean() < 4
    assert usual.gains is not None
    assert other.gains is not None
    np.testing.assert_allclose(np.divide(other.gains, usual.gains), 1 / np.array([0.75, 0.85, 0.95]), rtol=0.04)


def test_plain_backdrop_corrects_two_days_to_the_same_illumination() -> None:
    empty = table(1)
    monday = segment(with_object(empty), empty_table=empty)
    dim = (0.8, 0.9, 1.0)
    tuesday = segment(relit(with_object(empty), dim), empty_table=relit(empty, dim))
    assert np.abs(monday.crop.astype(int) - tuesday.crop)[40:120, 60:100].mean() < 5


@pytest.mark.parametrize("seed", range(6))
def test_empty_table_image_of_another_bench_is_not_used(seed: int) -> None:
    image = with_object(table(seed, patterned=True))
    seen = segment(image, empty_table=table(seed + 1, patterned=True))
    assert seen.agreement is not None
    assert seen.agreement < 0.5
    assert seen.gains is None
    assert seen.issues[0] == Issue(IssueCode.TABLE_DIFFERS, {"agreement": round(seen.agreement, 3)})
    assert seen.method is not BoxMethod.EMPTY_TABLE


def test_soft_shadow_does_not_belong_to_the_object() -> None:
    empty = table(2)
    shadow = np.zeros(empty.shape[:2], np.float32)
    cv2.ellipse(shadow, (225, 178), (60, 12), 0, 0, 360, 1, -1)
    dark = (empty * (1 - 0.35 * cv2.GaussianBlur(shadow, (0, 0), 5))[:, :, None]).astype(np.uint8)
    seen = segment(with_object(dark), empty_table=empty)
    assert seen.box is not None
    assert box_error(seen.box) < 0.08


def test_thin_and_thick_holders_that_reach_into_the_frame_are_removed() -> None:
    empty = table(2)
    image = with_object(empty)
    cv2.line(image, (150, 239), (165, 120), (20, 160, 20), 7)
    seen = segment(image, empty_table=empty)
    assert seen.box is not None
    assert box_error(seen.box) < 0.06
    image = with_object(empty)
    cv2.ellipse(image, (160, 180), (40, 8), 0, 0, 360, (45, 45, 45), -1)  # a hard shadow that the bar merges with
    cv2.line(image, (150, 239), (165, 120), (20, 160, 20), 10)
    seen = segment(image, empty_table=empty)
    assert seen.box is not None
    assert seen.box[1] + seen.box[3] < 196


def test_plain_background_needs_no_empty_table_image() -> None:
    image = with_object(np.full((200, 320, 3), 24, np.uint8), (120, 40, 50, 100))
    seen = segment(image)
    assert seen.box is not None
    assert box_error(seen.box, (120, 40, 50, 100)) < 0.05
    assert (seen.method, seen.issues) == (BoxMethod.PLAIN_BACKGROUND, ())
    assert seen.gains is None


def test_empty_frame_has_no_object_and_a_full_mask() -> None:
    seen = segment(np.full((200, 320, 3), 90, np.uint8))
    assert seen.box is None
    assert (seen.method, seen.issues) == (BoxMethod.NONE, (Issue(IssueCode.NO_DIFFERENCE),))
    assert (seen.mask == 255).all()


def test_guess_before_a_pattern_is_reported_and_repeatable() -> None:
    image = with_object(table(4, patterned=True))
    first, second = segment(image), segment(image)
    assert (first.method, first.issues) == (BoxMethod.GUESS, (Issue(IssueCode.BACKGROUND_NOT_PLAIN),))
    np.testing.assert_array_equal(first.crop, second.crop)


@pytest.mark.parametrize("seed", range(4))
def test_wall_and_table_are_not_a_plain_background(seed: int) -> None:
    seen = segment(with_object(table(seed)))
    assert seen.box is not None
    assert box_error(seen.box) < 0.1


def test_guess_ignores_clutter_behind_the_object() -> None:
    boxes = [segment(with_object(table(seed, patterned=True))).box for seed in range(8)]
    assert sum(box is not None and box_error(box) < 0.1 for box in boxes) >= 7


def test_frames_of_noise_and_of_flat_colours_are_described() -> None:
    rng = np.random.default_rng(0)
    for size in ((16, 16), (32, 32), (17, 300), (300, 16), (90, 40)):
        noise = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
        blots = cv2.resize(noise[:4, :5], size[::-1], interpolation=cv2.INTER_NEAREST)
        black, white = np.zeros_like(noise), np.full_like(noise, 255)
        for image in (noise, blots, black, white):
            for table_image in (None, noise, black, white):
                assert segment(image, empty_table=table_image).crop.shape == (CROP_PX, CROP_PX, 3)
                levels = hbr.describe(image, descriptor="edges+colours+cedd", empty_table=table_image)
                similar = hbr.descriptor("edges+colours+cedd").similarity(levels[None], levels[None])
                assert similar == pytest.approx(1) or not image.std()  # a flat one has no edges


def test_objects_are_scaled_to_the_same_size() -> None:
    empty = table(0)
    small = segment(with_object(empty, (140, 120, 30, 55)), empty_table=empty)
    large = segment(with_object(empty, (120, 40, 72, 132)), empty_table=empty)
    for seen in (small, large):
        columns = np.flatnonzero(seen.mask[CROP_PX // 2] > 127)
        rows = np.flatnonzero(seen.mask[:, CROP_PX // 2] > 127)
        assert len(rows) == pytest.approx(CROP_PX / 1.1, rel=0.08)
        assert len(columns) == pytest.approx(CROP_PX / 1.1 * 6 / 11, rel=0.15)


def test_evidence_is_json() -> None:
    empty = table(0)
    seen = segment(with_object(empty), empty_table=empty)
    evidence = json.loads(json.dumps(seen.evidence()))
    assert tuple(evidence["box_px"]) == seen.box
    assert set(evidence) == {"method", "box_px", "gains_bgr", "agreement", "issues"}
    assert (evidence["method"], evidence["issues"]) == ("empty-table", [])
    other = segment(with_object(table(4, patterned=True)), empty_table=table(5, patterned=True)).evidence()
    assert other["issues"][0] == {"code": "empty-table-differs", "agreement": other["agreement"]}


def test_invalid_arguments_are_rejected() -> None:
    image = with_object(table(0))
    with pytest.raises(ValueError, match="the empty-table image has 100 x 80 pixels, the frame 320 x 240"):
        segment(image, empty_table=np.zeros((80, 100, 3), np.uint8))
    with pytest.raises(TypeError, match="imread returns None"):
        segment(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the frame has 300 x 15 pixels"):
        segment(np.zeros((15, 300, 3), np.uint8))
    with pytest.raises(ValueError, match="grey"):
        Background(np.zeros((80, 100), np.uint8))


def test_describe_segments_for_descriptors_of_the_object() -> None:
    empty = table(3, patterned=True)
    image = with_object(empty)
    levels = hbr.describe(image, descriptor="edges+colours+cedd", empty_table=empty)
    again = hbr.descriptor("edges+colours+cedd").describe(segment(image, empty_table=Background(empty)))
    np.testing.assert_array_equal(levels, again)
    np.testing.assert_array_equal(hbr.describe(image), hbr.descriptor("cedd").describe(image))


def test_edges_and_colours_are_robust_to_illumination_and_background() -> None:
    own = hbr.descriptor("edges=0.5,colours=0.5")
    empty, other = table(3), table(6, patterned=True)
    first = hbr.describe(with_object(empty), descriptor=own, empty_table=empty)
    moved = with_object(other, (150, 90, 54, 99))
    second = hbr.describe(relit(moved, (0.8, 1, 1.2)), descriptor=own, empty_table=relit(other, (0.8, 1, 1.2)))
    unknown = empty.copy()
    cv2.circle(unknown, (160, 130), 50, (40, 180, 40), -1)
    third = hbr.describe(unknown, descriptor=own, empty_table=empty)
    same, different = own.similarity(first[None], np.stack([second, third]))[0]
    assert same > 0.85 > different + 0.2


def test_code_of_the_descriptors_page_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[3] / "docs/explanation/descriptors.md").read_text(encoding="utf-8")
    empty = table(0)
    monkeypatch.setattr(cv2, "imread", lambda _path: empty)
    parts = []
    for j in range(3):
        shown = [with_object(empty, (100 + 4 * j + i, 60, 60 + 10 * j, 110)) for i in range(6)]
        levels = [hbr.describe(image, descriptor="edges+colours+cedd", empty_table=empty) for image in shown]
        parts.append(hbr.Views.of_object(f"object {j}", np.stack(levels), np.arange(6) * 60.0, "edges+colours+cedd"))
    known: dict[str, Any] = {
        "frame": with_object(empty),
        "views": hbr.Views.concatenate(parts),
        "orientation_deg": 0.0,
        "rotations_deg": [-90.0, 45.0],
    }
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(code, known)
    assert known["seen"].box is not None
    assert known["decision"].outcome in hbr.Outcome
    assert known["best"].rotation_deg in known["rotations_deg"]
    named = set(re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE))
    assert named == set(hbr.descriptors.names())


@pytest.mark.parametrize("box", [BOX, (30, 20, 20, 30)], ids=["larger-than-the-crop", "smaller-than-the-crop"])
def test_mask_of_the_frame_covers_the_object(box: tuple[int, int, int, int]) -> None:
    empty = table()
    frame = with_object(empty, box)
    height, width = frame.shape[:2]
    found = segment(frame, empty_table=empty)
    mask = found.frame_mask(width, height)
    really = np.abs(frame.astype(int) - empty).max(axis=2) > 20
    assert cv2.boundingRect(mask.astype(np.uint8)) == pytest.approx(found.box, abs=2)
    assert np.argwhere(mask).mean(axis=0) == pytest.approx(np.argwhere(really).mean(axis=0), abs=1)
    assert (mask & really).sum() > 0.97 * really.sum()
    assert not segment(np.full_like(frame, 128)).frame_mask(width, height).any()
