"""Draw the cost of a search over the size of the catalog, from ``bench.json``, as docs/results/search-cost.svg.

python -m benchmarks.bench_scale --objects 100 300 1000 3000 10000 && python -m benchmarks.plot_scale
"""

import json
from pathlib import Path

from benchmarks.record import PATH
from rig.charts.xy import INK, LIMIT, MEASURED, MODEL, OTHER, Axis, Chart, Series

SERIES = {
    "reading": ("reading the packed views", INK),
    "belief after the first view": ("first view", MEASURED),
    "later step with decision and next view": ("later view", OTHER),
    "last check of the objects left out, two views": ("last check", MODEL),
    "preparing the index": ("opening the index", LIMIT),
}
TARGET = Path("docs/results/search-cost.svg")


def main() -> None:
    points: dict[str, list[tuple[float, float]]] = {name: [] for name in SERIES}
    for name, values in json.loads(PATH.read_text(encoding="utf-8")).items():
        size, _, what = name.partition(" views: ")
        if what in points:
            points[what].append((float(size.replace(",", "")), values["ms"]))
    series = [
        Series(label, *zip(*sorted(points[name]), strict=True), colour=colour, curve=True)  # type: ignore[arg-type]
        for name, (label, colour) in SERIES.items()
        if points[name]
    ]
    chart = Chart("Cost of a search", Axis("enrolled views", log=True), Axis("ms", log=True), series)
    TARGET.write_text(chart.svg(), encoding="utf-8")
    print(TARGET)


if __name__ == "__main__":
    main()
