"""Built-in objects: toys and apparatus made of boxes, horizontal cylinders, roofs and bodies of revolution."""

from math import cos, pi, sin

from sim.objects import paint as p
from sim.objects.curves import smooth
from sim.objects.paint import Brush, Sheet, painted, wood
from sim.objects.polyhedron import Polyhedron, box, lying_cylinder, quad, roof
from sim.objects.projection import Colour, Paint
from sim.objects.revolution import Revolution
from sim.objects.solid import Solid
from sim.objects.tube import Tube, ray


def _house(name: str, *door: Brush) -> Solid:
    def windows(s: Sheet) -> None:
        for u in (0.25, 0.75):
            s.panel(u - 0.11, 0.2, u + 0.11, 0.5, p.WHITE)
            s.panel(u - 0.09, 0.23, u + 0.09, 0.47, p.NAVY)
            s.panel(u - 0.01, 0.2, u + 0.01, 0.5, p.WHITE)

    def entrance(s: Sheet) -> None:
        s.panel(0.4, 0.48, 0.6, 1.0, p.BROWN)
        s.disc(0.56, 0.76, 0.025, p.YELLOW)

    def tiles(s: Sheet) -> None:
        for i in range(6):
            s.band(i / 6, i / 6 + 0.03, (30, 26, 120))
        s.mottle(12.0, (0.06, 0.16), 61)

    front = painted(p.CREAM, windows, entrance, *door)
    gable = painted(p.CREAM, lambda s: s.disc(0.5, 0.4, 0.18, p.NAVY))
    body = box((112, 84, 78), (front, gable, painted(p.CREAM, windows), gable), top=p.CREAM)
    return Solid(
        name,
        (body, roof((128, 102, 54), slope=painted(p.RED, tiles), gable=p.CREAM, at=(0, 0, 78)), _chimney()),
    )


def _chimney() -> Polyhedron:
    """Return a chimney on the back slope of the roof, its foot cut along the slope."""
    left, right, inner, outer, top = 22.0, 38.0, 14.0, 30.0, 134.0
    high, low = (132 - 54 * y / 51 for y in (inner, outer))
    faces = (
        quad([(right, outer, top), (right, outer, low), (left, outer, low), (left, outer, top)], p.TERRACOTTA),
        quad([(left, inner, top), (left, inner, high), (right, inner, high), (right, inner, top)], p.TERRACOTTA),
        quad([(right, inner, top), (right, inner, high), (right, outer, low), (right, outer, top)], p.TERRACOTTA),
        quad([(left, outer, top), (left, outer, low), (left, inner, high), (left, inner, top)], p.TERRACOTTA),
        quad([(left, outer, top), (left, inner, top), (right, inner, top), (right, outer, top)], p.GREY),
    )
    return Polyhedron(faces, layer=1, depth_at=(0.0, 22.0))


def _wreath(s: Sheet) -> None:
    s.panel(0.4, 0.48, 0.6, 1.0, p.GREEN)
    s.disc(0.5, 0.64, 0.07, p.YELLOW)


def _blocks() -> Solid:
    def face(letter: str, ink: Colour) -> Paint:
        def brush(s: Sheet) -> None:
            s.panel(0.07, 0.07, 0.93, 0.93, ink)
            s.panel(0.13, 0.13, 0.87, 0.87, p.CREAM)
            s.text(letter, 0.5, 0.5, 0.42, ink, width=0.6)

        return painted(p.WOOD, wood(71), brush)

    def block(
        size: float, letters: str, ink: Colour, at: tuple[float, float, float], rotated: float, layer: int
    ) -> Polyhedron:
        front, right, back, left, top = (face(letter, ink) for letter in letters)
        return box((size, size, size), (front, right, back, left), top=top, at=at, rotation_deg=rotated, layer=layer)

    return Solid(
        "toy-blocks",
        (
            block(50, "ABCDE", p.RED, (-30, 8, 0), 8, 0),
            block(50, "FGHIJ", p.BLUE, (29, -6, 0), -14, 0),
            block(50, "KLMNO", p.GREEN, (-2, 0, 50), 30, 1),
            block(50, "PQRST", p.PURPLE, (0, 2, 100), 62, 2),
        ),
    )


