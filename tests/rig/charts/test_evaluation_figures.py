"""The figures of an evaluation: where a point is drawn, in both formats."""

import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from rig.charts.drawing import Area, Dot, Figure, Line, Text, _dashes
from rig.charts.evaluation_figures import _ticks, figures


def pixels(figure: Figure) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(figure.png(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def method(name: str, rates: list[float]) -> dict:
    curve = [
        {
            "views": n,
            "hit_rate": rate,
            "hit_rate_low": rate - 0.02,
            "hit_rate_high": rate + 0.02,
            "best10_rate": 1.0,
            "best10_low": 0.99,
            "best10_high": 1.0,
            "travelled_mean_deg": 45.0 * n,
        }
        for n, rate in enumerate(rates, 1)
    ]
    poses = {"pose_rmse_deg_by_object": [10.0, None, 30.0], "alike_rmse_deg_by_object": [0.0, None, 5.0]}
    return {"name": name, "label": f"label <{name}>", "curve": curve, **poses}


def results(*methods: dict) -> dict:
    return {
        "settings": {
            "dataset": {"name": "a & b", "objects": ["x", "y", "z"], "width_px": 128, "height_px": 128},
            "condition": {
                "noise": "gn:0.012",
                "size_px": None,
                "background": "uniform",
                "rotation_deg": 20.0,
                "prefilter_px": 1.5,
                "perturbations": "none",
                "descriptor": "cedd",
            },
            "protocol": {"trials": 10, "enrolled": None},
        },
        "reported": [1, 3],
        "methods": list(methods),
    }


def test_shapes_are_where_they_are_said_to_be_in_both_formats() -> None:
    figure = Figure(
        100,
        60,
        "shapes",
        [Dot((30, 20), 6, "#ff0000", "a < b"), Area([(60, 30), (90, 30), (90, 50), (60, 50)], "#0000ff", 0.5)],
    )
    image = pixels(figure)
    assert image.shape == (120, 200, 3)
    red = np.argwhere((image[:, :, 2] > 200) & (image[:, :, 0] < 50))
    np.testing.assert_allclose(red.mean(axis=0), [39.5, 59.5], atol=0.6)
    assert len(red) == pytest.approx(np.pi * 12**2, rel=0.08)
    np.testing.assert_allclose(image[80, 150], [255, 128, 128], atol=1)
    assert (image[:15] == 255).all()
    root = ElementTree.fromstring(figure.svg())
    circle = root.find("{http://www.w3.org/2000/svg}circle")
    assert circle is not None
    assert (circle.get("cx"), circle.get("cy"), circle.get("r")) == ("30", "20", "6")
    assert circle[0].text == "a < b"


def test_text_is_anchored_and_written_in_ascii_on_pixels() -> None:
    spans = {}
    for anchor in ("start", "middle", "end"):
        image = pixels(Figure(200, 30, "text", [Text("ω = 0.5 °", (100, 20), anchor=anchor)]))  # type: ignore[arg-type]
        columns = np.flatnonzero((image < 200).any(axis=(0, 2))) / 2
        spans[anchor] = (columns[0], columns[-1])
    assert spans["start"][0] == pytest.approx(100, abs=2)
    assert spans["end"][1] == pytest.approx(100, abs=2)
    assert sum(spans["middle"]) / 2 == pytest.approx(100, abs=2)


def test_a_dashed_line_keeps_its_pattern_around_corners() -> None:
    straight = _dashes([(0, 0), (100, 0)])
    bent = _dashes([(0, 0), (3, 0), (3, 33), (67, 33)])
    assert sum(abs(b[0] - a[0]) for a, b in straight) == pytest.approx(11 * 5 + 1)  # 11 dashes, and the begin of one
    assert sum(np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in bent) == pytest.approx(11 * 5 + 1)
    assert _dashes([(5, 5), (5, 5)]) == []
    ink = (pixels(Figure(120, 20, "line", [Line([(10, 10), (110, 10)], "#000000", 2, dashed=True)])) < 128).any(
        axis=(0, 2)
    )
    assert np.abs(np.diff(ink.astype(int))).sum() == 24


def test_the_curves_go_through_their_rates() -> None:
    drawn = figures(results(method("hbr", [0.5, 0.75, 1.0]), method("ahbr", [0.6, 0.8, 0.9])))
    assert set(drawn) == {"hit-rate", "travel", "pose"}
    figure = drawn["hit-rate"]
    dots = {shape.words: shape.at for shape in figure.shapes if isinstance(shape, Dot)}
    low, middle, high = (dots[f"label <hbr>, {n}: {rate}"] for n, rate in ((1, "50.0"), (2, "75.0"), (3, "100.0")))
    assert low[1] - middle[1] == pytest.approx(middle[1] - high[1])
    assert middle[0] - low[0] == pytest.approx(high[0] - middle[0])
    assert low[1] > middle[1] > high[1]
    label = re.search(r'aria-label="([^"]*)"', figure.svg())
    assert label is not None
    assert "label &lt;ahbr&gt; 90.0" in label[1]
    assert "Best 10 of HBR 100.0" in label[1]
    assert (
        "a &amp; b, 3 objects, noise gn:0.012 at 128 px; 10 trials an object; objects 1 to 3; uniform background"
        in label[1]
    )
    assert "turned by up to 20°; prefilter 1.5 px" in label[1]


def test_sweeps_get_figures_of_their_own() -> None:
    drawn = figures(results(*(method(f"omega-{value}", [0.5, 0.6, 0.7, value / 10]) for value in (0, 1, 8))))
    assert "omega-sweep" in drawn
    words = [shape.words for shape in drawn["omega-sweep"].shapes if isinstance(shape, Text)]
    assert {"0", "1", "8", "N = 2", "N = 4"} <= set(words)
    assert "N = 3" not in words


@pytest.mark.parametrize("values", [[0.0], [88.8, 100.0], [13.2, 41.0], [99.9, 99.95], [0, 178.0], []])
def test_ticks_span_the_values_and_are_few(values: list[float]) -> None:
    ticks = _ticks(values)
    assert 3 <= len(ticks) <= 10
    assert not values or ticks[0] <= min(values) <= max(values) <= ticks[-1]
