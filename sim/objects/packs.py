"""Built-in objects: bottles, cans, tins, books and cartons."""

from sim.objects import paint as p
from sim.objects.curves import smooth
from sim.objects.paint import Brush, Sheet, painted, wood
from sim.objects.polyhedron import Polyhedron, box, prism, quad, triangle
from sim.objects.projection import Colour
from sim.objects.revolution import Revolution
from sim.objects.solid import Solid
from sim.objects.tube import Tube, handle

# -- glass and metal --------------------------------------------------------------------------------------------------

_BOTTLE = smooth((0, 182), (12, 182), (13, 160), (14, 130), (35, 106), (37, 92), (37, 20), (36, 3), (33, 0))


def _bottle(name: str, glass: Colour, cap: Colour, front: Brush, back: Brush | None = None) -> Solid:
    def sheet(s: Sheet) -> None:
        s.band(0.0, 0.15, cap)
        front(s)
        if back is not None:
            s.around(180, back)

    return Solid(name, (Revolution(_BOTTLE, painted(glass, sheet), shine=0.9),))


def _wine_label(s: Sheet) -> None:
    s.panel(0.32, 0.54, 0.68, 0.9, p.CREAM)
    s.panel(0.33, 0.555, 0.67, 0.575, p.RED)
    s.text("OLIVA", 0.5, 0.64, 0.06, p.DARK_GREEN, width=0.26)
    s.disc(0.5, 0.75, 0.045, p.GREEN)
    s.disc(0.53, 0.78, 0.035, p.DARK_GREEN)
    s.lines(0.4, 0.83, 0.6, 0.88, 2, p.GREY, 1)


def _harvest_label(s: Sheet) -> None:
    s.panel(0.4, 0.6, 0.6, 0.84, p.YELLOW)
    s.text("2019", 0.5, 0.72, 0.06, p.RED, width=0.16)


def _can(name: str, colour: Colour, word: str, fruit: Colour, *extra: Brush) -> Solid:
    def label(s: Sheet) -> None:
        s.band(0.0, 0.27, p.GREY)
        s.band(0.13, 0.16, (110, 110, 108))
        s.band(0.95, 1.0, p.GREY)
        s.band(0.3, 0.34, p.CREAM)
        for rotation_deg in (0, 180):
            s.around(rotation_deg, face)

    def face(s: Sheet) -> None:
        s.text(word, 0.5, 0.46, 0.1, p.WHITE, width=0.34)
        s.disc(0.45, 0.72, 0.11, fruit)
        s.disc(0.55, 0.76, 0.1, fruit)
        s.star(0.47, 0.64, 0.06, p.GREEN, points=4, waist=0.3)

    profile = ((0.0, 116.0), (38.0, 116.0), (38.0, 0.0))
    return Solid(name, (Revolution(profile, painted(colour, label, *extra), shine=0.5),), 360.0 if extra else 180.0)


def _offer(s: Sheet) -> None:
    s.disc(0.5, 0.62, 0.16, p.YELLOW)
    s.text("2x", 0.5, 0.62, 0.1, p.RED, width=0.16)


def _honey(name: str, lid: Colour) -> Solid:
    def label(s: Sheet) -> None:
        s.band(0.0, 0.42, lid)
        s.dots(28, 2, 0.012, p.ORANGE, top=0.29, bottom=0.42)
        s.panel(0.28, 0.56, 0.72, 0.92, p.WHITE)
        for u, v in ((0.36, 0.68), (0.36, 0.8), (0.405, 0.74), (0.64, 0.68), (0.64, 0.8), (0.595, 0.74)):
            s.star(u, v, 0.06, p.ORANGE, points=6, waist=0.87)
        s.text("HONEY", 0.5, 0.74, 0.08, p.BROWN, width=0.15)

    profile = (
        *((0.0, 104.0), (36.0, 104.0), (37.0, 84.0), (34.0, 82.0)),
        *smooth((34, 82), (45, 74), (46, 60), (46, 12), (42, 0)),
    )
    return Solid(name, (Revolution(profile, painted((24, 128, 214), label), shine=0.8),))


def _milk(name: str, *, with_handle: bool) -> Solid:
    def label(s: Sheet) -> None:
        s.band(0.0, 0.17, p.BLUE)
        for u, v, r in ((0.1, 0.6, 0.07), (0.2, 0.75, 0.09), (0.8, 0.58, 0.08), (0.93, 0.8, 0.07), (0.02, 0.85, 0.05)):
            s.star(u, v, r, p.BLACK, points=7, waist=0.88)
        s.text("MILK", 0.5, 0.64, 0.1, p.BLUE, width=0.3)

    body = smooth((0, 172), (20, 172), (20, 152), (20, 146), (42, 116), (43, 100), (43, 12), (38, 0))
    jug = Revolution(body, painted(p.WHITE, label), shine=0.3)
    grip = (Tube(handle(36, 122, 56, 28, 5, 180), p.WHITE),) if with_handle else ()
    return Solid(name, (jug, *grip))


