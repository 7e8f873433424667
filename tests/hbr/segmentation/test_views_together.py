"""Segmentation of the views of one search together."""

from importlib import import_module

import cv2
import numpy as np
import pytest

import hbr
from hbr.drawing.bench import ENROLLMENT, HARD, DrawnBench, DrawnFrame, Visit
from hbr.segmentation import BoxMethod, Issue, IssueCode
from hbr.segmentation.background import shrunk
from hbr.segmentation.silhouette import Shares
from sim.objects.shelf import shelf
from sim.room import room
from tests.hbr.dense.searches import LIGHT, catalog


def frames(count: int) -> tuple[list[np.ndarray], np.ndarray, list[tuple[int, int, int, int]]]:
    """Return frames of a striped box on a textured bench, its empty table, and the true boxes."""
    visit = Visit(DrawnBench.drawn(np.random.default_rng(1003)), HARD, np.random.default_rng(5))
    found, boxes = [], []
    for n in range(count):
        photograph = np.zeros((128, 128, 3), np.uint8)
        half = (26, 40, 30, 44)[n % 4]
        photograph[20:110, 64 - half : 64 + half] = (40, 60, 210)
        photograph[30 : 50 + 10 * n, 64 - half : 64 + half - 8] = (230, 220, 60)
        frame = visit.photograph(photograph, photograph.any(axis=2), 90.0 * n)
        rows, columns = np.nonzero(frame.mask)
        found.append(frame.image)
        boxes.append((columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1))
    return found, visit.empty(), boxes


def overlap(a: tuple[int, ...], b: tuple[int, ...]) -> float:
    across = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    down = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    both = max(0, across) * max(0, down)
    return both / (a[2] * a[3] + b[2] * b[3] - both)


def test_further_views_revise_the_segmentation_of_earlier_ones() -> None:
    images, _, boxes = frames(3)
    views = hbr.ViewsTogether("edges+colours+cedd")
    views.add(images[0])
    assert views.segmentations[0][0].method is BoxMethod.GUESS
    for image in images[1:]:
        views.add(image)
    assert [found[0].method for found in views.segmentations] == [BoxMethod.ROTATION] * 3
    assert min(overlap(found[0].box, box) for found, box in zip(views.segmentations, boxes, strict=True)) > 0.55
    assert [len(levels) for levels in views.levels] == [len(found) for found in views.segmentations]


def test_surroundings_that_change_with_the_view_are_not_learned() -> None:
    """A camera that orbits the object sees other surroundings in each view: each view is segmented alone."""
    views, again = hbr.ViewsTogether("edges+colours+cedd"), hbr.ViewsTogether("edges+colours+cedd", several=False)
    for azimuth_deg in (0.0, 60.0, 120.0, 180.0):
        image = room(0, -azimuth_deg).copy()
        shelf()["teapot"].draw(image, -azimuth_deg, (0.0, 0.0))
        views.add(image)
        again.learn(image)
    again.revise()
    for view in (views, again):
        assert [found[0].method for found in view.segmentations] == [BoxMethod.GUESS] * 4
    assert not views.reliable


def test_the_guess_of_the_first_view_counts_beside_its_segmentations_with_a_learned_background() -> None:
    images, _, _ = frames(3)
    views, again = hbr.ViewsTogether("edges+colours+cedd"), hbr.ViewsTogether("edges+colours+cedd", several=False)
    for image in images:
        views.add(image)
        again.learn(image)
    again.revise()
    guess = hbr.segment(images[0]).box
    assert max(overlap(one.box, guess) for one in views.segmentations[0]) >= 0.85
    for found, levels in zip(views.segmentations, views.levels, strict=True):
        for one, row in zip(found, levels, strict=True):  # also of those that were described after an earlier view
            np.testing.assert_array_equal(hbr.descriptor("edges+colours+cedd").describe(one), row)
    assert [len(found) for found in again.segmentations] == [1] * 3  # an enrollment has one


