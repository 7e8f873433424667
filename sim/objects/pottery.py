"""Built-in objects: vessels, lamps and balls. They are bodies of revolution, some with handles and spouts."""

from math import cos, pi, sin

from sim.objects import paint as p
from sim.objects.curves import Curve, smooth
from sim.objects.paint import Brush, Sheet, painted
from sim.objects.projection import Colour
from sim.objects.revolution import Revolution
from sim.objects.solid import Solid
from sim.objects.tube import Tube, handle, ray

# -- mugs and pots ----------------------------------------------------------------------------------------------------

_MUG = ((41.0, 98.0), (44.0, 98.0), (44.0, 12.0), (42.0, 4.0), (38.0, 0.0))
_MUG_INSIDE = ((41.0, 98.0), (41.0, 10.0), (36.0, 6.0), (0.0, 6.0))


def _mug(name: str, ground: Colour, *brushes: Brush) -> Solid:
    body = Revolution(_MUG, painted(ground, *brushes), inside=_MUG_INSIDE, lining=p.WHITE, shine=0.45)
    return Solid(name, (body, Tube(handle(44, 82, 24, 26, 5.5, 90), ground)))


def _rings(sheet: Sheet) -> None:
    sheet.band(0.16, 0.21, p.BLUE)
    sheet.band(0.24, 0.26, p.BLUE)
    sheet.band(0.84, 0.87, p.BLUE)


def _star(sheet: Sheet) -> None:
    sheet.star(0.5, 0.55, 0.23, p.RED)
    sheet.star(0.5, 0.55, 0.1, p.YELLOW)


def _teapot() -> Solid:
    def flowers(sheet: Sheet) -> None:
        for i in range(5):
            u = (i + 0.5) / 5
            sheet.star(u, 0.52, 0.11, p.PINK, points=6, waist=0.6)
            sheet.disc(u, 0.52, 0.035, p.YELLOW)
            sheet.star(u + 0.1, 0.66, 0.07, p.GREEN, points=3, waist=0.3)
        sheet.band(0.28, 0.31, p.TEAL)
        sheet.band(0.0, 0.09, p.TEAL)

    body = smooth((0, 108), (14, 108), (34, 99), (36, 94), (58, 80), (66, 52), (58, 18), (40, 4), (38, 0))
    spout = ray(270, (58, 36, 12), (68, 46, 9), (80, 72, 6.5), (92, 90, 5.5))
    return Solid(
        "teapot",
        (
            Revolution(body, painted(p.CREAM, flowers), shine=0.5),
            Tube(handle(56, 88, 28, 36, 5.5, 90), p.TEAL),
            Tube(spout, p.CREAM, joints=1),
            Revolution(smooth((0, 124), (9, 124), (11, 116), (6, 108), (5, 104)), painted(p.TEAL), shine=0.5, layer=1),
        ),
    )


def _bowl(name: str, ground: Colour, brush: Brush, symmetry_deg: float, lining: Colour) -> Solid:
    outside = ((78.0, 74.0), (82.0, 74.0), *smooth((82, 72), (76, 40), (52, 14), (34, 9)), (34.0, 0.0))
    inside = smooth((78, 74), (72, 42), (48, 17), (0, 12))
    return Solid(
        name, (Revolution(outside, painted(ground, brush), inside=inside, lining=lining, shine=0.4),), symmetry_deg
    )


def _hoops(sheet: Sheet) -> None:
    for i, colour in enumerate((p.ORANGE, p.CREAM, p.BROWN)):
        sheet.band(0.16 + 0.16 * i, 0.26 + 0.16 * i, colour)


def _leaves(sheet: Sheet) -> None:
    for i in range(8):
        u = (i + 0.5) / 8
        sheet.polygon([(u - 0.035, 0.55), (u, 0.18), (u + 0.035, 0.55), (u, 0.72)], p.GREEN)
        sheet.panel(u - 0.004, 0.3, u + 0.004, 0.8, p.DARK_GREEN)
    sheet.band(0.07, 0.1, p.DARK_GREEN)


# -- vases and lamps --------------------------------------------------------------------------------------------------

_VASE = (
    (27.0, 176.0),
    (31.0, 176.0),
    *smooth((31, 174), (20, 140), (48, 118), (54, 78), (44, 30), (28, 6)),
    (30.0, 0.0),
)
_VASE_INSIDE = ((27.0, 176.0), (16.0, 140.0), (16.0, 100.0), (0.0, 100.0))


def _vase(name: str, ground: Colour, *brushes: Brush, symmetry_deg: float = 360.0) -> Solid:
    body = Revolution(_VASE, painted(ground, *brushes), inside=_VASE_INSIDE, lining=ground, shine=0.6)
    return Solid(name, (body,), symmetry_deg)


