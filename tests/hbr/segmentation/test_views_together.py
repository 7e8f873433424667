"""Segmentation of the views of one search together, and the open-set score under changes of the bench."""

from dataclasses import replace
from importlib import import_module

import cv2
import numpy as np
import pytest

import hbr
from hbr.dense.index import Whitening
from hbr.dense.leave_one_out import can_shift
from hbr.descriptors.base import Shift
from hbr.descriptors.together import like_enrollment
from hbr.drawing.bench import ENROLLMENT, HARD, MILD, DrawnBench, DrawnFrame, Visit
from hbr.segmentation import BoxMethod, Issue, IssueCode
from hbr.segmentation.background import shrunk
from hbr.segmentation.silhouette import Shares
from sim.objects.shelf import shelf
from sim.room import room

NAMES = tuple("abcdefghij")


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
    views = hbr.ViewsTogether("edges+colours")
    views.add(images[0])
    assert views.segmentations[0][0].method is BoxMethod.GUESS
    for image in images[1:]:
        views.add(image)
    assert [found[0].method for found in views.segmentations] == [BoxMethod.ROTATION] * 3
    assert min(overlap(found[0].box, box) for found, box in zip(views.segmentations, boxes, strict=True)) > 0.55
    assert [len(levels) for levels in views.levels] == [len(found) for found in views.segmentations]


def test_surroundings_that_change_with_the_view_are_not_learned() -> None:
    """A camera that orbits the object sees other surroundings in each view: each view is segmented alone."""
    views, again = hbr.ViewsTogether("edges+colours"), hbr.ViewsTogether("edges+colours", several=False)
    for azimuth_deg in (0.0, 60.0, 120.0, 180.0):
        image = room(0, -azimuth_deg).copy()
        shelf()["teapot"].draw(image, -azimuth_deg, (0.0, 0.0))
        views.add(image)
        again.learn(image)
    again.revise()
    for view in (views, again):
        assert [found[0].method for found in view.segmentations] == [BoxMethod.GUESS] * 4
    assert not views.reliable


def test_the_guess_counts_beside_the_segmentations_with_a_learned_background() -> None:
    images, _, _ = frames(3)
    views, again = hbr.ViewsTogether("edges+colours"), hbr.ViewsTogether("edges+colours", several=False)
    for image in images:
        views.add(image)
        again.learn(image)
    again.revise()
    for image, found, levels in zip(images, views.segmentations, views.levels, strict=True):
        guess = hbr.segment(image).box
        assert max(overlap(one.box, guess) for one in found) >= 0.85
        for one, row in zip(found, levels, strict=True):  # also of those that were described after an earlier view
            np.testing.assert_array_equal(hbr.descriptor("edges+colours").describe(one), row)
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
    views = hbr.ViewsTogether("edges+colours")
    views.add(images[0])
    with pytest.raises(ValueError, match="one size"):
        views.add(images[0][:200])


def test_the_most_similar_segmentation_counts() -> None:
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 4, (6, 512), dtype=np.uint8)
    index = hbr.DenseIndex(hbr.Views(levels, np.arange(6) * 120.0 % 360, np.repeat([0, 1], 3), ("a", "b"), "edges"))
    other = rng.integers(0, 4, 512, dtype=np.uint8)
    several = hbr.update_belief(np.stack([other, levels[4]]), 0.0, index)
    alone = hbr.update_belief(levels[4], 0.0, index)
    assert several.ranking().object_index[0] == 1
    assert several.scores()[1] == alone.scores()[1]


def test_a_shift_of_strength_0_changes_nothing_and_a_hard_one_does() -> None:
    images, empty, _ = frames(1)
    kind = hbr.descriptor("edges+colours")
    levels = kind.describe(hbr.segment(images[0], empty_table=empty))
    rng = np.random.default_rng(0)
    same = kind.shifted(levels, Shift.drawn(rng, 0.0))
    assert kind.similarity(same[None], levels[None])[0, 0] > 0.995
    hard = [kind.shifted(levels, Shift.drawn(rng, 1.0)) for _ in range(20)]
    similar = kind.similarity(np.stack(hard), levels[None])[:, 0]
    assert 0.7 < np.median(similar) < 0.97


def test_a_descriptor_without_shifts_keeps_the_earlier_score() -> None:
    rng = np.random.default_rng(0)
    views = hbr.Views(
        rng.integers(0, 8, (8, 144), dtype=np.uint8), np.arange(8) * 90.0 % 360, np.repeat([0, 1], 4), ("a", "b")
    )
    assert not can_shift(hbr.DenseIndex(views))


