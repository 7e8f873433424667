"""The printed parts of the table, built from the dimensions of `sim.table`.

Each function returns a solid as it is printed: z is up, and the bed is z = 0. Its place in the bench is in
`docs.hardware.assembly`, whose origin is on the desk below the axis: x to the camera's right, y away from the camera.
"""

from collections.abc import Iterable
from math import cos, radians, sin

import numpy as np
from build123d import (
    Align,
    Box,
    Cone,
    Cylinder,
    Part,
    Polygon,
    Pos,
    Rot,
    extrude,
)

from sim.optics import Optics
from sim.table import TABLE

SERVOS = TABLE["servo"]
PLATTER, BEARING, CABLE, IMU, PROFILE = (TABLE[name] for name in ("platter", "bearing", "cable", "imu", "profile"))
PLAY = TABLE["print"]["play"]
UP = (Align.CENTER, Align.CENTER, Align.MIN)

# Heights above the desk. The base stands on the rail, and a servo hangs below the deck.
FLOOR, WALL, DECK = 3.0, 52.0, 6.0
BASE_Z = PROFILE["side"]
DECK_Z = BASE_Z + WALL
SEAT = 2.0  # depth of the bearing's seat in the deck
PLATTER_Z = DECK_Z + DECK - SEAT + BEARING["height"]  # of its underside
TOP_Z = PLATTER_Z + PLATTER["thickness"]
HORN_Z = PLATTER_Z - 25.0  # of the horn's face
PLATE = 5.0  # thickness of the servo's plate

BASE_R, BASE_WALL = 100.0, 4.0
DRUM_R, DRUM_WALL, DRUM_HEIGHT = 88.0, 3.0, 9.0
RIVET_R = 95.5  # circle of the screws between deck and base
HANGERS = [(x, y) for x in (-30.0, 30.0) for y in (-24.0, 24.0)]  # screws that carry the servo's plate
HUB_R, HUB_SCREWS_R = 17.0, 13.9
EXIT = (0.0, 83.0)  # where the cable leaves the drum through the deck
INNER = (0.0, 32.0)  # where the cable is held below the platter
CLIP = (29.0, 10.0, 3.0)
CLIP_HOLES = 9.5  # of the clip's screws from its middle
IMU_AT = (62.0, 0.0)
CARD_HOLES = [(-18.0, -72.0), (18.0, -72.0)]  # of the home card's stand in the platter
FEET = [(x, y) for x in (-58.0, 58.0) for y in (-58.0, 58.0)]
RAIL_SCREWS = [(0.0, -65.0), (0.0, 65.0)]
M2, M2_5, M3, M4, M5 = 2.2, 2.8, 3.4, 4.5, 5.3  # holes through which a screw passes
TAP3, TAP4 = 2.8, 3.7  # holes into which a screw cuts its thread
LENS = -np.array(Optics().rotation).reshape(3, 3).T @ np.array(Optics().translation_mm) + (0, 0, TOP_Z)
PIVOT_OUT = 24.0  # from the post's front to the pivot of the camera head
PLATE_UP = 20.0  # from the pivot to the plate on which the camera stands
LENS_FORWARD, LENS_UP = 39.0, 35.0  # from the pivot, at no tilt, of a webcam with a thread for a tripod


def cylinder(radius: float, height: float, at: Iterable[float] = (0.0, 0.0, 0.0)) -> Part:
    return Pos(*at) * Cylinder(radius, height, align=UP)


def ring(outer: float, inner: float, height: float, z: float = 0.0) -> Part:
    return cylinder(outer, height, (0, 0, z)) - cylinder(inner, height, (0, 0, z))


def box(x: float, y: float, z: float, at: Iterable[float] = (0.0, 0.0, 0.0)) -> Part:
    return Pos(*at) * Box(x, y, z, align=UP)


def drilled(
    part: Part, holes: Iterable[tuple[float, float]], diameter: float, low: float = -1.0, high: float = 80.0
) -> Part:
    """Return the part with vertical holes from ``low`` to ``high``."""
    for x, y in holes:
        part -= cylinder(diameter / 2, high - low, (x, y, low))
    return part


def sunk(part: Part, holes: Iterable[tuple[float, float]], top: float, head: float = 6.4) -> Part:
    """Return the part with holes for M3 screws whose heads are countersunk in its face at z = ``top``."""
    for x, y in holes:
        part -= cylinder(M3 / 2, top + 1, (x, y, -0.5)) + Pos(x, y, top - 1.5) * Cone(M3 / 2, head / 2, 1.5, align=UP)
    return part


