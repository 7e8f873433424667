"""Charts over two axes: the drawing shows the data, in SVG and in PNG, in light and in dark mode."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from rig.charts.xy import INK, LIMIT, MEASURED, Axis, Chart, Series

SVG = "{http://www.w3.org/2000/svg}"
CHART = Chart(
    "Title <b>",
    Axis("time, s"),
    Axis("angle, °", span=(0.0,)),
    (
        Series("measured & kept", [1, 2, 3], [10.0, 20.0, 15.0]),
        Series("limit", [1, 3], [25.0, 25.0], LIMIT, dots=False, curve=True, dashed=True, low=[24, 24], high=[26, 26]),
    ),
)


def markers(chart: Chart) -> list[tuple[float, float]]:
    """Return the positions of the points of a chart, in the order of the data."""
    found = re.findall(r'<use xlink:href="#\w+" x="([-\d.]+)" y="([-\d.]+)" style="fill: (#\w+)', chart.svg())
    return [(float(x), float(y)) for x, y, colour in found if colour == MEASURED]


def test_points_are_where_the_data_are() -> None:
    first, second, third, *_legend = markers(CHART)
    assert second[0] - first[0] == pytest.approx(third[0] - second[0], abs=0.02)
    assert (first[1] - third[1]) * 2 == pytest.approx(first[1] - second[1], abs=0.05)
    assert first[1] > second[1], "larger values are higher"


def test_legend_beside_a_wide_chart_is_below_its_title() -> None:
    figure = replace(
        CHART, title="coil-100, 100 objects, noise gn:0.012 at 128 px; 10 trials an object; 4 views enrolled", wide=True
    )._figure
    title, legend = figure.axes[0]._left_title.get_window_extent(), figure.legends[0].get_window_extent()
    assert title.x1 > legend.x0, "the title is longer than the plot"
    assert legend.y1 < title.y0


def test_points_far_from_the_included_value_keep_a_margin() -> None:
    chart = Chart("t", Axis("frame"), Axis("level", span=(0.0,)), (Series("s", [1, 2, 3], [1360.0, 1355.0, 1358.0]),))
    top = min(y for _, y in markers(chart))
    frame = re.search(r'<clipPath id="[^"]*"> <rect x="[\d.]+" y="([\d.]+)"', chart.svg())
    assert frame
    assert top - float(frame[1]) > 5


def test_falling_axis_grows_downwards() -> None:
    chart = Chart("rows", Axis("x"), Axis("y", falling=True), (Series("", [1, 2], [1, 2]),))
    first, second = markers(chart)
    assert second[1] > first[1]


def test_square_chart_has_equal_units() -> None:
    chart = Chart("field", Axis("x"), Axis("y"), (Series("", [0, 300, 0], [0, 0, 100]),), square=True)
    origin, right, up = markers(chart)
    assert (right[0] - origin[0]) / 300 == pytest.approx((origin[1] - up[1]) / 100, rel=0.01)


def test_logarithmic_axis_spaces_decades_evenly() -> None:
    chart = Chart("decades", Axis("x", log=True), Axis("y"), (Series("", [0.01, 0.1, 1.0, 10.0], [1, 2, 3, 4]),))
    x = [at[0] for at in markers(chart)]
    assert np.diff(x) == pytest.approx([x[1] - x[0]] * 3, abs=0.05)


def test_svg_scales_has_a_label_and_equal_bytes_for_equal_charts() -> None:
    root = ElementTree.fromstring(CHART.svg())
    assert root.get("role") == "img"
    assert root.get("aria-label") == CHART.label
    assert "measured & kept 15, limit 25" in CHART.label
    assert root.get("viewBox")
    assert root.get("width") is None, "the page decides on the size"
    assert {"time, s", "angle, °", "limit"} <= {text.text for text in root.iter(f"{SVG}text")}
    again = Chart(CHART.title, CHART.x, CHART.y, CHART.series)
    assert again.svg() == CHART.svg()


def test_numbers_in_titles_and_at_ticks_keep_their_decimals() -> None:
    axis = Axis("score", ticks=(0.0025, 0.005, 0.0075))
    chart = Chart("noise gn:0.012", Axis("view"), axis, [Series("σ = 0.125", (1, 2), (0.0025, 0.0075))])
    texts = [text.strip() for text in re.findall(r">([^<>]+)<", chart.svg())]
    assert {"noise gn:0.012", "σ = 0.125", "0.0025", "0.005", "0.0075"} <= set(texts)


def test_two_charts_of_a_page_share_no_ids() -> None:
    other = Chart("another", CHART.x, CHART.y, (Series("", [5], [6], LIMIT),))
    ids = [set(re.findall(r' id="([^"]+)"', chart.svg())) for chart in (CHART, other)]
    assert not ids[0] & ids[1] - {name for name in ids[0] if name.startswith("m")}, "only equal markers may repeat"


def test_themed_svg_takes_the_colours_of_the_page() -> None:
    assert "var(" not in CHART.svg()
    themed = CHART.svg(themed=True)
    assert f"var(--ink, {INK})" in themed
    assert "var(--card" in themed
    assert MEASURED in themed, "series keep their colours"


def test_png_has_twice_the_size_and_the_colours_of_the_series() -> None:
    image = cv2.imdecode(np.frombuffer(CHART.png(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (780, 1280, 3)
    blue, green, red = (int(MEASURED[i : i + 2], 16) for i in (5, 3, 1))
    assert (np.abs(image.astype(int) - (blue, green, red)).max(axis=2) < 8).sum() > 50


def test_long_titles_stay_in_the_picture() -> None:
    chart = Chart("word " * 60, Axis("x"), Axis("y"), (Series("", [1], [1]),))
    image = cv2.imdecode(np.frombuffer(chart.png(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert (image[:, -4:] == 255).all()
