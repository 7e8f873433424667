"""Charts over two axes: the drawing shows the data, and all of it is in the picture."""

from itertools import pairwise
from math import nan
from xml.etree import ElementTree as ET

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.charts.candidates import SHOWN, Styles, candidates_chart
from rig.charts.svg import number
from rig.charts.xy import LIMIT, MEASURED, MODEL, Axis, Chart, Series
from rig.events.events import Candidate, Ranked
from tests.fuzzing import examples
from tests.rig.charts.drawn import HOSTILE, centre, check_text, having, points, words

CHART = Chart(
    "Title <b>",
    Axis("time, s"),
    Axis("angle, °", span=(0.0,)),
    (
        Series("measured & kept", [1, 2, 3], [10.0, 20.0, 15.0]),
        Series("limit", [1, 3], [25.0, 25.0], LIMIT, dots=False, curve=True, dashed=True, low=[24, 24], high=[26, 26]),
    ),
)


def markers(chart: Chart, colour: str = MEASURED) -> list[tuple[float, float]]:
    """Return the positions of the points of a chart, in the order of the data; the keys of the legend are left out."""
    return [centre(e) for e in having(chart.svg(), "dot", colour) if len(e)]


def test_points_are_where_the_data_are() -> None:
    first, second, third = markers(CHART)
    assert second[0] - first[0] == pytest.approx(third[0] - second[0], abs=0.02)
    assert (first[1] - third[1]) * 2 == pytest.approx(first[1] - second[1], abs=0.05)
    assert first[1] > second[1], "larger values are higher"
    (limit, *_key) = [points(e) for e in having(CHART.svg(), "curve", LIMIT) if e.get("d")]
    assert limit[0][1] == pytest.approx(second[1] - (first[1] - second[1]) / 2, abs=0.05), "25 is half as far as 10"
    assert [round(x) for x, _ in limit] == [round(first[0]), round(third[0])]
    assert len(having(CHART.svg(), "band", LIMIT)) == 1


def test_falling_axis_grows_downwards() -> None:
    first, second = markers(Chart("rows", Axis("x"), Axis("y", falling=True), (Series("", [1, 2], [1, 2]),)))
    assert second[1] > first[1]


@pytest.mark.parametrize("y", [[0, 0, 100], [0, 0, 900]])
def test_square_chart_has_equal_units(y: list[float]) -> None:
    chart = Chart("field", Axis("x"), Axis("y"), (Series("", [0, 300, 0], y),), square=True)
    origin, right, up = markers(chart)
    assert (right[0] - origin[0]) / 300 == pytest.approx((origin[1] - up[1]) / y[2], rel=0.01)


def test_numbers_are_round_and_have_the_decimals_of_their_step() -> None:
    chart = Chart("t", Axis("view", whole=True), Axis("score"), [Series("σ = 0.125", (1, 2, 3), (0.981, 0.99, 0.9874))])
    numbers = words(having(chart.svg(), "axis"))
    assert numbers[-3:] == ["1", "2", "3"]
    assert numbers[:-3] == ["0.982", "0.984", "0.986", "0.988", "0.990"]
    assert "σ = 0.125" in words(having(chart.svg(), "name"))


def test_named_ticks_that_are_too_close_are_left_out() -> None:
    axis = Axis("ω", ticks=tuple(range(40)), names=tuple(f"{k}" for k in range(40)))
    chart = Chart("t", axis, Axis("y", ticks=(0.0, 1.0), names=("0 %", "100 %")), [Series("", (0, 39), (0.5, 0.6))])
    below = [e for e in having(chart.svg(), "axis") if not (e.text or "").endswith("%")]
    at = [float(e.get("x", "")) for e in below]
    assert len(at) >= 10
    assert all(b - a >= 15 for a, b in pairwise(at))


def test_missing_values_make_a_gap() -> None:
    chart = Chart("t", Axis("x"), Axis("y"), [Series("", range(4), (0.5, 0.6, nan, 0.7), MODEL, curve=True)])
    assert len(markers(chart, MODEL)) == 3
    assert [len(points(e)) for e in having(chart.svg(), "curve", MODEL)] == [2, 1]


def test_svg_scales_has_a_label_and_equal_bytes_for_equal_charts() -> None:
    root = ET.fromstring(CHART.svg())
    assert root.get("role") == "img"
    assert root.get("aria-label") == CHART.label
    assert "measured & kept 15, limit 25" in CHART.label
    assert root.get("viewBox")
    assert root.get("width") is None, "the page decides on the size"
    assert {"time, s", "angle, °", "limit", "Title <b>"} <= set(words(having(CHART.svg())))
    assert Chart(CHART.title, CHART.x, CHART.y, CHART.series).svg() == CHART.svg()