def test_the_network_uses_the_empty_table_image() -> None:
    images, empty, boxes = frames(1)
    found = hbr.hypotheses(images[0], empty_table=empty, most=1)
    assert found[0].method is BoxMethod.EMPTY_TABLE
    assert overlap(found[0].box, boxes[0]) > 0.8
    again = hbr.hypotheses(images[0], empty_table=empty, most=1)
    np.testing.assert_array_equal(found[0].mask, again[0].mask)


def test_views_of_another_size_are_rejected() -> None:
    images, _, _ = frames(1)
    views = hbr.ViewsTogether("edges+colours+cedd")
    views.add(images[0])
    with pytest.raises(ValueError, match="one size"):
        views.add(images[0][:200])


def test_the_most_similar_segmentation_counts() -> None:
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 2, (6, 512), dtype=np.uint8)
    index = hbr.DenseIndex(hbr.Views(levels, np.arange(6) * 120.0 % 360, np.repeat([0, 1], 3), ("a", "b"), "edges"))
    other = rng.integers(0, 2, 512, dtype=np.uint8)
    several = hbr.update_belief(np.stack([other, levels[4]]), 0.0, index)
    alone = hbr.update_belief(levels[4], 0.0, index)
    assert several.ranking().object_index[0] == 1
    # the product of one row and that of two differ in the last digits of float32 on some processors
    assert several.scores()[1] == pytest.approx(alone.scores()[1], abs=1e-6)


def test_no_answer_on_a_guessed_view_while_another_one_is_possible() -> None:
    images, empty, _ = frames(2)
    alone = hbr.ViewsTogether("edges+colours+cedd")
    alone.add(images[0], empty)
    assert alone.reliable  # by the empty-table image
    views = hbr.ViewsTogether("edges+colours+cedd")
    views.add(images[0])
    enrolled = hbr.Views.of_object("box", views.levels[0][:1], np.zeros(1), LIGHT)
    index = hbr.DenseIndex(hbr.Views.concatenate([enrolled, catalog()]))
    session = hbr.DenseSession(index)
    decision = session.add(views.levels[0], 0.0, reliable=views.reliable)
    assert (decision.outcome, decision.reason) == (hbr.Outcome.CONTINUE, hbr.StopReason.BADLY_SEGMENTED)
    assert session.end().outcome is hbr.Outcome.FOUND  # the table cannot rotate: no further view
    for max_views, outcome in ((8, hbr.Outcome.CONTINUE), (1, hbr.Outcome.UNKNOWN)):
        unknown = hbr.DenseSession(index, max_views=max_views)
        assert unknown.add(np.zeros_like(views.levels[0]), 0.0, reliable=False).outcome is outcome
    views.add(images[1])
    *earlier, levels = views.levels
    assert views.reliable
    assert session.add(levels, 90.0, earlier=earlier, reliable=True).reason is not hbr.StopReason.BADLY_SEGMENTED


def on_a_visible_platter(count: int) -> list[DrawnFrame]:
    """Return frames of a printed box on a dark platter before a bright plain backdrop."""
    bench = DrawnBench(np.full((240, 320, 3), 170, np.float32), np.full((192, 192, 3), 70, np.float32))
    visit = Visit(bench, ENROLLMENT, np.random.default_rng(0))
    photograph = np.zeros((128, 128, 3), np.uint8)
    photograph[30:120, 34:94] = (40, 60, 210)
    photograph[50:70, 40:80] = (230, 220, 60)
    return [visit.photograph(photograph, photograph.any(axis=2), 360.0 * n / count) for n in range(count)]


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("several", [False, True])
def test_a_platter_before_a_plain_backdrop_is_not_part_of_the_object(count: int, several: bool) -> None:
    drawn = on_a_visible_platter(count)
    views = hbr.ViewsTogether("edges+colours+cedd", several=several)
    for frame in drawn:
        views.learn(frame.image)
    views.revise()
    by_border = hbr.segment(drawn[0].image)
    box = cv2.boundingRect(drawn[0].mask.astype(np.uint8))
    assert by_border.method is BoxMethod.PLAIN_BACKGROUND
    assert overlap(by_border.box, box) < 0.6
    assert overlap(views.segmentations[0][0].box, box) > 0.85
    assert views.reliable is (count > 1)  # one view does not show what rotates