def _poppy(sheet: Sheet) -> None:
    sheet.panel(0.496, 0.56, 0.504, 0.86, p.GREEN)
    sheet.polygon([(0.5, 0.8), (0.54, 0.68), (0.56, 0.7), (0.53, 0.78)], p.GREEN)
    sheet.star(0.5, 0.54, 0.12, p.RED, points=5, waist=0.75)
    sheet.disc(0.5, 0.54, 0.035, p.BLACK)


def _amphora() -> Solid:
    def frieze(sheet: Sheet) -> None:
        for top in (0.36, 0.72):
            sheet.band(top, top + 0.015, p.BLACK)
            sheet.band(top + 0.075, top + 0.09, p.BLACK)
            for i in range(24):
                sheet.panel((i + 0.2) / 24, top + 0.03, (i + 0.8) / 24, top + 0.06, p.BLACK)
        for rotation_deg in (0, 180):
            sheet.around(rotation_deg, lambda s: s.star(0.5, 0.57, 0.09, p.BLACK, points=8, waist=0.55))
        sheet.mottle(6.0, (1.0, 0.02), 11)

    body = (
        (20.0, 168.0),
        (26.0, 168.0),
        *smooth((26, 162), (16, 152), (17, 128), (58, 112), (52, 62), (22, 14)),
        (26.0, 0.0),
    )
    inside = ((20.0, 168.0), (13.0, 150.0), (13.0, 100.0), (0.0, 100.0))
    ears = [ray(side, (17, 152, 4), (36, 152, 4), (46, 138, 4), (44, 114, 4.5), (40, 106, 4.5)) for side in (90, 270)]
    pot = Revolution(body, painted(p.TERRACOTTA, frieze), inside=inside, lining=(40, 60, 105))
    return Solid("amphora", (pot, *(Tube(ear, p.TERRACOTTA) for ear in ears)), 180.0)


def _lamp() -> Solid:
    def pleats(sheet: Sheet) -> None:
        sheet.stripes(24, (150, 205, 232), share=0.5)
        sheet.band(0.0, 0.05, p.BROWN)
        sheet.band(0.94, 1.0, p.BROWN)

    shade = Revolution(
        ((36.0, 180.0), (62.0, 104.0)),
        painted(p.CREAM, pleats),
        inside=((36.0, 180.0), (36.0, 150.0), (0.0, 150.0)),
        lining=(170, 225, 245),
        layer=1,
    )
    foot = smooth((4, 120), (5, 84), (24, 66), (26, 40), (12, 16), (36, 8), (38, 0))
    return Solid("lamp", (Revolution(foot, painted(p.TEAL), shine=0.6), shade), 15.0)


# -- balls and candles ------------------------------------------------------------------------------------------------


def _sphere(radius: float) -> Curve:
    return tuple((radius * sin(pi * i / 90), radius * (1 + cos(pi * i / 90))) for i in range(91))


def _segments(sheet: Sheet) -> None:
    for i, colour in enumerate((p.RED, p.WHITE, p.BLUE, p.WHITE, p.YELLOW, p.WHITE)):
        sheet.panel(i / 6, 0.0, (i + 1) / 6, 1.0, colour)
    sheet.band(0.0, 0.06, p.WHITE)


def _football(sheet: Sheet) -> None:
    sheet.band(0.0, 0.075, p.BLACK)
    for row, v in enumerate((0.3, 0.55, 0.8)):
        for i in range(5):
            sheet.star((i + 0.5 * (row % 2) + 0.3) / 5, v, 0.085, p.BLACK, points=5, waist=0.85)


def _candle() -> Solid:
    wax = Revolution(
        ((0.0, 120.0), (24.0, 120.0), *smooth((30, 120), (36, 120), (36, 110), (36, 40), (36, 0))),
        painted((90, 70, 160), lambda s: s.mottle(4.0, (1.0, 0.05), 31)),
        shine=0.3,
    )
    wick = Revolution(((0.0, 140.0), (1.8, 139.0), (1.8, 120.0)), painted(p.BLACK), layer=1)
    return Solid("candle", (wax, wick), 0.0)


def pottery() -> tuple[Solid, ...]:
    """Return the vessels, lamps and balls."""
    return (
        _mug("mug-white", p.WHITE, _rings),
        _mug("mug-star", p.WHITE, _rings, lambda s: s.around(-60, _star)),
        _mug("mug-dots", p.RED, lambda s: s.dots(9, 5, 0.055, p.WHITE, top=0.08, bottom=0.98)),
        _teapot(),
        _bowl("bowl-hoops", p.TERRACOTTA, _hoops, 0.0, p.CREAM),
        _bowl("bowl-leaves", p.WHITE, _leaves, 45.0, p.WHITE),
        _vase("vase-blue", p.BLUE, symmetry_deg=0.0),
        _vase("vase-poppy", p.BLUE, _poppy),
        _amphora(),
        _lamp(),
        Solid("ball-beach", (Revolution(_sphere(68), painted(p.WHITE, _segments), shine=0.5),)),
        Solid("ball-football", (Revolution(_sphere(66), painted(p.WHITE, _football), shine=0.25),), 72.0),
        _candle(),
    )