def test_only_a_file_of_its_own_has_the_style_sheet() -> None:
    assert "<style>" not in CHART.svg()
    alone = CHART.svg(alone=True)
    assert "prefers-color-scheme: dark" in alone
    assert f".{MEASURED} " in alone
    assert having(alone, "paper")


@pytest.mark.parametrize("wide", [False, True])
def test_long_titles_and_legends_stay_in_the_picture(wide: bool) -> None:
    series = [Series(f"a method with a long name {k}", [1, 2], [k, k], curve=True) for k in range(8)]
    check_text(Chart("word " * 60, Axis("x"), Axis("y"), series, wide=wide).svg())


def ranked(*scores: dict[str, float]) -> list[Ranked]:
    return [Ranked(k, tuple(Candidate(*one, 0.0) for one in after.items()), 0.1) for k, after in enumerate(scores)]


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
def test_all_elements_are_inside_the_chart(rounds: list[dict[str, float]], min_score: float | None) -> None:
    """A damaged run may hold a score of any size."""
    svg = candidates_chart(ranked(*rounds), Styles(), min_score=min_score).svg()
    _, _, width, height = map(float, ET.fromstring(svg).get("viewBox", "").split())
    assert len(having(svg, "grid")) <= 12
    for e in having(svg):
        for key, limit in {"cx": width, "x1": width, "x": width, "cy": height, "y1": height, "y": height}.items():
            assert -0.01 <= float(e.get(key, 0)) <= limit


class TestCandidates:
    ROUNDS = ({"a": 0.9, "b": 0.8}, {"b": 0.85, "c": 0.82, "a": 0.7}, {"a": 0.88, "b": 0.84, "c": 0.81})

    def test_curve_of_the_answer_is_bold_and_has_its_scores(self) -> None:
        chart = candidates_chart(ranked(*self.ROUNDS), Styles(), answer="a", min_score=0.75)
        a, *others, threshold = chart.series
        assert (a.label, list(a.x), list(a.y), a.bold) == ("a 0.880", [1, 2, 3], [0.9, 0.7, 0.88], True)
        assert not any(one.bold for one in others)
        assert (threshold.label, list(threshold.y)) == ("below 0.75 is unknown", [0.75, 0.75])
        assert words(having(chart.svg(), "dot", "c0"))[:3] == [f"a 0.880: {y:g} at {k}" for k, y in enumerate(a.y, 1)]

    def test_distant_threshold_is_named_but_not_drawn(self) -> None:
        chart = candidates_chart(ranked({"a": 0.99, "b": 0.985}, {"a": 0.988, "b": 0.986}), Styles(), min_score=0.5)
        assert chart.series[-1].label == "below 0.5 is unknown"
        assert min(float(text) for text in words(having(chart.svg(), "axis"))[:-2]) > 0.9

    def test_best_candidates_are_sorted_and_an_object_has_one_style(self) -> None:
        styles = Styles()
        charts = [
            candidates_chart(ranked({f"n{i}": 0.9 - 0.01 * (i + k) % 7 for i in range(7)}), styles) for k in range(3)
        ]
        of: dict[str, set[str]] = {}
        for chart in charts:
            values = [one.y[-1] for one in chart.series]
            assert values == sorted(values, reverse=True)
            assert len(values) == SHOWN
            for one in chart.series:
                of.setdefault(one.label.split()[0], set()).add(one.colour)
        assert all(len(colours) == 1 for colours in of.values())
        assert len(set.union(*of.values())) == len(of)

    def test_more_objects_than_colours_have_dashed_lines(self) -> None:
        styles = Styles()
        assert len({styles[f"{k}"] for k in range(16)}) == 16

    @pytest.mark.parametrize("views", [1, 2])
    def test_long_names_are_shortened(self, views: int) -> None:
        svg = candidates_chart(ranked(*[{"a" * 100: 0.9, "b": 0.8}] * views), Styles()).svg()
        check_text(svg)
        assert "…" in svg

    def test_hostile_names_are_escaped(self) -> None:
        svg = candidates_chart(ranked({HOSTILE: 0.5}), Styles()).svg()
        assert words(having(svg, "name")) == [f"{HOSTILE} 0.500"]


@given(st.floats(-1e6, 1e6))
def test_numbers_are_short_and_accurate(value: float) -> None:
    assert float(number(value)) == pytest.approx(value, abs=0.00501)
    assert number(value) != "-0"
    assert "e" not in number(value)
