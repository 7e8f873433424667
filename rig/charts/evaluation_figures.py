"""The figures of the paper, drawn from results: hit-rate against views (Fig. 6) and pose error by object (Fig. 5)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil, floor
from typing import Any, Final

from rig.charts.drawing import Area, Dot, Figure, Line, Text
from rig.charts.svg import Point

_WIDTH: Final = 860
_HEIGHT: Final = 440
_LEFT, _TOP, _RIGHT, _BOTTOM = 62.0, 46.0, 640.0, 384.0
_INK, _SOFT, _GRID = "#1d2126", "#5b636d", "#e4e7ea"
_LEGEND_LINE: Final = 19.0

#: One colour a method wherever it is drawn (Okabe and Ito's palette, for all kinds of colour vision).
_LOOKS: Final = {
    "single": ("#8a8f96", True),
    "hbr-visual": ("#56b4e9", False),
    "hbr-0": ("#009e73", False),
    "hbr-0-orient": ("#009e73", True),
    "hbr": ("#0072b2", False),
    "hbr-orient": ("#0072b2", True),
    "ahbr": ("#d55e00", False),
    "ahbr-orient": ("#d55e00", True),
    "ahbr-90": ("#8c2d04", False),
    "coin": ("#cc79a7", False),
    "sweep-45": ("#1d2126", False),
    "sweep-90": ("#1d2126", True),
    "dense": ("#6a3d9a", False),
    "dense-coin": ("#cc79a7", False),
    "dense-random": ("#0072b2", False),
    "dense-45": ("#1d2126", False),
    "dense-90": ("#1d2126", True),
    "dense-mutual": ("#009e73", False),
    "dense-oracle": ("#b08900", True),
}
_OTHERS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#1d2126", "#8a8f96", "#b08900")
_BEST_10: Final = ("#b08900", False)
#: More bands than these hide each other; the tables have all intervals.
_BANDS: Final = ("hbr", "ahbr", "dense")


@dataclass(frozen=True)
class _Series:
    label: str
    colour: str
    dashed: bool
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] = ()
    high: Sequence[float] = ()


def figures(results: dict[str, Any]) -> dict[str, Figure]:
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


def hit_rate_figure(results: dict[str, Any]) -> Figure:
    """Hit-rate against the number of views, with 95 % Wilson intervals, and Best 10 of HBR (Fig. 6 of the paper)."""
    series = []
    for m, method in enumerate(results["methods"]):
        colour, dashed = _look(method["name"], m)
        curve = method["curve"]
        drawn = _rates(method["label"], colour, dashed, [p["views"] for p in curve], curve)
        series.append(drawn if method["name"] in _BANDS or len(curve) == 1 else replace(drawn, low=(), high=()))
        if method["name"] == "hbr":
            best10 = [{**p, "hit_rate": p["best10_rate"]} for p in curve]
            for point in best10:
                point["hit_rate_low"], point["hit_rate_high"] = point["best10_low"], point["best10_high"]
            series.append(_rates("Best 10 of HBR", *_BEST_10, [p["views"] for p in curve], best10))
    last = max(p["views"] for method in results["methods"] for p in method["curve"])
    return _chart(_title(results), "hit-rate, %", "views of the object, N", series, list(range(1, last + 1)))


def travel_figure(results: dict[str, Any]) -> Figure:
    """Hit-rate against the mean of the degrees turned: what the views cost."""
    series = []
    for m, method in enumerate(results["methods"]):
        if method["name"] in ("single", "hbr-visual", "hbr-0", "hbr-0-orient"):
            continue  # they turn as HBR does
        colour, dashed = _look(method["name"], m)
        travelled = [p["travelled_mean_deg"] for p in method["curve"]]
        drawn = _rates(method["label"], colour, dashed, travelled, method["curve"])
        series.append(drawn if method["name"] in _BANDS else replace(drawn, low=(), high=()))
    farthest = max((x for s in series for x in s.x), default=0.0)
    ticks = [90 * i for i in range(max(2, ceil(farthest / 90) + 1))]
    return _chart(_title(results), "hit-rate, %", "degrees turned, mean", series, ticks)


def pose_figure(results: dict[str, Any], methods: Sequence[dict[str, Any]]) -> Figure:
    """RMSE of the estimated orientation of each object after all views (Fig. 5 of the paper), sorted by size.

    Once as it is (dashed), once to the nearest orientation from which the object looks the same (solid).
    """
    series = []
    for m, method in enumerate(methods):
        colour, _ = _look(method["name"], m)
        for key, dashed, words in (
            ("pose_rmse_deg_by_object", True, "plain"),
            ("alike_rmse_deg_by_object", False, "alike"),
        ):
            errors = sorted(error for error in method[key] if error is not None)
            series.append(_Series(f"{method['label']}, {words}", colour, dashed, range(1, len(errors) + 1), errors))
    count = max(len(method["pose_rmse_deg_by_object"]) for method in methods)
    step = max(1, ceil(count / 10))
    ticks = [1, *range(step, count + 1, step)] if step > 1 else list(range(1, count + 1))
    return _chart(
        _title(results),
        "RMSE of the orientation, degrees",
        "objects, each curve sorted by its error",
        series,
        ticks,
        dots=False,
    )


def _sweep_figure(results: dict[str, Any], methods: Sequence[dict[str, Any]], prefix: str, x_label: str) -> Figure:
    """Hit-rate against a setting, for some numbers of views; the setting's values stand at equal distances."""
    values = [method["name"].removeprefix(prefix) for method in methods]
    series = []
    for i, n in enumerate(range(2, len(methods[0]["curve"]) + 1, 2)):
        points = [method["curve"][n - 1] for method in methods]
        series.append(_rates(f"N = {n}", _OTHERS[i % len(_OTHERS)], False, range(len(points)), points))
    return _chart(_title(results), "hit-rate, %", x_label, series, list(range(len(values))), names=values)


