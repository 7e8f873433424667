"""The figures of an evaluation show the rates of its results."""

import pytest

from rig.evaluation.figures import figures


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
            "condition": {"noise": "gn:0.012", "size_px": None},
            "protocol": {"trials": 10},
        },
        "reported": [1, 3],
        "methods": list(methods),
    }


def test_curves_go_through_the_rates() -> None:
    drawn = figures(results(method("hbr", [0.5, 0.75, 1.0]), method("ahbr", [0.6, 0.8, 0.9])))
    assert set(drawn) == {"hit-rate", "travel", "pose"}
    hbr, best10, ahbr = drawn["hit-rate"].series
    assert (list(hbr.x), list(hbr.y)) == ([1, 2, 3], [50.0, 75.0, 100.0])
    assert list(hbr.low) == pytest.approx([48.0, 73.0, 98.0])
    assert (best10.label, list(best10.y)) == ("Best 10 of HBR", [100.0] * 3)
    assert list(drawn["travel"].series[1].x) == [45.0, 90.0, 135.0]
    assert list(drawn["pose"].series[0].y) == [10.0, 30.0]
    label = drawn["hit-rate"].label
    assert "label <ahbr> 90" in label
    assert "a & b, 3 objects, noise gn:0.012 at 128 px; 10 trials an object; objects 1 to 3" in label
    assert ahbr.label == "label <ahbr>"


def test_sweeps_have_figures_of_their_own() -> None:
    drawn = figures(results(*(method(f"omega-{value}", [0.5, 0.6, 0.7, value / 10]) for value in (0, 1, 8))))
    sweep = drawn["omega-sweep"]
    assert sweep.x.names == ("0", "1", "8")
    assert [series.label for series in sweep.series] == ["N = 2", "N = 4"]