def test_no_answer_on_a_guessed_view_while_another_one_is_possible() -> None:
    images, empty, _ = frames(2)
    alone = hbr.ViewsTogether("edges+colours")
    alone.add(images[0], empty)
    assert alone.reliable  # by the empty-table image
    views = hbr.ViewsTogether("edges+colours")
    views.add(images[0])
    index = hbr.DenseIndex(hbr.Views(views.levels[0][:1], np.zeros(1), np.zeros(1, np.intp), ("a",), "edges+colours"))
    rule = hbr.fit_stopping_rule(index).rule
    session = hbr.DenseSession(index, rule)
    decision = session.add(views.levels[0], 0.0, reliable=views.reliable)
    assert (decision.outcome, decision.reason) == (hbr.Outcome.CONTINUE, hbr.StopReason.BADLY_SEGMENTED)
    assert session.end().outcome is hbr.Outcome.FOUND  # the table cannot rotate: no further view
    other = np.full_like(views.levels[0], 3)
    unknown = hbr.DenseSession(index, replace(rule, open_set_thresholds=(2.0,)))
    assert unknown.add(other, 0.0, reliable=False).outcome is hbr.Outcome.CONTINUE
    assert hbr.DenseSession(index, unknown.rule, max_views=1).add(other, 0.0, reliable=False).outcome is (
        hbr.Outcome.UNKNOWN
    )
    views.add(images[1])
    *earlier, levels = views.levels
    assert views.reliable
    assert session.add(levels, 90.0, earlier=earlier, reliable=True).reason is not hbr.StopReason.BADLY_SEGMENTED


def test_whitening_without_an_object_is_that_of_the_other_views() -> None:
    rng = np.random.default_rng(1)
    levels = rng.integers(0, 4, (60, 512), dtype=np.uint8)
    index = hbr.DenseIndex(hbr.Views(levels, np.arange(60) * 60.0 % 360, np.repeat(np.arange(10), 6), NAMES, "edges"))
    left_out = index.whitening.without(np.arange(6))
    found = left_out(index.whitening.white(levels[6:]))
    expected = Whitening(index.views.select(np.arange(6, 60))).unit(levels[6:])
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=0.03)
    with_it = index.whitening.unit(levels[:6])
    own = left_out(index.whitening.white(levels[:6]))
    gain = own @ found.T - with_it @ index.whitening.unit(levels[6:]).T
    assert np.abs(gain).max() > 0.003  # an unknown object is compared differently


@pytest.mark.parametrize(
    ("method", "same_bench", "expected"),
    [
        (BoxMethod.EMPTY_TABLE, True, True),
        (BoxMethod.PLAIN_BACKGROUND, True, True),
        (BoxMethod.ROTATION, True, None),
        (BoxMethod.GUESS, True, None),
        (BoxMethod.ROTATION, False, False),
        (BoxMethod.EMPTY_TABLE, None, None),
    ],
)
def test_a_segmentation_by_rotation_is_not_like_the_enrollment(
    method: BoxMethod, same_bench: bool | None, expected: bool | None
) -> None:
    assert like_enrollment(method, same_bench) is expected


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
    views = hbr.ViewsTogether("edges+colours", several=several)
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
    views = hbr.ViewsTogether("edges+colours")
    assert views.add(image)[0].method is BoxMethod.PLAIN_BACKGROUND
    assert views.reliable


@pytest.mark.parametrize(("platter", "overlaps"), [(0.4, [0.68]), (0.0, [])])
def test_a_box_that_may_contain_the_platter_is_reported(
    monkeypatch: pytest.MonkeyPatch, platter: float, overlaps: list[float]
) -> None:
    drawn = [frame.image for frame in on_a_visible_platter(2)]
    share = np.zeros((96, 128), np.float32)
    share[70:86, 30:98], share[40:80, 50:78] = platter, 0.9
    monkeypatch.setattr(import_module("hbr.segmentation.segment"), "shares", lambda *_, **__: Shares(share, share))
    learned = hbr.Background.learned([shrunk(drawn[1])], drawn[1].shape[:2])
    issues = tuple(Issue(IssueCode.DOUBTFUL_OUTLINE, {"overlap": one}) for one in overlaps)
    assert hbr.hypotheses(drawn[0], learned=learned, most=1)[0].issues == issues


def test_an_object_that_fills_the_frame_does_not_hide_that_the_background_stands_still() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 255, (2, 96, 128, 3), np.uint8)
    for image in (first, second):
        image[:6], image[:, :6], image[:, -6:] = 150, 150, 150
    found = hbr.Background.learned([shrunk(second)], (96, 128)).difference(shrunk(first))
    assert not found.reliable
    assert found.still


def test_two_plain_benches_are_not_known_to_be_one() -> None:
    """A border without texture proves nothing, a border with texture proves both."""
    answers = {}
    for textured in (0.0, 1.0):
        bench, *others = (DrawnBench.drawn(np.random.default_rng(n), textured=textured) for n in range(12))
        enrolled = hbr.Background(Visit(bench, ENROLLMENT, np.random.default_rng(0)).empty())
        later = Visit(bench, MILD, np.random.default_rng(1)).empty()
        foreign = [Visit(one, HARD, np.random.default_rng(n)).empty() for n, one in enumerate(others)]
        answers[textured] = enrolled.shows_same_bench(later), {enrolled.shows_same_bench(one) for one in foreign}
    assert answers == {0.0: (None, {None, False}), 1.0: (True, {False})}
    assert enrolled.shows_same_bench(later[:200]) is None  # another camera