def _car() -> Solid:
    def flank(s: Sheet) -> None:
        s.panel(0.0, 0.5, 1.0, 0.6, p.WHITE)
        s.disc(0.5, 0.45, 0.36, p.WHITE)
        s.text("7", 0.5, 0.45, 0.42, p.RED, width=0.2)

    def glass(s: Sheet) -> None:
        s.panel(0.08, 0.15, 0.46, 0.9, (200, 170, 130))
        s.panel(0.54, 0.15, 0.92, 0.9, (200, 170, 130))

    def nose(s: Sheet) -> None:
        s.disc(0.18, 0.5, 0.2, p.YELLOW)
        s.disc(0.82, 0.5, 0.2, p.YELLOW)
        s.panel(0.35, 0.4, 0.65, 0.7, p.BLACK)

    def tail(s: Sheet) -> None:
        s.panel(0.05, 0.3, 0.25, 0.6, p.ORANGE)
        s.panel(0.75, 0.3, 0.95, 0.6, p.ORANGE)
        s.panel(0.35, 0.4, 0.65, 0.75, p.YELLOW)

    side = painted(p.BLUE, flank)
    cabin = painted(p.BLUE, glass)
    shield = painted(p.BLUE, lambda s: s.panel(0.12, 0.15, 0.88, 0.9, (200, 170, 130)))
    hub = painted(p.BLACK, lambda s: s.disc(0.5, 0.5, 0.28, p.GREY), lambda s: s.disc(0.5, 0.5, 0.1, p.BLACK))
    body = box((150, 62, 30), (side, painted(p.BLUE, nose), side, painted(p.BLUE, tail)), top=p.BLUE, at=(0, 0, 14))
    top = box((78, 54, 28), (cabin, shield, cabin, shield), top=p.WHITE, at=(-8, 0, 44), layer=2)
    wheels = [
        lying_cylinder(18, 10, wall=p.BLACK, end=hub, at=(x, y, 18), rotation_deg=rotated, depth_at=(0.1 * x, y))
        for x in (-46, 46)
        for y, rotated in ((-29, 0.0), (29, 180.0))
    ]
    return Solid("toy-car", (body, *wheels, top))


def _camera() -> Solid:
    def leather(s: Sheet) -> None:
        s.mottle(14.0, (0.012, 0.03), 81)

    def front(s: Sheet) -> None:
        leather(s)
        s.band(0.0, 0.24, p.GREY)
        s.panel(0.08, 0.06, 0.24, 0.18, p.WHITE)
        s.disc(0.86, 0.12, 0.06, p.RED)
        s.text("OPTA", 0.5, 0.12, 0.1, p.BLACK, width=0.2)

    def back(s: Sheet) -> None:
        leather(s)
        s.band(0.0, 0.24, p.GREY)
        s.panel(0.24, 0.34, 0.7, 0.88, p.NAVY)
        s.panel(0.27, 0.38, 0.67, 0.84, p.TEAL)
        s.disc(0.85, 0.6, 0.12, p.GREY)

    def lens(s: Sheet) -> None:
        s.disc(0.5, 0.5, 0.47, p.GREY)
        s.disc(0.5, 0.5, 0.38, p.BLACK)
        s.disc(0.5, 0.5, 0.27, p.NAVY)
        s.disc(0.5, 0.5, 0.16, (150, 70, 60))
        s.disc(0.44, 0.42, 0.06, p.WHITE)

    side = painted(p.BLACK, leather, lambda s: s.band(0.0, 0.24, p.GREY))
    body = box((132, 44, 86), (painted(p.BLACK, front), side, painted(p.BLACK, back), side), top=p.GREY)
    tube = lying_cylinder(32, 34, wall=p.BLACK, end=painted(p.BLACK, lens), at=(6, -22, 42), depth_at=(0, -39))
    knob = Revolution(((0.0, 96.0), (9.0, 96.0), (10.0, 86.0)), painted(p.RED), at=(44.0, 0.0), layer=1)
    dial = Revolution(
        ((0.0, 94.0), (12.0, 94.0), (13.0, 86.0)),
        painted(p.BLACK, lambda s: s.stripes(24, p.GREY)),
        at=(-42.0, 4.0),
        layer=1,
    )
    finder = box((34, 30, 14), (p.BLACK, p.GREY, p.BLACK, p.GREY), top=p.GREY, at=(6, 0, 86), layer=1)
    return Solid("camera", (body, tube, knob, finder, dial))


def _radio() -> Solid:
    def front(s: Sheet) -> None:
        s.mottle(6.0, (0.4, 0.03), 91)
        s.disc(0.29, 0.55, 0.34, p.BROWN)
        for i in range(6):
            s.disc(0.29, 0.55, 0.31 - 0.05 * i, p.CREAM if i % 2 else p.BROWN)
        s.panel(0.56, 0.18, 0.93, 0.42, p.CREAM)
        s.panel(0.58, 0.28, 0.91, 0.31, p.BLACK)
        s.panel(0.74, 0.2, 0.75, 0.4, p.RED)
        s.disc(0.65, 0.7, 0.13, p.BLACK)
        s.disc(0.85, 0.7, 0.13, p.BLACK)

    grain = painted(p.BROWN, wood(92))
    back = painted(
        p.BROWN,
        wood(93),
        lambda s: s.panel(0.2, 0.3, 0.8, 0.8, p.BLACK),
        lambda s: s.lines(0.25, 0.35, 0.75, 0.75, 7, p.GREY, 94),
    )
    body = box((150, 52, 92), (painted(p.TERRACOTTA, front), grain, back, grain), top=grain)
    handle = Tube(
        smooth((-58, 0, 90, 4), (-58, 0, 118, 4), (58, 0, 118, 4), (58, 0, 90, 4)), p.BLACK, joints=0, layer=1
    )
    return Solid("radio", (body, handle))