def sunk_in_bed(part: Part, holes: Iterable[tuple[float, float]]) -> Part:
    """Return the part with holes for M3 screws whose heads are countersunk in the face that lies on the bed."""
    part = drilled(part, holes, M3)
    for x, y in holes:
        part -= Pos(x, y, 0) * Cone(3.3, M3 / 2, 1.7, align=UP)
    return part


def around(radius: float, count: int, first_deg: float = 0.0) -> list[tuple[float, float]]:
    """Return places on a circle."""
    angles = [radians(first_deg + 360 / count * i) for i in range(count)]
    return [(radius * cos(a), radius * sin(a)) for a in angles]


def profile(points: list[tuple[float, float]], width: float) -> Part:
    """Return a part of one outline, printed on its side: outline (y, z) of the assembly, and width along x."""
    return extrude(Polygon(*points, align=None), width)


# Parts that rotate


def platter() -> Part:
    """The platter, printed with its top on the bed."""
    radius, rim, skin = PLATTER["radius"], PLATTER["thickness"], PLATTER["skin"]
    part = cylinder(radius, skin) + ring(radius, radius - 6, rim) + cylinder(40, rim)
    for angle in range(0, 180, 45):
        part += Rot(0, 0, angle + 22.5) * box(2 * radius - 4, 4, rim)
    ix, iy = IMU_AT
    part += box(IMU["length"] + 8, IMU["width"] + 16, rim, (ix, iy, 0))
    # The IMU lies in a pocket that is open below, parts up, so that its z points up.
    part -= box(IMU["length"] + 2 * PLAY, IMU["width"] + 2 * PLAY, 9, (ix, iy, rim - IMU["height"] - 0.4))
    part -= box(
        6, 8, 9, (ix - IMU["length"] / 2 - 3, iy, rim - IMU["height"] - 0.4)
    )  # its wires, on the side of the parts
    part = drilled(part, [(ix, iy + side * (IMU["width"] / 2 + 4)) for side in (-1, 1)], TAP3, low=1.2)
    part = sunk_in_bed(part, around(HUB_SCREWS_R, 4, 45))
    part += box(44, 8, rim, (0, CARD_HOLES[0][1], 0))
    part = drilled(part, CARD_HOLES, TAP3)
    part = drilled(part, clip_screws(INNER), TAP3, low=1.2)
    return part - box(1.6, 16, 1.2, (0, -radius + 8, -0.4))  # the mark of home, towards the camera


def neck(servo: str) -> float:
    """Return the radius of the hub where it stands on the horn: a wall around the screws."""
    return float(SERVOS[servo]["horn_circle"] / 2 + M2 / 2 + TABLE["print"]["wall"])


def hub(servo: str) -> Part:
    """The part between a servo's horn and the platter, printed as it stands."""
    own = SERVOS[servo]
    height, narrow, floor = PLATTER_Z - HORN_Z, 6.0, 9.0
    cone = HUB_R - neck(servo)
    part = cylinder(neck(servo), narrow) + cylinder(HUB_R, height - narrow - cone, (0, 0, narrow + cone))
    part += Pos(0, 0, narrow) * Cone(neck(servo), HUB_R, cone, align=UP)
    part -= cylinder(own["horn_circle"] / 2 + 2.6, height, (0, 0, floor))
    part = drilled(part, around(own["horn_circle"] / 2, own["horn_holes"]), M2)
    part -= cylinder(own["horn_boss"] / 2 + PLAY, 2.5, (0, 0, -1))
    return drilled(part, around(HUB_SCREWS_R, 4, 45), TAP3, low=height - 10)


def cable_clip() -> Part:
    """A bar that presses the cable against platter or deck, printed with its groove up.

    Its screws are countersunk, because the cable in the drum winds close below their heads.
    """
    part = box(*CLIP) - box(CABLE["width"] + 1, 20, 1, (0, 0, CLIP[2] - 0.7))
    return sunk_in_bed(part, [(-CLIP_HOLES, 0), (CLIP_HOLES, 0)])


def clip_screws(at: tuple[float, float]) -> list[tuple[float, float]]:
    return [(at[0] - CLIP_HOLES, at[1]), (at[0] + CLIP_HOLES, at[1])]


