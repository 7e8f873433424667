"""The charts on the circle of azimuths: their geometry and numbers are those of the data."""

from itertools import pairwise
from math import atan2, degrees, hypot
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.charts.compass import CENTRE, PathStep, dial, polar, polar_path
from tests.fuzzing import examples
from tests.rig.charts.drawn import centre, check_text, having, points, words

ANGLE = st.floats(-720, 720)
ROTATION = st.floats(-360, 360).filter(lambda a: abs(a) > 1)


def azimuth_of(x: float, y: float) -> float:
    """Return the azimuth of a point, seen from above: 0° at the top, counter-clockwise."""
    return degrees(atan2(CENTRE[0] - x, CENTRE[1] - y)) % 360


def apart(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


def path(start_deg: float, *rotations_deg: float) -> str:
    """Return the chart of a path whose views are all named."""
    steps = [PathStep(number, rotation) for number, rotation in enumerate(rotations_deg, 2)]
    return polar_path(start_deg, steps, named=range(1, len(steps) + 2))


@pytest.mark.parametrize(
    "svg",
    [path(0, *[40] * 7), dial()],
    ids=["path", "dial"],
)
def test_charts_are_readable_at_the_width_of_a_phone(svg: str) -> None:
    width = float(ET.fromstring(svg).get("viewBox", "").split()[2])
    assert width <= 400  # letters of 13.5 units are 11 px high on a phone of 375 px
    check_text(svg)


class TestPolarPath:
    def test_left_is_on_the_left_of_the_page(self) -> None:
        assert polar(100, 0)[0] == pytest.approx(CENTRE[0])
        assert polar(100, 0)[1] < CENTRE[1]
        assert polar(100, 90)[0] < CENTRE[0]

    @examples(7)
    @given(start=ANGLE, rotations=st.lists(ROTATION, max_size=8))
    def test_views_are_at_their_azimuths_and_arcs_connect_them(self, start: float, rotations: list[float]) -> None:
        svg = path(start, *rotations)
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
        way = [azimuth_of(*p) for p in points(having(path(start, rotation), "step")[0])]
        swept = sum((b - a + 180) % 360 - 180 for a, b in pairwise(way))
        assert swept == pytest.approx(rotation, abs=0.1)

    def test_path_is_a_spiral_outwards(self) -> None:
        svg = path(0, 90, -100, 80, 10, 95, -90, 90)
        radii = [hypot(x - CENTRE[0], y - CENTRE[1]) for arc in having(svg, "step") for x, y in points(arc)]
        assert radii == pytest.approx(sorted(radii), abs=0.02)

    @examples(7)
    @given(start=ANGLE, rotation=st.floats(30, 300) | st.floats(-300, -30))
    def test_arrow_points_at_the_end_of_the_arc(self, start: float, rotation: float) -> None:
        svg = path(start, rotation)
        tip, *tail = points(having(svg, "arrow")[0])
        end = centre(having(svg, "stop")[-1])

        def gap(p: tuple[float, float]) -> float:
            return hypot(p[0] - end[0], p[1] - end[1])

        assert gap(tip) == pytest.approx(8, abs=0.05)
        assert all(gap(p) > gap(tip) for p in tail)
        tail_azimuth = azimuth_of((tail[0][0] + tail[1][0]) / 2, (tail[0][1] + tail[1][1]) / 2)
        behind = (azimuth_of(*end) - tail_azimuth + 180) % 360 - 180
        assert behind * rotation > 0

    def test_views_have_the_numbers_of_their_cards_and_the_others_a_dot(self) -> None:
        steps = [PathStep(5, 47.3), PathStep(9, -120.5), PathStep(14, 20.0)]
        svg = polar_path(10, steps, named={1, 5, 14})
        assert words(having(svg, "stop-number")) == ["1", "5", "14"]
        assert words(having(svg, "seen")) == ["view 9 at 296.8°"]
        assert words(having(svg, "step")) == [
            "view 1 to 5: left 47.3°",
            "view 5 to 9: right 120.5°",
            "view 9 to 14: left 20.0°",
        ]

    def test_numbers_of_a_dozen_views_do_not_cover_each_other(self) -> None:
        at = [centre(e) for e in having(path(0, *[15.0] * 11), "stop")]
        assert all(hypot(a[0] - b[0], a[1] - b[1]) > 16 for k, a in enumerate(at) for b in at[:k])

    def test_alternative_text_lists_the_azimuths(self) -> None:
        assert "350.0°, 10.0°" in ET.fromstring(path(350, 20.0)).get("aria-label", "")

    def test_path_with_an_impossible_rotation_stays_small(self) -> None:
        assert len(path(0.0, 16_949_387.0)) < 200_000