def _clock() -> Solid:
    def dial(s: Sheet) -> None:
        s.disc(0.5, 0.5, 0.5, p.RED)
        s.disc(0.5, 0.5, 0.42, p.WHITE)
        for i in range(12):
            s.polygon(_mark(i / 12, 0.31, 0.39, 0.012), p.BLACK)
        s.polygon(_mark(10 / 12, 0.0, 0.22, 0.02), p.BLACK)
        s.polygon(_mark(9 / 60, 0.0, 0.34, 0.013), p.BLACK)
        s.disc(0.5, 0.5, 0.03, p.RED)

    drum = lying_cylinder(52, 38, wall=p.RED, end=painted(p.RED, dial), at=(0, 19, 64))
    bells = [
        Revolution(smooth((0, 142), (14, 142), (22, 126), (22, 122)), painted(p.GREY), at=(x, 0.0), shine=0.9, layer=1)
        for x in (-30.0, 30.0)
    ]
    feet = [Tube(((x * 0.6, 0, 26, 5), (x, 0, 4, 5)), p.GREY, joints=0, layer=-1) for x in (-44.0, 44.0)]
    grip = Tube(smooth((-14, 0, 138, 3), (-14, 0, 156, 3), (14, 0, 156, 3), (14, 0, 138, 3)), p.GREY, joints=0, layer=2)
    return Solid("clock", (*feet, drum, *bells, grip))


def _mark(share: float, near: float, far: float, half: float) -> list[tuple[float, float]]:
    """Return a hand of a dial as a rectangle at ``share`` of a circle, clockwise from twelve."""
    c, s = cos(2 * pi * share), sin(2 * pi * share)
    corners = ((-half, near), (half, near), (half, far), (-half, far))
    return [(0.5 + x * c + y * s, 0.5 + x * s - y * c) for x, y in corners]


def _dice() -> Solid:
    spots = {
        1: ((0.5, 0.5),),
        2: ((0.28, 0.28), (0.72, 0.72)),
        3: ((0.25, 0.25), (0.5, 0.5), (0.75, 0.75)),
        4: ((0.28, 0.28), (0.72, 0.28), (0.28, 0.72), (0.72, 0.72)),
        5: ((0.26, 0.26), (0.74, 0.26), (0.5, 0.5), (0.26, 0.74), (0.74, 0.74)),
    }

    def face(n: int) -> Paint:
        def brush(s: Sheet) -> None:
            for u, v in spots[n]:
                s.disc(u, v, 0.09, p.WHITE)

        return painted(p.TEAL, brush)

    return Solid("dice", (box((96, 96, 96), (face(1), face(2), face(5), face(4)), top=face(3)),))


def _nutcracker() -> Solid:
    def coat(s: Sheet) -> None:
        s.band(0.0, 0.3, p.NAVY)
        s.band(0.3, 0.48, (150, 190, 235))
        for u in (0.46, 0.54):
            s.disc(u, 0.36, 0.014, p.BLACK)
        s.panel(0.46, 0.42, 0.54, 0.45, p.WHITE)
        s.panel(0.46, 0.45, 0.54, 0.53, p.WHITE)
        s.band(0.75, 0.78, p.BLACK)
        s.panel(0.47, 0.745, 0.53, 0.785, p.YELLOW)
        for v in (0.56, 0.62, 0.68):
            s.disc(0.5, v, 0.012, p.YELLOW)
        s.panel(0.0, 0.3, 0.2, 0.5, p.WHITE)
        s.panel(0.8, 0.3, 1.0, 0.5, p.WHITE)

    body = smooth(
        (0, 180),
        (17, 180),
        (18, 142),
        (19, 138),
        (20, 116),
        (22, 102),
        (27, 96),
        (26, 50),
        (20, 44),
        (20, 12),
        (30, 10),
    )
    arms = [Tube(ray(side, (27, 92, 6), (35, 70, 6), (29, 48, 6)), p.RED) for side in (90, 270)]
    stand = Revolution(((0.0, 12.0), (40.0, 12.0), (40.0, 0.0)), painted(p.DARK_GREEN), layer=-1)
    return Solid("nutcracker", (stand, Revolution((*body, (30.0, 0.0)), painted(p.RED, coat), shine=0.4), *arms))


def toys() -> tuple[Solid, ...]:
    """Return the toys and apparatus."""
    return (
        _house("toy-house"),
        _house("toy-house-green", _wreath),
        _blocks(),
        _car(),
        _dice(),
        _nutcracker(),
        _camera(),
        _radio(),
        _clock(),
    )
