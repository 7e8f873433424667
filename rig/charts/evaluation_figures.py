"""The figures of the paper, drawn from results: hit rate against views (Fig. 6) and pose error by object (Fig. 5)."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Any, Final

from rig.charts.xy import Axis, Chart, Series

#: Colour and dashes of each method, the same in every figure.
_STYLES: Final = {
    "single": ("soft", True),
    "hbr-visual": ("c5", False),
    "hbr-0": ("c2", False),
    "hbr-0-orient": ("c2", True),
    "hbr": ("c0", False),
    "hbr-orient": ("c0", True),
    "ahbr": ("c1", False),
    "ahbr-orient": ("c1", True),
    "ahbr-90": ("c7", False),
    "coin": ("c3", False),
    "sweep-45": ("ink", False),
    "sweep-90": ("ink", True),
    "dense": ("c6", False),
    "dense-coin": ("c3", False),
    "dense-random": ("c0", False),
    "dense-45": ("ink", False),
    "dense-90": ("ink", True),
    "dense-mutual": ("c2", False),
    "dense-oracle": ("c4", True),
}
_OTHERS: Final = ("c0", "c1", "c2", "c3", "c5", "ink", "soft", "c4")
_BEST_10: Final = ("c4", False)
_HIT_RATE: Final = Axis("hit rate, %")
#: More bands than these hide each other; the tables have all intervals.
_BANDS: Final = ("hbr", "ahbr", "dense")


def figures(results: dict[str, Any]) -> dict[str, Chart]:
    """Return the figures that the results allow, by the name of their file."""
    drawn = {"hit-rate": hit_rate_figure(results), "travel": travel_figure(results)}
    methods = [m for m in results["methods"] if m["name"] in ("hbr", "ahbr", "dense")] or results["methods"][:2]
    drawn["pose"] = pose_figure(results, methods)
    for prefix, title, words in (
        ("omega-", "weight of the orientation, ω", "ω-sweep"),
        ("list-", "length of the retrieval lists", "list-sweep"),
    ):
        swept = [m for m in results["methods"] if m["name"].startswith(prefix)]
        if len(swept) > 1:
            drawn[words.replace("ω", "omega")] = _sweep_figure(results, swept, prefix, title)
    return drawn


def hit_rate_figure(results: dict[str, Any]) -> Chart:
    """Return the hit rate against the number of views, with 95 % Wilson intervals, and Best 10 of HBR (Fig. 6)."""
    series = []
    for m, method in enumerate(results["methods"]):
        colour, dashed = _style(method["name"], m)
        curve = method["curve"]
        drawn = _rates(method["label"], colour, dashed, [p["views"] for p in curve], curve)
        series.append(drawn if method["name"] in _BANDS or len(curve) == 1 else replace(drawn, low=(), high=()))
        if method["name"] == "hbr":
            best10 = [{**p, "hit_rate": p["best10_rate"]} for p in curve]
            for point in best10:
                point["hit_rate_low"], point["hit_rate_high"] = point["best10_low"], point["best10_high"]
            series.append(_rates("Best 10 of HBR", *_BEST_10, [p["views"] for p in curve], best10))
    last = max(p["views"] for method in results["methods"] for p in method["curve"])
    views = Axis("views of the object, N", ticks=tuple(range(1, last + 1)))
    return Chart(_title(results), views, _HIT_RATE, tuple(series), wide=True)


def travel_figure(results: dict[str, Any]) -> Chart:
    """Return the figure of the hit rate against the mean rotation."""
    series = []
    for m, method in enumerate(results["methods"]):
        if method["name"] in ("single", "hbr-visual", "hbr-0", "hbr-0-orient"):
            continue  # the same rotations as HBR
        colour, dashed = _style(method["name"], m)
        travelled = [p["travelled_mean_deg"] for p in method["curve"]]
        drawn = _rates(method["label"], colour, dashed, travelled, method["curve"])
        series.append(drawn if method["name"] in _BANDS else replace(drawn, low=(), high=()))
    farthest = max((x for s in series for x in s.x), default=0.0)
    ticks = tuple(90.0 * i for i in range(max(2, ceil(farthest / 90) + 1)))
    return Chart(_title(results), Axis("mean rotation, °", ticks=ticks), _HIT_RATE, tuple(series), wide=True)


def pose_figure(results: dict[str, Any], methods: Sequence[dict[str, Any]]) -> Chart:
    """Return the RMSE of each object's estimated orientation after all views, sorted by size (Fig. 5 of the paper).

    Dashed: the plain error. Solid: the error to the nearest orientation from which the object looks the same.
    """
    series = []
    for m, method in enumerate(methods):
        colour, _ = _style(method["name"], m)
        for key, dashed, words in (
            ("pose_rmse_deg_by_object", True, "plain"),
            ("alike_rmse_deg_by_object", False, "similar"),
        ):
            errors = sorted(error for error in method[key] if error is not None)
            places = range(1, len(errors) + 1)
            label = f"{method['label']}, {words}"
            series.append(Series(label, places, errors, colour, dots=len(errors) == 1, curve=True, dashed=dashed))
    objects = Axis("objects, each curve sorted by its error", whole=True, span=(1.0,))
    return Chart(_title(results), objects, Axis("RMSE of the orientation, °", span=(0.0,)), tuple(series), wide=True)


def _sweep_figure(results: dict[str, Any], methods: Sequence[dict[str, Any]], prefix: str, x_label: str) -> Chart:
    """Return the hit rate against a setting for several numbers of views; the setting's values have equal distances."""
    values = [method["name"].removeprefix(prefix) for method in methods]
    series = []
    for i, n in enumerate(range(2, len(methods[0]["curve"]) + 1, 2)):
        points = [method["curve"][n - 1] for method in methods]
        series.append(_rates(f"N = {n}", _OTHERS[i % len(_OTHERS)], False, range(len(points)), points))
    axis = Axis(x_label, ticks=tuple(range(len(values))), names=tuple(values))
    return Chart(_title(results), axis, _HIT_RATE, tuple(series), wide=True)