def _rates(label: str, colour: str, dashed: bool, x: Sequence[float], points: Sequence[dict[str, Any]]) -> _Series:
    rate, low, high = ([100 * p[key] for p in points] for key in ("hit_rate", "hit_rate_low", "hit_rate_high"))
    return _Series(label, colour, dashed, x, rate, low, high)


def _look(name: str, position: int) -> tuple[str, bool]:
    return _LOOKS.get(name, (_OTHERS[position % len(_OTHERS)], False))


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
        words.append(f"turned by up to {condition['rotation_deg']:g}°")
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


def _chart(
    title: str,
    y_label: str,
    x_label: str,
    series: Sequence[_Series],
    x_ticks: Sequence[float],
    *,
    names: Sequence[str] | None = None,
    dots: bool = True,
) -> Figure:
    y_ticks = _ticks([v for s in series for v in (*s.y, *s.low, *s.high)])
    at = _scale(x_ticks[0], x_ticks[-1], y_ticks[0], y_ticks[-1])
    shapes: list[Line | Dot | Area | Text] = [
        Text(title, (_LEFT, 20), _INK, size=13, bold=True),
        Text(y_label, (8, 38), _SOFT, size=11),
        Text(x_label, ((_LEFT + _RIGHT) / 2, _BOTTOM + 40), _SOFT, "middle", 11),
    ]
    for tick in y_ticks:
        y = at(x_ticks[0], tick)[1]
        shapes.append(Line([(_LEFT, y), (_RIGHT, y)], _GRID))
        shapes.append(Text(f"{tick:g}", (_LEFT - 8, y + 4), _SOFT, "end", 11))
    for tick, name in zip(x_ticks, names or [f"{tick:g}" for tick in x_ticks], strict=True):
        shapes.append(Text(name, (at(tick, y_ticks[0])[0], _BOTTOM + 18), _SOFT, "middle", 11))
    for s in series:
        lows = [at(x, y) for x, y in zip(s.x, s.low, strict=False)]
        highs = [at(x, y) for x, y in zip(s.x, s.high, strict=False)]
        if len(lows) > 1:
            shapes.append(Area([*lows, *reversed(highs)], s.colour, 0.08))
        elif lows:
            shapes.append(Line([lows[0], highs[0]], s.colour))
    for s in series:
        points = [at(x, y) for x, y in zip(s.x, s.y, strict=True)]
        if len(points) > 1:
            shapes.append(Line(points, s.colour, 1.8, s.dashed))
        if dots or len(points) == 1:
            for point, x, y in zip(points, s.x, s.y, strict=True):
                shapes.append(Dot(point, 2.8, s.colour, f"{s.label}, {x:g}: {y:.1f}"))
    for row, s in enumerate(series):
        y = _TOP + 6 + _LEGEND_LINE * row
        shapes.append(Line([(_RIGHT + 18, y), (_RIGHT + 44, y)], s.colour, 2.0, s.dashed))
        shapes.append(Text(s.label, (_RIGHT + 50, y + 4), _INK, size=11.5))
    finals = ", ".join(f"{s.label} {s.y[-1]:.1f}" for s in series if s.y)
    return Figure(_WIDTH, _HEIGHT, f"{title}. {y_label} against {x_label}; at the end of each line: {finals}", shapes)


def _scale(x_low: float, x_high: float, y_low: float, y_high: float) -> Callable[[float, float], Point]:
    inner = 10.0
    width, height = _RIGHT - _LEFT - 2 * inner, _BOTTOM - _TOP
    span = (x_high - x_low) or 1.0

    def at(x: float, y: float) -> Point:
        return _LEFT + inner + width * (x - x_low) / span, _BOTTOM - height * (y - y_low) / (y_high - y_low)

    return at


def _ticks(values: Sequence[float]) -> list[float]:
    """Four to nine round numbers that span the values."""
    low, high = min(values, default=0.0), max(values, default=1.0)
    for step in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0):
        first, last = floor(low / step + 1e-9), ceil(high / step - 1e-9)
        if last - first <= 8:
            break
    return [step * i for i in range(first, max(last, first + 2) + 1)]
