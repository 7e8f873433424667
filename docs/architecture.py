"""Draw the architecture as SVG: the rooms in the layers of the import contract, and the imports between them.

    python docs/architecture.py > architecture.svg

Layers come from `pyproject.toml`, imports from the code, captions from the docstring of each room. An arrow that
follows from other arrows is left out.
"""

import ast
import re
import tomllib
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from textwrap import wrap

import grimp

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hbr", "rig", "sim", "calibration")

BOX_HEIGHT, ROW_GAP, BOX_GAP, PADDING = 56, 26, 14, 18
RIG_WIDTH, HBR_WIDTH, PANEL_GAP, MARGIN = 640, 330, 110, 70
FONT = "font-family='system-ui, sans-serif'"


@dataclass
class Box:
    """A room in the picture; ``x``, ``y`` is its upper left corner, in px."""

    name: str
    x: float
    y: float
    width: float

    @property
    def middle(self) -> float:
        return self.x + self.width / 2

    @property
    def bottom(self) -> float:
        return self.y + BOX_HEIGHT


@dataclass
class Panel:
    """The layers of one package, drawn from top to bottom."""

    package: str
    x: float
    y: float
    width: float
    rows: list[list[Box]] = field(default_factory=list)

    @property
    def height(self) -> float:
        return 2 * PADDING + 14 + len(self.rows) * (BOX_HEIGHT + ROW_GAP) - ROW_GAP


def layers(package: str) -> list[list[str]]:
    """Return the rooms of a package from the top layer to the bottom one, as the import contract names them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (contract,) = (c for c in contracts if c.get("containers") == [package])
    return [[f"{package}.{room.strip()}" for room in layer.split("|")] for layer in contract["layers"]]


def room_of(module: str) -> str:
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] in ("hbr", "rig") and len(parts) > 1 else parts[0]


def imports() -> set[tuple[str, str]]:
    """Return which room imports which: pairs (importing, imported), without those that follow from other pairs.

    The package `hbr` itself is a room, too: it holds the public names of the rooms behind it.
    """
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    direct: dict[str, set[str]] = {}
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            direct.setdefault(room_of(module), set()).add(room_of(imported))
    del direct["rig"]  # its public names are imported by programs, and by no room
    for room, used in direct.items():
        used -= {room, "rig"}

    def reached(room: str) -> set[str]:
        found: set[str] = set()
        waiting = [room]
        while waiting:
            new = direct.get(waiting.pop(), set()) - found
            found |= new
            waiting += new
        return found

    rooms = direct.items()
    return {(a, b) for a, used in rooms if a != "hbr" for b in used if not any(b in reached(c) for c in used - {b})}


def caption(room: str) -> str:
    """Return the first sentence of a room's docstring."""
    source = ROOT / Path(*room.split(".")) / "__init__.py"
    text = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
    return re.split(r"[.;]\s|[.;]$", " ".join(text.partition("\n\n")[0].split()))[0].replace("`", "")


def placed(package: str, x: float, y: float, width: float) -> Panel:
    panel = Panel(package, x, y, width)
    top = y + PADDING + 14
    for rooms in layers(package):
        box_width = (width - 2 * PADDING - (len(rooms) - 1) * BOX_GAP) / len(rooms)
        left = x + PADDING
        panel.rows.append([Box(room, left + i * (box_width + BOX_GAP), top, box_width) for i, room in enumerate(rooms)])
        top += BOX_HEIGHT + ROW_GAP
    return panel


def picture() -> str:
    """Return the picture as SVG."""
    width = 2 * MARGIN + RIG_WIDTH + PANEL_GAP + HBR_WIDTH
    above = [Box("calibration", MARGIN + PADDING, 16, 295), Box("sim", MARGIN + RIG_WIDTH - PADDING - 295, 16, 295)]
    rig = placed("rig", MARGIN, above[0].bottom + 34, RIG_WIDTH)
    hbr = placed("hbr", MARGIN + RIG_WIDTH + PANEL_GAP, 0, HBR_WIDTH)
    hbr = placed("hbr", hbr.x, rig.y + (rig.height - hbr.height) / 2, HBR_WIDTH)
    boxes = {box.name: box for panel in (rig, hbr) for row in panel.rows for box in row} | {b.name: b for b in above}
    boxes["hbr"] = Box("hbr", hbr.x, hbr.y - BOX_HEIGHT / 2 + 17, HBR_WIDTH)
    arrows = sorted(imports(), key=lambda pair: (boxes[pair[0]].y, pair))

    parts = [
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {rig.y + rig.height + 16:g}' {FONT} "
        "role='img' aria-labelledby='title'>",
        "<title id='title'>Rooms of the packages calibration, sim, rig and hbr, and the imports between them</title>",
        "<defs><marker id='head' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='6' markerHeight='6' orient='auto'>"
        "<path d='M0 0 L8 4 L0 8 z' fill='#64748b'/></marker></defs>",
        f"<rect width='{width}' height='{rig.y + rig.height + 16:g}' rx='8' fill='#ffffff'/>",
    ]
    for panel, fill in ((rig, "#eef2ff"), (hbr, "#ecfdf5")):
        parts.append(
            f"<rect x='{panel.x:g}' y='{panel.y:g}' width='{panel.width}' height='{panel.height:g}' rx='10' "
            f"fill='{fill}'/><text x='{panel.x + PADDING:g}' y='{panel.y + 21:g}' font-size='13' font-weight='700' "
            f"fill='#334155'>{panel.package}</text>"
        )
    lanes: dict[str, list[float]] = {"left": [], "right": []}
    for importing, imported in arrows:
        path = _arrow(boxes[importing], boxes[imported], rig, lanes)
        parts.append(f"<path d='{path}' fill='none' stroke='#64748b' stroke-width='1.3' marker-end='url(#head)'/>")
    del boxes["hbr"]
    parts += [_drawn(box) for box in boxes.values()]
    return "\n".join([*parts, "</svg>\n"])