def _rates(label: str, colour: str, dashed: bool, x: Sequence[float], points: Sequence[dict[str, Any]]) -> Series:
    rate, low, high = ([100 * p[key] for p in points] for key in ("hit_rate", "hit_rate_low", "hit_rate_high"))
    return Series(label, x, rate, colour, curve=True, dashed=dashed, low=low, high=high)


def _style(name: str, position: int) -> tuple[str, bool]:
    return _STYLES.get(name, (_OTHERS[position % len(_OTHERS)], False))


def _title(results: dict[str, Any]) -> str:
    settings = results["settings"]
    dataset, condition, protocol = settings["dataset"], settings["condition"], settings["protocol"]
    size = condition["size_px"] or max(dataset["width_px"], dataset["height_px"])
    words = [
        f"{dataset['name']}, {len(dataset['objects'])} objects, noise {condition['noise']} at {size} px",
        f"{protocol['trials']} trials an object",
    ]
    if results["reported"]:
        words.append("objects {} to {}".format(*results["reported"]))
    if condition["background"] != "same":
        words.append(f"{condition['background']} background")
    if condition["rotation_deg"]:
        words.append(f"rotated by up to {condition['rotation_deg']:g}°")
    if condition["perturbations"] != "none":
        kinds = condition["perturbations"].split("+")
        words.append("+".join(kinds) if len(kinds) <= 2 else f"{len(kinds)} perturbations")
    if protocol["enrolled"]:
        words.append(f"{protocol['enrolled']} views enrolled")
    if condition["descriptor"] != "cedd":
        words.append(condition["descriptor"])
    if condition["prefilter_px"]:
        words.append(f"prefilter {condition['prefilter_px']:g} px")
    return "; ".join(words)