def test_a_plain_background_that_the_network_confirms_is_a_known_one() -> None:
    image = np.full((240, 320, 3), 170, np.uint8)
    image[80:200, 120:200] = (40, 60, 210)
    views = hbr.ViewsTogether("edges+colours+cedd")
    assert views.add(image)[0].method is BoxMethod.PLAIN_BACKGROUND
    assert views.reliable


@pytest.mark.parametrize(("platter", "overlaps"), [(0.4, [0.68]), (0.0, [])])
def test_a_box_that_may_contain_the_platter_is_reported(
    monkeypatch: pytest.MonkeyPatch, platter: float, overlaps: list[float]
) -> None:
    drawn = [frame.image for frame in on_a_visible_platter(2)]
    share = np.zeros((96, 128), np.float32)
    share[70:86, 30:98], share[40:80, 50:78] = platter, 0.9
    monkeypatch.setattr(import_module("hbr.segmentation.segment"), "shares", lambda *_, **__: Shares(share, 1 - share))
    learned = hbr.Background.learned([shrunk(drawn[1])], drawn[1].shape[:2])
    issues = tuple(Issue(IssueCode.DOUBTFUL_OUTLINE, {"overlap": one}) for one in overlaps)
    assert hbr.hypotheses(drawn[0], learned=learned, most=1)[0].issues == issues


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("plain", [True, False])
def test_nothing_is_found_on_an_empty_table(count: int, plain: bool) -> None:
    """By the empty-table image, or because a plain table does not change while it rotates."""
    visit = Visit(DrawnBench.drawn(np.random.default_rng(3), plain=plain), ENROLLMENT, np.random.default_rng(0))
    views = hbr.ViewsTogether("edges+colours+cedd")
    for n in range(count):
        views.learn(visit.empty(90.0 * n), visit.empty() if count == 1 or not plain else None)
    views.revise()
    for found in views.segmentations:
        assert [one.method for one in found] == [BoxMethod.NONE]


@pytest.mark.parametrize("missing", [0, 2])
def test_what_only_the_other_views_show_is_not_found(missing: int) -> None:
    """Before a plain backdrop: there the object would stand out."""
    frames = [np.full((240, 320, 3), 170, np.uint8) for _ in range(4)]
    for n, frame in enumerate(frames):
        if n != missing:
            frame[80:200, 120 - 10 * n : 200 + 10 * n] = 40, 60, 210
    views = hbr.ViewsTogether("edges+colours+cedd", several=False)
    for frame in frames:
        views.learn(frame)
    views.revise()
    assert [(found[0].box is None) for found in views.segmentations] == [n == missing for n in range(4)]


def test_an_object_that_fills_the_frame_before_a_plain_background_is_whole() -> None:
    """A disc does not change while it rotates, and only the spot on it would be found."""
    frames = []
    for n in range(4):
        frame = np.zeros((120, 160, 3), np.uint8)
        cv2.circle(frame, (80, 60), 62, (70, 160, 230), -1)
        spot = round(80 + 30 * np.cos(np.pi / 2 * n)), round(60 + 30 * np.sin(np.pi / 2 * n))
        cv2.circle(frame, spot, 16, (210, 50, 30), -1)
        frames.append(frame)
    views = hbr.ViewsTogether("edges+colours+cedd")
    for frame in frames:
        views.learn(frame)
    views.revise()
    for found in views.segmentations:
        assert overlap(found[0].box, (18, 0, 125, 120)) > 0.9


def test_an_object_that_fills_the_frame_does_not_hide_that_the_background_stands_still() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 255, (2, 96, 128, 3), np.uint8)
    for image in (first, second):
        image[:6], image[:, :6], image[:, -6:] = 150, 150, 150
    found = hbr.Background.learned([shrunk(second)], (96, 128)).difference(shrunk(first))
    assert not found.reliable
    assert found.still