def imu_cover() -> Part:
    """The cover of the IMU's pocket."""
    part = box(14, IMU["width"] + 16, 1.6)
    return drilled(part, [(0, side * (IMU["width"] / 2 + 4)) for side in (-1, 1)], M3)


def home_stand() -> Part:
    """The stand of the home card, screwed on the platter."""
    card = TABLE["home_card"]
    height = (card["rows"] * 15.0 + 10.0) / 2  # from the card's middle to its edge
    return _stand(card["tilt_deg"], card["centre"][1:], height, card["thickness"], 50.0, (-78.0, -40.0), CARD_HOLES)


def board_stand() -> Part:
    """The stand of the calibration board, which stands loose on the platter."""
    board = TABLE["calibration_board"]
    up = 50.0 * cos(radians(board["tilt_deg"])) + board["edge_height"]
    part = _stand(board["tilt_deg"], (0.0, up), 50.0, TABLE["home_card"]["thickness"], 40.0, (-30.0, 40.0), [])
    return part - profile([(8, 6), (32, 6), (8, 62)], 40.0)


def _stand(
    tilt_deg: float,
    centre: tuple[float, float],
    half: float,
    thick: float,
    width: float,
    foot: tuple[float, float],
    screws: list[tuple[float, float]],
) -> Part:
    """Return a stand with a slot for a card whose front is at ``centre``: (y, z) from the middle of the top."""
    lean = radians(tilt_deg)
    along, back = np.array([sin(lean), cos(lean)]), np.array([cos(lean), -sin(lean)])
    low = np.array(centre) - half * along  # lower edge of the card's front
    slot = thick + PLAY

    def place(up: float, behind: float) -> tuple[float, float]:
        y, z = low + up * along + behind * back
        return float(y), float(z)

    front = place(0, -2.4)[0]
    lip = (
        [place(4, -0.1), place(4, -2.4), (front, 3.0)]
        if low[1] < 8
        else [place(4, -0.1), place(4, -2.4), place(-4, -2.4)]
    )
    under = [] if low[1] < 8 else [(place(-4, -2.4)[0], 3.0)]
    points = [
        *((foot[0], 0.0), (foot[1], 0.0), (foot[1], 3.0), place(1.2 * half, slot + 3.0), place(1.2 * half, slot)),
        *(place(0, slot), place(0, -0.1), *lip, *under, (foot[0], 3.0)),
    ]
    part = profile(points, width)
    for x, y in screws:
        part -= Pos(y, 0, width / 2 + x) * Rot(-90, 0, 0) * Cylinder(M3 / 2, 40, align=Align.CENTER)
    return part


# Parts that stand


def base() -> Part:
    """The tub below the deck: it stands on the rail and on four feet."""
    part = cylinder(BASE_R, FLOOR) + ring(BASE_R, BASE_R - BASE_WALL, WALL)
    posts = Part() + [cylinder(6, WALL, (x, y, 0)) for x, y in around(RIVET_R, 4, 45)]
    part += posts & cylinder(BASE_R, WALL)
    part = drilled(part, around(RIVET_R, 4, 45), TAP3, low=WALL - 16)
    part -= box(40, 20, WALL, (0, BASE_R, WALL - 14))  # cables
    part = drilled(part, FEET, M4)
    part -= box(1.6, 2, 30, (0, -BASE_R, 10))  # the mark below the platter's
    return drilled(part, RAIL_SCREWS, M5)


def foot() -> Part:
    """A foot, as high as the rail."""
    return drilled(cylinder(11, PROFILE["side"]), [(0, 0)], TAP4, low=4)


def deck() -> Part:
    """The lid of the base: the bearing's seat, and the drum in which the cable winds."""
    part = cylinder(BASE_R, DECK) + ring(DRUM_R + DRUM_WALL, DRUM_R, DRUM_HEIGHT + DECK)
    seat = BEARING["outer"] / 2 + PLAY / 2
    part += cylinder(seat + 3, DECK + 3) - cylinder(seat, 20, (0, 0, DECK - SEAT))
    part -= cylinder(HUB_R + 2, 30, (0, 0, -1))
    part -= cylinder(seat, 20, (0, 0, DECK - SEAT))
    part = sunk(part, [*around(RIVET_R, 4, 45), *HANGERS], DECK)
    x, y = EXIT
    part -= box(CABLE["width"] + 3, 4, 20, (x, y, -1))
    return drilled(part, clip_screws((x, y - 10)), TAP3, high=DECK - 1)