def _arrow(start: Box, end: Box, rig: Panel, lanes: dict[str, list[float]]) -> str:
    """Return the path of an arrow; ``lanes`` holds how far down each lane beside the panel is used, on either side."""
    if start.name.startswith("rig.") and end.name.startswith("hbr"):  # from panel to panel
        x1, y1, x2, y2 = start.x + start.width, start.y + BOX_HEIGHT / 2, end.x, end.y + BOX_HEIGHT / 2
        return f"M{x1:g} {y1:g} C{x1 + 70:g} {y1:g} {x2 - 70:g} {y2:g} {x2:g} {y2:g}"
    if end.y - start.y <= 1.5 * (BOX_HEIGHT + ROW_GAP) + 10:  # to the next layer
        x1, x2 = _nearest(start, end)
        y1, y2 = start.bottom, end.y
        return f"M{x1:g} {y1:g} C{x1:g} {y1 + 14:g} {x2:g} {y2 - 14:g} {x2:g} {y2:g}"
    # Past other layers, in a lane of its own: on the right if the left edge is not free for one of the two boxes.
    left, right = rig.x + PADDING, rig.x + rig.width - PADDING
    at_right = end.x + end.width == right and (end.x > left or start.x > left)
    side, sign, near = ("right", 1, right) if at_right else ("left", -1, left)
    start_x, end_x = (box.x + (box.width if at_right else 0) for box in (start, end))
    y1, y2 = start.y + BOX_HEIGHT * 0.7, end.y + BOX_HEIGHT * 0.3
    used = lanes[side]
    lane = next((i for i, lowest in enumerate(used) if lowest < y1), len(used))
    used[lane : lane + 1] = [y2]
    y2 += 6 * (lane % 4)
    out = near + sign * (PADDING + 8 + 8 * lane)
    if start_x == near:
        return f"M{start_x:g} {y1:g} L{out:g} {y1:g} L{out:g} {y2:g} L{end_x:g} {y2:g}"
    x1, y1 = start.middle - 20, start.bottom + ROW_GAP / 2  # a box in the middle: through the gap below it
    return f"M{x1:g} {start.bottom:g} L{x1:g} {y1:g} L{out:g} {y1:g} L{out:g} {y2:g} L{end_x:g} {y2:g}"


def _nearest(start: Box, end: Box) -> tuple[float, float]:
    """Return where an arrow leaves a box and reaches the next: as steep as the widths of both allow."""
    low, high = max(start.x, end.x) + 20, min(start.x + start.width, end.x + end.width) - 20
    if low <= high:
        return (low + high) / 2, (low + high) / 2
    return (start.x + start.width - 20, end.x + 20) if start.x < end.x else (start.x + 20, end.x + end.width - 20)


def _drawn(box: Box) -> str:
    columns = round(box.width / 5.9)
    lines = wrap(caption(box.name), columns)
    if len(lines) > 2:
        lines = wrap(re.split("[:,;]", caption(box.name))[0], columns)[:2]
    texts = "".join(
        f"<text x='{box.middle:g}' y='{box.y + 34 + 13 * i:g}' font-size='10.5' fill='#475569' "
        f"text-anchor='middle'>{escape(line)}</text>"
        for i, line in enumerate(lines)
    )
    return (
        f"<rect x='{box.x:g}' y='{box.y:g}' width='{box.width:g}' height='{BOX_HEIGHT}' rx='6' fill='#ffffff' "
        f"stroke='#94a3b8'/><text x='{box.middle:g}' y='{box.y + 18:g}' font-size='13' font-weight='600' "
        f"fill='#0f172a' text-anchor='middle'>{box.name.rpartition('.')[2]}</text>{texts}"
    )


if __name__ == "__main__":
    print(picture())
