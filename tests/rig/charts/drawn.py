"""The elements of a chart, for the tests that check its geometry."""

from xml.etree import ElementTree as ET

HOSTILE = "<script>alert(1)</script>&\"'"


def having(svg: str, *classes: str) -> list[ET.Element]:
    """Return the elements that have all the classes, in the order of drawing."""
    return [e for e in ET.fromstring(svg).iter() if set(classes) <= set(e.get("class", "").split())]


def points(path: ET.Element) -> list[tuple[float, float]]:
    pairs = path.get("d", "").strip("MZ").split("L")
    return [(float(x), float(y)) for x, y in (p.split() for p in pairs)]


def centre(e: ET.Element) -> tuple[float, float]:
    return float(e.get("cx", "nan")), float(e.get("cy", "nan"))


def words(elements: list[ET.Element]) -> list[str]:
    return ["".join(e.itertext()) for e in elements]


def check_text(svg: str) -> None:
    """Fail if a text of a chart is outside of it."""
    root = ET.fromstring(svg)
    _, _, width, height = map(float, root.get("viewBox", "").split())
    for e in (e for e in root.iter() if e.get("text-anchor")):
        drawn = 6.4 * len("".join(e.itertext()))  # about, at 12 units
        x, anchor = float(e.get("x", "")), e.get("text-anchor")
        assert x - (drawn / 2 if anchor == "middle" else drawn if anchor == "end" else 0) >= -2
        assert x + (drawn / 2 if anchor == "middle" else drawn if anchor == "start" else 0) <= width + 10
        assert float(e.get("y", "")) <= height