def servo_plate(servo: str) -> Part:
    """The plate that carries a servo, hung below the deck by four screws with nuts above and below it."""
    own = SERVOS[servo]
    length, width = own["body"][:2]
    middle = length / 2 - own["case"]  # of the body, from the axis
    part = box(84, 60, PLATE, (3, 0, 0))
    if own["body_x"]:
        holes = [(x, y) for x in own["body_x"] for y in own["body_y"]]
        part = drilled(part, holes, M2_5 if own["body_screw"] > 2 else M2)
    else:  # a frame around the body, and slots for cable ties
        part = box(84, 60, 12, (3, 0, 0)) - box(length + PLAY, width + PLAY, 20, (middle, 0, PLATE))
        for x in (middle - length / 8, middle + length / 8):
            for y in (-1, 1):
                part -= box(6, 2.4, 40, (x, y * (width / 2 + 4), -1))
    part = drilled(part, [(0, 0)], 2 * max(neck(servo) + 0.35, own["horn_diameter"] / 2 + 0.3))
    return drilled(part, HANGERS, M3)


def corner() -> Part:
    """A corner bracket for the profiles."""
    part = profile([(0, 0), (30, 0), (30, 5), (14, 5), (5, 14), (5, 30), (0, 30)], PROFILE["side"])
    half = PROFILE["side"] / 2
    part -= Pos(22, 2, half) * Rot(90, 0, 0) * Cylinder(M5 / 2, 30)
    return part - Pos(2, 22, half) * Rot(0, 90, 0) * Cylinder(M5 / 2, 30)


def camera_clamp() -> Part:
    """The fixed half of the camera head, screwed on the post; its scale shows the tilt."""
    part = box(20, 46, 5) + box(6, 22, PIVOT_OUT, (-7, 0, 0)) + Pos(-7, 0, PIVOT_OUT) * Rot(0, 90, 0) * Cylinder(11, 6)
    part = drilled(part, [(0, -17), (0, 17)], M5)
    part -= Pos(-7, 0, PIVOT_OUT) * Rot(0, 90, 0) * Cylinder(M5 / 2, 30)
    for mark in TABLE["camera"]["marks_deg"]:  # the plate's pointer stands at the mark of its tilt
        side = 1.6 if mark % 15 else -1.6
        part -= Pos(-7 + side, 0, PIVOT_OUT) * Rot(mark, 0, 0) * Pos(0, 0, 11) * Box(3.2, 0.8, 1.2)
    return part


def camera_plate() -> Part:
    """The half that tilts: a plate for a tripod screw, printed with the plate on the bed.

    The lens looks along -y of the printed part.
    """
    part = box(34, 50, 4, (1, -14, 0)) + box(6, 22, PLATE_UP, (1, 0, 0))
    part += Pos(1, 0, PLATE_UP) * Rot(0, 90, 0) * Cylinder(11, 6)
    part -= Pos(1, 0, PLATE_UP) * Rot(0, 90, 0) * Cylinder(M5 / 2, 30)
    part -= Pos(1, 11, PLATE_UP) * Box(6.2, 1.2, 0.8)  # the pointer, on the side of the post
    return drilled(part, [(0, -24)], 6.6)


def backdrop_clip() -> Part:
    """A clip that holds the backdrop on the bar behind the table."""
    slot = TABLE["backdrop"]["thickness"] + PLAY
    outline = [
        (0, 0),
        (44, 0),
        (44, 4),
        (30 + slot, 4),
        (21 + slot, 40),
        (17 + slot, 40),
        (17 + slot, 5),
        (17, 5),
        (17, 25),
    ]
    part = profile([*outline, (13, 25), (10, 4), (0, 4)], 24.0)
    return part - Pos(5, 2, 12) * Rot(90, 0, 0) * Cylinder(M5 / 2, 20)


PRINTED = {
    function.__name__: function
    for function in (
        *(platter, cable_clip, imu_cover, home_stand, board_stand, base, foot, deck),
        *(corner, camera_clamp, camera_plate, backdrop_clip),
    )
}
"""The parts that do not depend on the servo."""
FITTED = {function.__name__: function for function in (hub, servo_plate)}
"""The parts of which each servo needs its own."""


def every_part() -> dict[str, Part]:
    """Return all parts by the names of their files."""
    fitted = {f"{name}-{servo}": make(servo) for name, make in FITTED.items() for servo in SERVOS}
    return {name: make() for name, make in PRINTED.items()} | fitted
