"""Draw the pictures of docs/how-to/build-the-table.md.

From the checkout, after `make hardware`: .venv/bin/python -m docs.hardware.pictures
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from build123d import Box, Pos

from docs.hardware import wiring
from docs.hardware.assembly import Item, cable, frame, table
from docs.hardware.draw import Picture

IMAGES = Path(__file__).parents[1] / "images"
EXPLODED = {
    "foot": (40, 1120),
    "base": (40, 980),
    "servo": (40, 800),
    "servo plate": (40, 735),
    "deck": (40, 610),
    "cable": (740, 560),
    "axial bearing": (40, 520),
    "hub": (40, 440),
    "cable clip": (720, 400),
    "IMU cover": (40, 390),
    "IMU": (40, 345),
    "platter": (40, 240),
    "stand of the home card": (40, 170),
    "home card": (40, 90),
}


def names(items: Sequence[Item], *wanted: str) -> list[Item]:
    return [item for item in items if item.name in wanted]


def bench() -> Picture:
    items = [*table(), *frame()]
    picture = Picture([(item, item.solid) for item in items], (1200, 820), 52, 24)
    places = {"post": (60, 330), "camera": (300, 250), "rail": (260, 640), "base": (560, 700), "platter": (430, 430)}
    for name, at in {**places, "home card": (480, 240), "backdrop": (1010, 150), "bar": (1040, 700)}.items():
        (item,) = names(items, name)
        picture.label(name, item.solid.center(), at)
    return picture


def exploded() -> Picture:
    items = [*table(), cable()]
    apart = [(item, Pos(*item.apart) * item.solid) for item in items]
    picture = Picture(apart, (920, 1200), 25, 22)
    labelled = set()
    for item, solid in apart:
        if item.name in labelled or (item.name == "cable clip" and not item.rotates):
            continue
        labelled.add(item.name)
        box = solid.bounding_box()
        edge = box.min.X if EXPLODED[item.name][0] < 400 else box.max.X
        middle = solid.center()
        round_part = item.name in ("base", "deck", "platter", "axial bearing", "cable", "hub")
        point = (edge, middle.Y, middle.Z) if round_part else middle
        picture.label(item.name, tuple(point), EXPLODED[item.name])
    return picture


def section() -> Picture:
    """The table cut along its axis, seen from the right."""
    items = [item for item in table() if item.name not in ("foot", "stand of the home card", "home card")]
    cut = [(item, item.solid - Pos(250, 0, 0) * Box(500, 500, 500)) for item in [*items, cable()]]
    picture = Picture([(item, solid) for item, solid in cut if solid.solids()], (1100, 460), 90, 12)
    places = {
        "platter": (0, -80, 91, 60, 40),
        "axial bearing": (0, -22, 82, 150, 90),
        "deck": (0, -70, 75, 30, 210),
        "hub": (0, 14, 80, 640, 40),
        "servo plate": (0, -28, 63.5, 30, 330),
        "servo": (0, 5, 40, 640, 440),
        "base": (0, 97, 45, 960, 300),
        "cable in the drum": (0, 62, 81, 820, 60),
    }
    for name, (*point, x, y) in places.items():
        picture.label(name, point, (x, y))
    return picture


def steps() -> list[Picture]:
    """Return a picture of each step of the assembly; the new parts have colours."""
    bottom, rest = table(), frame()
    rail, base = names(rest, "rail", "bar"), names(bottom, "base", "foot")
    servo = names(bottom, "servo", "servo plate")
    deck = [item for item in bottom if item.name == "deck" or (item.name == "cable clip" and not item.rotates)]
    bearing, hub = names(bottom, "axial bearing"), names(bottom, "hub")
    platter = names(bottom, "platter", "IMU cover", "IMU") + [
        item for item in bottom if item.name == "cable clip" and item.rotates
    ]
    card = names(bottom, "home card", "stand of the home card")
    rest_of_rail = [item for item in rest if item.name == "corner"] + rail
    post = names(rest, "post", "camera clamp", "camera plate", "camera")
    views: list[tuple[list[Item], list[Item], float, float]] = [
        ([], servo, 30, 30),
        (servo, deck, 30, -30),
        ([*servo, *deck], [*hub, *bearing, cable()], 30, 32),
        ([], platter, 30, -35),
        ([*servo, *deck, *hub, *bearing], platter, 30, 25),
        ([], [*base, *rest_of_rail], 40, 30),
        ([*base, *rest_of_rail, *deck, *servo], [*platter, *card], 40, 30),
        ([*base, *rest_of_rail, *deck, *platter, *card], [*post, *names(rest, "backdrop", "backdrop clip")], 40, 25),
    ]
    return [
        Picture(
            [(replace(item, colour="#dfe3e8"), item.solid) for item in old] + [(i, i.solid) for i in new],
            (640, 440),
            a,
            e,
            25,
        )
        for old, new, a, e in views
    ]


def main() -> None:
    (IMAGES / "wiring.svg").write_text(wiring.picture(), encoding="utf-8")
    for name, picture in {"bench": bench(), "exploded": exploded(), "section": section()}.items():
        picture.write(str(IMAGES / f"table-{name}.png"))
    for number, picture in enumerate(steps(), 1):
        picture.write(str(IMAGES / f"table-step-{number}.png"))


if __name__ == "__main__":
    main()
