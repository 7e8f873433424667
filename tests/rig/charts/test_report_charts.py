"""The charts' geometry and numbers are those of the data, with any names."""

from itertools import pairwise
from math import atan2, degrees, hypot
from xml.etree import ElementTree as ET

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.charts.azimuth_ring import RingView, azimuth_ring
from rig.charts.compass import CENTRE, polar
from rig.charts.decision_chart import decision_chart
from rig.charts.polar_path import PathStep, polar_path
from rig.charts.score_chart import score_chart
from rig.charts.svg import number
from rig.events.events import RotationReason, Weighed
from tests.fuzzing import examples

ANGLE = st.floats(-720, 720)
ROTATION = st.floats(-360, 360).filter(lambda a: abs(a) > 1)
HOSTILE = "<script>alert(1)</script>&\"'"


def having(svg: str, *classes: str) -> list[ET.Element]:
    """Return the elements that have all the classes, in the order of drawing."""
    return [e for e in ET.fromstring(svg).iter() if set(classes) <= set(e.get("class", "").split())]


def azimuth_of(x: float, y: float) -> float:
    """Return the azimuth of a point, seen from above: 0° at the top, counter-clockwise."""
    return degrees(atan2(CENTRE[0] - x, CENTRE[1] - y)) % 360


def apart(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


def points(path: ET.Element) -> list[tuple[float, float]]:
    pairs = path.get("d", "").strip("MZ").split("L")
    return [(float(x), float(y)) for x, y in (p.split() for p in pairs)]


def centre(e: ET.Element) -> tuple[float, float]:
    return float(e.get("cx", "nan")), float(e.get("cy", "nan"))


def words(elements: list[ET.Element]) -> list[str]:
    return ["".join(e.itertext()) for e in elements]


SEPARATES = RotationReason.SEPARATES_CANDIDATES
WEIGHED = Weighed((60.0, -60.0), (-2.0, -1.0), (0.1, 0.2), (0.5, 0.7))


@pytest.mark.parametrize(
    "svg",
    [
        polar_path(0, [PathStep(40, 1, 2)] * 7, scale="azimuth on the table"),
        score_chart([{"a" * 60: 0.9, "b": 0.8}] * 8, min_score=0.5),
        decision_chart(0, WEIGHED, 60, reason=SEPARATES, candidates=("a" * 60, "b")),
        decision_chart(0, WEIGHED, 60, reason=RotationReason.SEVERAL_POSES),
        azimuth_ring([RingView(0, 10.0)]),
    ],
    ids=["path", "scores", "decision", "decision for one", "ring"],
)
def test_charts_are_readable_at_the_width_of_a_phone(svg: str) -> None:
    root = ET.fromstring(svg)
    _, _, width, height = map(float, root.get("viewBox", "").split())
    assert width <= 400  # letters of 13.5 units are 11 px high on a phone of 375 px
    for e in root.iter("text"):
        drawn = 6.4 * len("".join(e.itertext()))  # about, at 12 units
        x, anchor = float(e.get("x", "")), e.get("text-anchor")
        assert x - (drawn / 2 if anchor == "middle" else drawn if anchor == "end" else 0) >= -2
        assert x + (drawn / 2 if anchor == "middle" else drawn if anchor == "start" else 0) <= width + 10
        assert float(e.get("y", "")) <= height


class TestPolarPath:
    def test_left_is_on_the_left_of_the_page(self) -> None:
        assert polar(100, 0)[0] == pytest.approx(CENTRE[0])
        assert polar(100, 0)[1] < CENTRE[1]
        assert polar(100, 90)[0] < CENTRE[0]

    @examples(7)
    @given(start=ANGLE, rotations=st.lists(ROTATION, max_size=8))
    def test_views_are_at_their_azimuths_and_arcs_connect_them(self, start: float, rotations: list[float]) -> None:
        svg = polar_path(start, [PathStep(r) for r in rotations], scale="azimuth")
        stops, arcs = having(svg, "stop"), having(svg, "step")
        assert len(stops) == len(rotations) + 1
        azimuth = start
        for k, stop in enumerate(stops):
            assert apart(azimuth_of(*centre(stop)), azimuth) < 0.05
            if k < len(rotations):
                way = points(arcs[k])
                assert way[0] == pytest.approx(centre(stop), abs=0.02)
                assert way[-1] == pytest.approx(centre(stops[k + 1]), abs=0.02)
                azimuth += rotations[k]

    @examples(7)
    @given(start=ANGLE, rotation=ROTATION)
    def test_arc_covers_the_whole_rotation_in_its_direction(self, start: float, rotation: float) -> None:
        way = [azimuth_of(*p) for p in points(having(polar_path(start, [PathStep(rotation)], scale=""), "step")[0])]
        swept = sum((b - a + 180) % 360 - 180 for a, b in pairwise(way))
        assert swept == pytest.approx(rotation, abs=0.1)

    def test_path_is_a_spiral_outwards(self) -> None:
        svg = polar_path(0, [PathStep(r) for r in (90, -100, 80, 10, 95, -90, 90)], scale="")
        radii = [hypot(x - CENTRE[0], y - CENTRE[1]) for arc in having(svg, "step") for x, y in points(arc)]
        assert radii == pytest.approx(sorted(radii), abs=0.02)

    @examples(7)
    @given(start=ANGLE, rotation=st.floats(30, 300) | st.floats(-300, -30))
    def test_arrow_points_at_the_end_of_the_arc(self, start: float, rotation: float) -> None:
        svg = polar_path(start, [PathStep(rotation)], scale="")
        tip, *tail = points(having(svg, "arrow")[0])
        end = centre(having(svg, "stop", "last")[0])

        def gap(p: tuple[float, float]) -> float:
            return hypot(p[0] - end[0], p[1] - end[1])

        assert gap(tip) == pytest.approx(10, abs=0.05)
        assert all(gap(p) > gap(tip) for p in tail)
        tail_azimuth = azimuth_of((tail[0][0] + tail[1][0]) / 2, (tail[0][1] + tail[1][1]) / 2)
        behind = (azimuth_of(*end) - tail_azimuth + 180) % 360 - 180
        assert behind * rotation > 0

    def test_steps_show_degrees_side_and_similarity_sums(self) -> None:
        svg = polar_path(
            10, [PathStep(90), PathStep(47.3, 0.41, 0.66), PathStep(-120.5, 0.9971, 0.9963)], scale="as enrolled"
        )
        assert words(having(svg, "step-label")) == ["90.0°", "47.3°", "120.5°"]
        assert words(having(svg, "step-name")) == ["left 90.0°", "left 47.3°", "right 120.5°"]
        # equal at two decimals, so more decimals are shown
        assert {
            "as enrolled; left is counter-clockwise",
            "fixed",
            "S left 0.41, right 0.66",
            "S left 0.997, right 0.996",
        } <= set(words(having(svg, "small")))
        assert words(having(svg, "stop-number")) == ["1", "2", "3", "4"]

    def test_labels_do_not_cover_views_or_each_other(self) -> None:
        svg = polar_path(9.6, [PathStep(r) for r in (90.1, -175, -80.1, 10.1, 95, 90.1, 90)], scale="")
        labels = [(float(e.get("x", "")), float(e.get("y", "")) - 4) for e in having(svg, "step-label")]
        others = [centre(e) for e in having(svg, "stop")]
        for k, a in enumerate(labels):
            for b in others + labels[:k]:
                assert abs(a[0] - b[0]) >= 46 or abs(a[1] - b[1]) >= 17

    def test_labels_do_not_cover_other_arcs(self) -> None:
        svg = polar_path(270, [PathStep(r) for r in (90, -45, 90, 90, -270, -90, -45)], scale="")
        labels = having(svg, "step-label")
        assert len(labels) >= 4
        for label in labels:
            x, y = float(label.get("x", "")), float(label.get("y", "")) - 4
            near = [
                arc for arc in having(svg, "step") if any(abs(a - x) < 23 and abs(b - y) < 8.5 for a, b in points(arc))
            ]
            assert len(near) <= 1

    def test_long_search_has_room_for_every_step(self) -> None:
        svg = polar_path(0, [PathStep(7.0, 1, 2)] * 40, scale="")
        height = float(ET.fromstring(svg).get("viewBox", "").split()[3])
        assert all(float(e.get("y", "")) < height for e in ET.fromstring(svg).iter("text"))

    def test_alternative_text_lists_the_azimuths(self) -> None:
        svg = polar_path(350, [PathStep(20.0)], scale="")
        assert "350.0°, 10.0°" in ET.fromstring(svg).get("aria-label", "")


class TestScoreChart:
    ROUNDS = ({"a": 0.9, "b": 0.8}, {"b": 0.85, "c": 0.82, "a": 0.7}, {"a": 0.88, "b": 0.84, "c": 0.81})

    def test_line_of_the_answer_shows_its_scores(self) -> None:
        svg = score_chart(self.ROUNDS, winner="a", min_score=0.75)
        dots = having(svg, "winner", "dot")
        assert words(dots) == ["a after view 1: 0.900", "a after view 2: 0.700", "a after view 3: 0.880"]
        (x0, y0), (x1, y1), (x2, y2) = map(centre, dots)
        assert x1 - x0 == pytest.approx(x2 - x1, abs=0.02)
        # y is linear in the score and grows downwards
        assert (y1 - y0) / (y1 - y2) == pytest.approx((0.9 - 0.7) / (0.88 - 0.7), rel=1e-3)
        assert y0 < y2 < y1

    def test_threshold_is_at_its_score(self) -> None:
        svg = score_chart(self.ROUNDS, winner="a", min_score=0.75)
        threshold, _ = having(svg, "threshold")  # the second one leads to its label
        y = float(threshold.get("y1", ""))
        (_, y_high), (_, y_low), _ = map(centre, having(svg, "winner", "dot"))
        assert y == pytest.approx(y_low + (y_high - y_low) * (0.75 - 0.7) / (0.9 - 0.7), abs=0.05)
        assert words(having(svg, "threshold-label")) == ["threshold 0.75"]

    def test_threshold_has_a_row_of_its_own_among_the_names(self) -> None:
        svg = score_chart([{"a": 0.9, "b": 0.8999, "c": 0.8998}], winner="a", min_score=0.8999)
        (label,) = having(svg, "threshold-label")
        rows = sorted(float(e.get("y", "")) for e in [label, *having(svg, "name")])
        assert all(b - a >= 15.9 for a, b in pairwise(rows))
        drawn = [float(e.get(key, 0)) for e in ET.fromstring(svg).iter() for key in ("x1", "x2", "cx")]
        assert max(drawn) < float(label.get("x", ""))  # no line crosses it

    def test_numbers_of_many_views_do_not_pile_up(self) -> None:
        svg = score_chart([{"a": 0.9 - 0.001 * view} for view in range(72)])
        below = max(float(e.get("y", "")) for e in having(svg, "axis"))
        at = [float(e.get("x", "")) for e in having(svg, "axis") if float(e.get("y", "")) == below]
        assert len(at) >= 6
        assert all(b - a >= 15 for a, b in pairwise(at))

    def test_distant_threshold_is_marked_as_off_the_scale(self) -> None:
        svg = score_chart([{"a": 0.99, "b": 0.985}, {"a": 0.988, "b": 0.986}], min_score=0.5)
        assert words(having(svg, "threshold-label")) == ["threshold 0.5 ↓"]
        assert having(svg, "threshold") == []
        svg = score_chart([{"a": 0.49, "b": 0.485}], min_score=0.9)
        assert words(having(svg, "threshold-label")) == ["threshold 0.9 ↑"]

    def test_line_has_a_gap_while_a_candidate_was_not_leading(self) -> None:
        rounds = [{"a": 0.9, "b": 0.8}, {"a": 0.9}, {"a": 0.9, "b": 0.8}]
        svg = score_chart(rounds)
        assert words(having(svg, "c1", "dot")) == ["b after view 1: 0.800", "b after view 3: 0.800"]
        assert [e for e in having(svg, "c1") if e.tag.endswith("line")] == []

    def test_names_are_sorted_spaced_and_the_truth_is_marked(self) -> None:
        rounds = [{f"n{i}": 0.9 - 0.0001 * i for i in range(7)}]
        svg = score_chart(rounds, winner="n0", truth="n1")
        names = having(svg, "name")
        assert words(names) == ["0.900 n0", "0.900 n1 ●", "0.900 n2", "0.900 n3", "0.900 n4"]
        rows = [float(e.get("y", "")) for e in names]
        assert all(b - a >= 15.9 for a, b in pairwise(rows))
        assert rows[0] > 20  # below the axis' title, though all scores are at the top
        assert words(having(svg, "winner", "name")) == ["0.900 n0"]

    @examples(10)
    @given(
        rounds=st.lists(
            st.dictionaries(st.sampled_from("abcdefg"), st.floats(-1, 1) | st.floats(-1e300, 1e300), min_size=1),
            min_size=1,
            max_size=9,
        ),
        min_score=st.none() | st.floats(0, 1),
    )
    @example(rounds=[{"a": 1e17}], min_score=None)
    @example(rounds=[{"a": 728640.0, "b": 0.5}], min_score=None)
    def test_all_elements_are_inside_the_chart(self, rounds: list[dict[str, float]], min_score: float | None) -> None:
        root = ET.fromstring(score_chart(rounds, min_score=min_score))
        _, _, width, height = map(float, root.get("viewBox", "").split())
        assert sum(e.get("class") == "grid" for e in root.iter()) <= 8
        for e in root.iter():
            for key, limit in (
                ("cx", width),
                ("x1", width),
                ("x", width),
                ("cy", height),
                ("y1", height),
                ("y", height),
            ):
                assert 0 <= float(e.get(key, 0)) <= limit

    def test_names_are_escaped_and_long_names_shortened(self) -> None:
        long = "x" * 60
        svg = score_chart([{HOSTILE: 0.9, long: 0.8}], winner=HOSTILE, truth=HOSTILE)
        assert "<script" not in svg
        drawn = words(having(svg, "name"))
        assert drawn[0].startswith("0.900 <script>")
        assert len(drawn[1]) < 30
        assert long in svg  # whole in the tooltip

    def test_score_chart_rejects_empty_rounds(self) -> None:
        for rounds in ([], [{}], [{"a": 1.0}, {}]):
            with pytest.raises(ValueError, match="at least one"):
                score_chart(rounds)


class TestAzimuthRing:
    def test_bars_are_at_their_azimuths_with_lengths_by_sharpness(self) -> None:
        views = [RingView(0, 100), RingView(90, 50), RingView(217.3, 25, 2)]
        svg = azimuth_ring(views)
        lengths = []
        for bar, view in zip(having(svg, "bar"), views, strict=True):
            x1, y1, x2, y2 = (float(bar.get(key, "")) for key in ("x1", "y1", "x2", "y2"))
            assert apart(azimuth_of(x2, y2), view.azimuth_deg) < 0.05
            lengths.append(hypot(x2 - x1, y2 - y1))
        assert lengths[1] / lengths[0] == pytest.approx(0.5, abs=1e-3)
        assert lengths[2] / lengths[0] == pytest.approx(0.25, abs=1e-3)

    def test_retakes_are_marked_at_their_azimuth(self) -> None:
        svg = azimuth_ring([RingView(0, 100), RingView(120, 50, 1), RingView(240, 50, 3)])
        marks = having(svg, "retake")
        assert [round(azimuth_of(*centre(m))) for m in marks] == [120, 240]
        assert words(marks) == ["120.0°: sharpness 50.0, once retaken", "240.0°: sharpness 50.0, 3 times retaken"]

    def test_ring_shows_its_numbers(self) -> None:
        svg = azimuth_ring([RingView(0, 100), RingView(120, 50), RingView(240, 70)])
        assert words(having(svg, "ring-text")) == ["sharpness", "median 70", "50 to 100"]
        assert "3 views" in ET.fromstring(svg).get("aria-label", "")

    def test_black_views_have_bars_of_length_zero(self) -> None:
        svg = azimuth_ring([RingView(0, 0.0), RingView(180, 0.0)])
        assert all(bar.get("x1") == bar.get("x2") for bar in having(svg, "bar"))

    def test_ring_rejects_no_views(self) -> None:
        with pytest.raises(ValueError, match="at least one view"):
            azimuth_ring([])


@given(st.floats(-1e6, 1e6))
def test_numbers_are_short_and_accurate(value: float) -> None:
    assert float(number(value)) == pytest.approx(value, abs=0.00501)
    assert number(value) != "-0"
    assert "e" not in number(value)


ROTATIONS = tuple(float(rotate) for rotate in range(-175, 185, 5) if rotate)


class TestDecisionChart:
    @examples(6)
    @given(here=ANGLE, chosen=st.sampled_from(ROTATIONS), seen=st.lists(ANGLE, min_size=1, max_size=4))
    def test_chosen_rotation_is_innermost_at_its_azimuth(self, here: float, chosen: float, seen: list[float]) -> None:
        away = tuple(abs(rotate - chosen) for rotate in ROTATIONS)
        weighed = Weighed(ROTATIONS, tuple(-9 + a for a in away), tuple(abs(t) / 100 for t in ROTATIONS), away)
        svg = decision_chart(
            here, weighed, chosen, reason=SEPARATES, candidates=("a", HOSTILE), seen_deg=seen, number=len(seen)
        )
        goal, *others = having(svg, "stop", "last")
        assert not others
        x, y = centre(goal)
        assert apart(azimuth_of(x, y), here + chosen) < 1
        radii = [hypot(px - CENTRE[0], py - CENTRE[1]) for px, py in points(having(svg, "confusion")[0])]
        assert min(radii) == pytest.approx(hypot(x - CENTRE[0], y - CENTRE[1]), abs=0.02)
        assert len(radii) == len(having(svg, "cost")) == len(ROTATIONS)
        stops = [centre(e) for e in having(svg, "stop") if "last" not in e.get("class", "")]
        assert all(apart(azimuth_of(*at), angle) < 1 for at, angle in zip(stops, seen, strict=True))
        text = " ".join(words(having(svg, "step-name")))
        assert HOSTILE in text
        assert f"{abs(chosen):.0f}°" in text

    def test_single_object_and_equal_values_are_drawn(self) -> None:
        for revolutions in ((5.0,), (-5.0, 5.0), ROTATIONS):
            even = (0.0,) * len(revolutions)
            svg = decision_chart(0.0, Weighed(revolutions, even, even), revolutions[0], reason=RotationReason.NEW_SIDE)
            assert "only one object is likely" in svg
            assert not having(svg, "similarity")
            assert "nan" not in svg

    def test_one_object_is_called_likely_only_for_that_reason(self) -> None:
        weighed = Weighed((-5.0, 5.0), (-1.0, -2.0), (0.1, 0.1))
        several = decision_chart(0.0, weighed, 5.0, reason=RotationReason.SEVERAL_POSES)
        assert "fits in several poses" in several
        # In motion, two candidates are compared without their similarity.
        moving = decision_chart(0.0, weighed, 5.0, reason=SEPARATES, candidates=("a", "b"))
        assert {"separates", "a", "b", "13.5 % there, 36.8 % at worst"} <= set(words(having(moving, "small"))) | set(
            words(having(moving, "step-name"))
        )
        assert "object is likely" not in several + moving


def test_path_with_an_impossible_rotation_stays_small() -> None:
    assert len(polar_path(0.0, [PathStep(16_949_387.0)], scale="azimuth")) < 200_000