def _tin() -> Solid:
    def wall(s: Sheet) -> None:
        s.panel(0.06, 0.06, 0.94, 0.94, p.CREAM)
        s.panel(0.1, 0.09, 0.9, 0.91, p.DARK_GREEN)
        s.star(0.5, 0.62, 0.2, p.ORANGE, points=8, waist=0.7)
        s.text("TEA", 0.5, 0.26, 0.13, p.YELLOW, width=0.6)

    sides = painted(p.RED, wall)
    lid = painted(p.RED, lambda s: s.band(0.0, 0.45, p.YELLOW))
    body = box((76, 76, 112), (sides, sides, sides, sides), top=p.RED)
    cover = Revolution(((0.0, 122.0), (28.0, 122.0), (29.0, 112.0)), lid, shine=0.6, layer=1)
    return Solid("tin-tea", (body, cover), 90.0)


def _pencil_pot() -> Solid:
    wall = painted(p.WOOD, wood(51), lambda s: s.band(0.12, 0.18, p.BROWN), lambda s: s.disc(0.5, 0.55, 0.16, p.TEAL))
    return Solid("box-hexagon", (prism(6, 56, 96, wall=wall, top=(120, 172, 210)),), 60.0)


# -- cardboard --------------------------------------------------------------------------------------------------------


def _cereal(name: str, *back: Brush) -> Solid:
    def front(s: Sheet) -> None:
        s.polygon([(0, 0), (1, 0), (1, 0.3), (0, 0.42)], p.RED)
        s.text("CRISPS", 0.5, 0.17, 0.1, p.WHITE, width=0.86)
        s.disc(0.5, 0.86, 0.26, p.WHITE)
        s.disc(0.5, 0.8, 0.2, p.ORANGE)
        for u, v in ((0.4, 0.74), (0.55, 0.72), (0.62, 0.8), (0.45, 0.84), (0.32, 0.82)):
            s.disc(u, v, 0.035, p.YELLOW)

    def side(s: Sheet) -> None:
        s.band(0.0, 0.3, p.RED)
        s.panel(0.15, 0.4, 0.85, 0.9, p.WHITE)
        s.lines(0.22, 0.44, 0.78, 0.88, 9, p.GREY, 7)

    flank, face = painted(p.YELLOW, side), painted(p.YELLOW, front)
    return Solid(
        name,
        (box((108, 46, 158), (face, flank, painted(p.YELLOW, front, *back), flank), top=p.RED),),
        360.0 if back else 180.0,
    )


def _maze(s: Sheet) -> None:
    s.panel(0.08, 0.45, 0.92, 0.95, p.BLUE)
    for i in range(4):
        s.panel(0.14 + 0.1 * i, 0.5 + 0.05 * i, 0.86, 0.525 + 0.05 * i, p.WHITE)
        s.panel(0.14 + 0.19 * i, 0.55, 0.18 + 0.19 * i, 0.9, p.WHITE)
    s.star(0.5, 0.72, 0.12, p.YELLOW)


def _book(name: str, size: tuple[float, float, float], cloth: Colour, cover: Brush, title: str, ink: Colour) -> Solid:
    def spine(s: Sheet) -> None:
        s.band(0.1, 0.13, ink)
        s.band(0.87, 0.9, ink)
        words = Sheet((s.columns, s.rows), cloth)
        words.text(title, 0.5, 0.5, 0.4, ink, width=0.66)
        inner = s.pixels[round(s.rows * 0.15) : round(s.rows * 0.85)]
        rotated = words.pixels[:, round(s.rows * 0.15) : round(s.rows * 0.85)]
        inner[:] = rotated.transpose(1, 0, 2)[:, ::-1]

    def paper(s: Sheet) -> None:
        s.stripes(14, (170, 200, 210), share=0.3)
        s.panel(0.0, 0.0, 0.12, 1.0, cloth)
        s.panel(0.88, 0.0, 1.0, 1.0, cloth)

    def blurb(s: Sheet) -> None:
        s.lines(0.15, 0.2, 0.85, 0.6, 8, ink, 21)

    pages = painted(p.CREAM, paper)
    return Solid(
        name,
        (
            box(
                size,
                (painted(cloth, cover), pages, painted(cloth, blurb), painted(cloth, spine)),
                top=painted(p.CREAM, lambda s: s.band(0.0, 0.12, cloth), lambda s: s.band(0.88, 1.0, cloth)),
            ),
        ),
    )


def _globe(s: Sheet, title: str = "ATLAS") -> None:
    s.disc(0.5, 0.6, 0.27, p.BLUE)
    for u, v, r in ((0.4, 0.52, 0.1), (0.62, 0.6, 0.09), (0.45, 0.72, 0.08), (0.6, 0.45, 0.05)):
        s.star(u, v, r, p.GREEN, points=7, waist=0.7)
    s.text(title, 0.5, 0.17, 0.1, p.YELLOW, width=0.8)


def _moon(s: Sheet) -> None:
    s.disc(0.62, 0.32, 0.14, p.CREAM)
    s.disc(0.68, 0.29, 0.12, p.PURPLE)
    s.polygon([(0, 1), (0, 0.75), (0.3, 0.55), (0.55, 0.8), (0.75, 0.62), (1, 0.85), (1, 1)], p.BLACK)
    s.text("Night", 0.4, 0.14, 0.07, p.CREAM, width=0.6)


