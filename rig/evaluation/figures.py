"""The figures of the paper, drawn from results: hit rate against views (Fig. 6) and pose error by object (Fig. 5)."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Any, Final

from rig.charts.candidates import Style, Styles
from rig.charts.xy import Axis, Chart, Series

_HIT_RATE: Final = Axis("hit rate, %")
_PREFERRED: Final = ("hbr", "ahbr", "dense")
"""Methods with bands of uncertainty: more of them would hide each other, and the tables have all intervals."""
_PATH_OF_HBR: Final = ("single", "hbr-visual", "hbr-0", "hbr-0-orient")
"""Methods with the same rotations as HBR."""
_ORIENT: Final = "-orient"


def figures(results: dict[str, Any]) -> dict[str, Chart]:
    """Return the figures that the results allow, by the name of their file."""
    methods, styles = results["methods"], Styles()
    by_method = [(method, _style(method["name"], styles)) for method in methods]
    preferred = [one for one in by_method if one[0]["name"] in _PREFERRED] or by_method[:2]
    last = max(point["views"] for method in methods for point in method["curve"])
    travel = [_against_travel(*one) for one in by_method if one[0]["name"] not in _PATH_OF_HBR]
    farthest = max((x for series in travel for x in series.x), default=0.0)
    right_angles = tuple(90.0 * i for i in range(max(2, ceil(farthest / 90) + 1)))
    drawn = {
        "hit-rate": (
            Axis("views of the object, N", ticks=tuple(range(1, last + 1))),
            _HIT_RATE,
            [series for method, style in by_method for series in _against_views(method, style, styles)],
        ),
        "travel": (Axis("mean rotation, °", ticks=right_angles), _HIT_RATE, travel),
        "pose": (
            Axis("objects, each curve sorted by its error", whole=True, span=(1.0,)),
            Axis("RMSE of the orientation, °", span=(0.0,)),
            [series for method, style in preferred for series in _pose_errors(method, style)],
        ),
    }
    # Sweeps of one parameter, if the experiment has several of its values.
    for prefix, x_label, file in (
        ("omega-", "weight of the orientation, ω", "omega-sweep"),
        ("list-", "length of the retrieval lists", "list-sweep"),
        ("sectors-", "average views of an object, N~M", "sector-sweep"),
    ):
        swept = [method for method in methods if method["name"].startswith(prefix)]
        if len(swept) > 1:
            values = tuple(method["name"].removeprefix(prefix) for method in swept)
            axis = Axis(x_label, ticks=tuple(range(len(values))), names=values)
            drawn[file] = (axis, _HIT_RATE, _sweep(swept))
    title = _title(results)
    return {file: Chart(title, *axes_and_series, wide=True) for file, axes_and_series in drawn.items()}


def _style(name: str, styles: Styles) -> Style:
    """Return the style of a method; its variant with the orientation has the same colour, dashed."""
    colour, dashed = styles[name.removesuffix(_ORIENT)]
    return Style(colour, dashed or name.endswith(_ORIENT))


def _against_views(method: dict[str, Any], style: Style, styles: Styles) -> list[Series]:
    """Return the hit rate with its 95 % Wilson intervals, and Best 10 of HBR (Fig. 6 of the paper)."""
    curve = method["curve"]
    views = [point["views"] for point in curve]
    series = [_rates(method["label"], style, views, curve, has_band=method["name"] in _PREFERRED or len(curve) == 1)]
    if method["name"] == "hbr":
        label = "Best 10 of HBR"
        series.append(_rates(label, styles[label], views, curve, "best10_rate", "best10_low", "best10_high"))
    return series


def _against_travel(method: dict[str, Any], style: Style) -> Series:
    travelled = [point["travelled_mean_deg"] for point in method["curve"]]
    return _rates(method["label"], style, travelled, method["curve"], has_band=method["name"] in _PREFERRED)


def _pose_errors(method: dict[str, Any], style: Style) -> list[Series]:
    """Return the RMSE of each object's estimated orientation after all views, sorted by size (Fig. 5 of the paper).

    Dashed: the plain error. Solid: the error to the nearest orientation from which the object looks the same.
    """
    series = []
    for key, dashed, words in (("pose", True, "plain"), ("alike", False, "similar")):
        errors = sorted(error for error in method[f"{key}_rmse_deg_by_object"] if error is not None)
        label, places = f"{method['label']}, {words}", range(1, len(errors) + 1)
        series.append(Series(label, places, errors, style.colour, dots=len(errors) == 1, curve=True, dashed=dashed))
    return series


def _sweep(methods: Sequence[dict[str, Any]]) -> list[Series]:
    """Return the hit rate against a setting for several numbers of views; the setting's values have equal distances."""
    styles, places = Styles(), range(len(methods))
    return [
        _rates(f"N = {n}", styles[f"{n}"], places, [method["curve"][n - 1] for method in methods])
        for n in range(2, len(methods[0]["curve"]) + 1, 2)
    ]


def _rates(
    label: str,
    style: Style,
    x: Sequence[float],
    points: Sequence[dict[str, Any]],
    *keys: str,
    has_band: bool = True,
) -> Series:
    rate, low, high = ([100 * p[key] for p in points] for key in keys or ("hit_rate", "hit_rate_low", "hit_rate_high"))
    series = Series(label, x, rate, style.colour, curve=True, dashed=style.dashed, low=low, high=high)
    return series if has_band else replace(series, low=(), high=())


def _title(results: dict[str, Any]) -> str:
    """Return the data set and its noise; results.json, beside the figures, has all settings."""
    settings = results["settings"]
    dataset, condition, protocol = settings["dataset"], settings["condition"], settings["protocol"]
    size = condition["size_px"] or max(dataset["width_px"], dataset["height_px"])
    words = [
        f"{dataset['name']}, {len(dataset['objects'])} objects, noise {condition['noise']} at {size} px",
        f"{protocol['trials']} trials an object",
    ]
    if results["reported"]:
        words.append("objects {} to {}".format(*results["reported"]))
    return "; ".join(words)
