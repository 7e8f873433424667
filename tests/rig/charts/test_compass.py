"""The charts on the circle of azimuths: their geometry and numbers are those of the data."""

from itertools import accumulate, pairwise
from math import atan2, degrees, hypot
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.charts.compass import CENTRE, dial, polar, polar_path
from tests.fuzzing import examples
from tests.rig.charts.drawn import centre, check_text, having, points, words

ROTATION = st.floats(-179, 179).filter(lambda a: abs(a) > 1)


def azimuth_of(x: float, y: float) -> float:
    """Return the azimuth of a point, seen from above: 0° at the top, counter-clockwise."""
    return degrees(atan2(CENTRE[0] - x, CENTRE[1] - y)) % 360


def apart(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


def path(start_deg: float, *rotations_deg: float) -> str:
    """Return the chart of a path with these rotations between its views."""
    return polar_path(dict(enumerate(accumulate(rotations_deg, initial=start_deg), 1)))


@pytest.mark.parametrize("svg", [path(0, *[40] * 7), dial()], ids=["path", "dial"])
def test_charts_are_readable_at_the_width_of_a_phone(svg: str) -> None:
    width = float(ET.fromstring(svg).get("viewBox", "").split()[2])
    assert width <= 400  # letters of 13.5 units are 11 px high on a phone of 375 px
    check_text(svg)


def test_left_is_on_the_left_of_the_page() -> None:
    assert polar(100, 0)[0] == pytest.approx(CENTRE[0])
    assert polar(100, 0)[1] < CENTRE[1]
    assert polar(100, 90)[0] < CENTRE[0]


@examples(10)
@given(start=st.floats(-720, 720), rotations=st.lists(ROTATION, max_size=11))
def test_views_are_at_their_azimuths_and_arcs_connect_them_on_a_spiral(start: float, rotations: list[float]) -> None:
    svg = path(start, *rotations)
    stops, arcs = having(svg, "stop"), having(svg, "step")
    assert words(having(svg, "stop-number")) == [str(number) for number in range(1, len(rotations) + 2)]
    azimuth = start
    for k, stop in enumerate(stops):
        assert apart(azimuth_of(*centre(stop)), azimuth) < 0.05
        if k < len(rotations):
            way = points(arcs[k])
            assert way[0] == pytest.approx(centre(stop), abs=0.02)
            assert way[-1] == pytest.approx(centre(stops[k + 1]), abs=0.02)
            swept = sum((b - a + 180) % 360 - 180 for a, b in pairwise(azimuth_of(*p) for p in way))
            assert swept == pytest.approx(rotations[k], abs=0.1)
            azimuth += rotations[k]
    radii = [hypot(x - CENTRE[0], y - CENTRE[1]) for arc in arcs for x, y in points(arc)]
    assert radii == pytest.approx(sorted(radii), abs=0.02)


def test_numbers_of_a_dozen_views_do_not_cover_each_other() -> None:
    at = [centre(e) for e in having(path(0, *[15.0] * 11), "stop")]
    assert all(hypot(a[0] - b[0], a[1] - b[1]) > 16 for k, a in enumerate(at) for b in at[:k])


def test_path_names_its_rotations_and_azimuths() -> None:
    svg = polar_path({1: 350.0, 5: 10.0, 9: 289.5})
    assert words(having(svg, "step")) == ["left 20.0°", "right 80.5°"]
    assert "350.0°, 10.0°, 289.5°" in ET.fromstring(svg).get("aria-label", "")