def _juice() -> Solid:
    def front(s: Sheet) -> None:
        s.band(0.0, 0.22, p.ORANGE)
        s.disc(0.5, 0.55, 0.2, p.ORANGE)
        s.disc(0.5, 0.55, 0.165, (80, 180, 250))
        s.star(0.5, 0.55, 0.16, p.ORANGE, points=8, waist=0.12)
        s.polygon([(0.55, 0.36), (0.85, 0.28), (0.7, 0.4)], p.GREEN)
        s.text("Juice", 0.5, 0.87, 0.08, p.GREEN, width=0.7)

    def side(s: Sheet) -> None:
        s.band(0.0, 0.22, p.ORANGE)
        s.lines(0.15, 0.32, 0.85, 0.62, 7, p.GREY, 3)
        s.panel(0.2, 0.72, 0.8, 0.9, p.BLACK)
        s.stripes(13, p.WHITE, share=0.35, top=0.72, bottom=0.9)

    w, h, peak = 33.0, 112.0, 142.0
    face, flank = painted(p.WHITE, front), painted(p.WHITE, side)
    body = box((2 * w, 2 * w, h), (face, flank, face, painted(p.WHITE, side, _recycled)), top=p.WHITE)
    slopes = (
        quad([(-w, 0, peak), (-w, -w, h), (w, -w, h), (w, 0, peak)], p.ORANGE),
        quad([(w, 0, peak), (w, w, h), (-w, w, h), (-w, 0, peak)], p.ORANGE),
    )
    gables = (
        triangle([(-w, w, h), (-w, -w, h), (-w, 0, peak)], (40, 150, 240)),
        triangle([(w, -w, h), (w, w, h), (w, 0, peak)], (40, 150, 240)),
    )
    crest = box((2 * w, 3, 14), (p.WHITE, p.WHITE, p.WHITE, p.WHITE), top=p.WHITE, at=(0, 0, peak - 1), layer=2)
    return Solid("carton-juice", (body, Polyhedron((*slopes, *gables), layer=1), crest))


def _recycled(s: Sheet) -> None:
    s.disc(0.5, 0.8, 0.13, p.GREEN)
    s.star(0.5, 0.8, 0.1, p.WHITE, points=3, waist=0.5)


def _tissues(name: str, *back: Brush) -> Solid:
    def wall(s: Sheet) -> None:
        for i in range(5):
            s.disc(i / 4, 0.2 + 0.15 * (i % 2), 0.17, p.PINK)
            s.disc((i + 0.5) / 4, 0.8 - 0.15 * (i % 2), 0.2, p.PURPLE)
        s.mottle(10.0, (0.1, 0.2), 41)

    def top(s: Sheet) -> None:
        s.star(0.5, 0.5, 0.32, p.PURPLE, points=8, waist=0.8)

    long, short = (
        painted(p.TEAL, wall),
        painted(p.TEAL, wall, lambda s: s.text("SOFT", 0.5, 0.5, 0.25, p.WHITE, width=0.7)),
    )
    plain = painted(p.TEAL, wall, *back)
    tissue = Revolution(smooth((0, 108), (6, 107), (7, 96), (22, 84), (28, 80)), painted(p.WHITE), layer=1)
    return Solid(
        name,
        (box((150, 82, 80), (long, short, plain, short), top=painted(p.TEAL, top)), tissue),
        360.0 if back else 180.0,
    )


def packs() -> tuple[Solid, ...]:
    """Return the bottles, cans, tins, books and cartons."""
    return (
        _bottle("bottle-green", p.DARK_GREEN, p.RED, _wine_label),
        _bottle("bottle-harvest", p.DARK_GREEN, p.RED, _wine_label, _harvest_label),
        _can("can-tomato", p.RED, "TOMATO", (40, 50, 230)),
        _can("can-tomato-offer", p.RED, "TOMATO", (40, 50, 230), lambda s: s.around(90, _offer)),
        _can("can-peach", p.TEAL, "PEACH", (90, 170, 250)),
        _honey("jar-honey", p.YELLOW),
        _milk("bottle-milk", with_handle=True),
        _tin(),
        _pencil_pot(),
        _cereal("cereal-plain"),
        _cereal("cereal-puzzle", _maze),
        _book("book-atlas", (118, 34, 152), p.NAVY, _globe, "ATLAS", p.YELLOW),
        _book("book-night", (96, 22, 140), p.PURPLE, _moon, "Night", p.CREAM),
        _juice(),
        _tissues("box-tissues"),
    )


def more_twins() -> tuple[Solid, ...]:
    """Return twins that differ in a printed letter, the colour of a lid, a missing handle, and a sticker."""
    return (
        _book("book-atlan", (118, 34, 152), p.NAVY, lambda s: _globe(s, "ATLAN"), "ATLAS", p.YELLOW),
        _honey("jar-honey-amber", (40, 180, 240)),
        _milk("bottle-milk-plain", with_handle=False),
        _tissues("box-tissues-sale", lambda s: s.disc(0.8, 0.25, 0.11, p.RED)),
    )
