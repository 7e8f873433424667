"""The bench, put together from printed and bought parts."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, radians, sin

import numpy as np
from build123d import Location, Part, Plane, Polygon, Pos, Rot, extrude

from docs.hardware import parts
from docs.hardware.parts import PROFILE, SERVOS, TABLE, TOP_Z, box, cylinder, ring

RAIL_Y = (-590.0, 210.0)
ORANGE, BLUE, GREY, DARK, METAL, WHITE = "#e07b39", "#4f7cac", "#9aa5b1", "#4b5563", "#c3ccd5", "#f4f4f4"


@dataclass
class Item:
    """A part in its place. ``apart`` is where the exploded picture shows it, from its place."""

    name: str
    part: Part = field(repr=False)
    place: Location = field(default_factory=Location, repr=False)
    rotates: bool = False
    colour: str = GREY
    apart: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def solid(self) -> Part:
        return self.place * self.part

    def rotated(self, angle_deg: float) -> Part:
        return Rot(0, 0, angle_deg) * self.solid


def upright(x: float, y: float, z: float) -> Location:
    """Return the place of a part that is printed on its side: its outline's origin."""
    return Location(Plane((x, y, z), x_dir=(0, 1, 0), z_dir=(1, 0, 0)))


def camera_pivot(
    lens: Sequence[float] = parts.LENS, tilt_deg: float = TABLE["camera"]["tilt_deg"]
) -> tuple[float, float]:
    """Return (y, z) of the camera head's pivot for a place of the lens; without one, for that of the simulator."""
    tilt = radians(tilt_deg)
    forward, up = parts.LENS_FORWARD, parts.LENS_UP
    y = lens[1] - forward * cos(tilt) - up * sin(tilt)
    return float(y), float(lens[2] - up * cos(tilt) + forward * sin(tilt))


def table(servo: str = "xl430_w250") -> list[Item]:
    """Return the table, from bottom to top."""
    own = SERVOS[servo]
    length, width, depth = own["body"]
    case_z = parts.HORN_Z - own["horn_height"]
    ix, iy = parts.IMU_AT
    x, y = parts.EXIT
    below, bearing_z = parts.PLATTER_Z, parts.DECK_Z + parts.DECK - parts.SEAT
    imu, bearing = parts.IMU, parts.BEARING
    body = box(length, width, depth, (length / 2 - own["case"], 0, case_z - depth))
    horn = cylinder(own["horn_diameter"] / 2, own["horn_height"], (0, 0, case_z))
    races = ring(bearing["outer"] / 2, bearing["inner"] / 2, bearing["height"], bearing_z)
    groove = ring(bearing["outer"] / 2 + 1, bearing["outer"] / 2 - 2.5, 3, bearing_z + 4.5)
    plate_z = case_z + parts.PLATE
    return [
        *(Item("foot", parts.foot(), Pos(*at, 0), colour=DARK, apart=(0, 0, -30)) for at in parts.FEET),
        Item("base", parts.base(), Pos(0, 0, parts.BASE_Z), colour=BLUE),
        Item("servo", body + horn, colour=DARK, apart=(0, 0, 75)),
        Item(
            "servo plate",
            parts.servo_plate(servo),
            Pos(0, 0, plate_z) * Rot(180, 0, 0),
            colour=ORANGE,
            apart=(0, 0, 105),
        ),
        Item("cable clip", parts.cable_clip(), Pos(x, y - 10, parts.DECK_Z - 3), colour=ORANGE, apart=(0, 0, 105)),
        Item("deck", parts.deck(), Pos(0, 0, parts.DECK_Z), colour=BLUE, apart=(0, 0, 140)),
        Item("axial bearing", races - groove, colour=METAL, apart=(0, 0, 175)),
        Item("hub", parts.hub(servo), Pos(0, 0, parts.HORN_Z), True, ORANGE, (0, 0, 225)),
        Item("cable clip", parts.cable_clip(), Pos(*parts.INNER, below - 3), True, ORANGE, (0, 0, 225)),
        Item("IMU cover", parts.imu_cover(), Pos(-ix, iy, below - 1.6), True, ORANGE, (0, 0, 225)),
        Item(
            "IMU",
            box(imu["length"], imu["width"], imu["board"], (-ix, iy, below)),
            Location(),
            True,
            "#2e8b57",
            (0, 0, 245),
        ),
        Item("platter", parts.platter(), Pos(0, 0, TOP_Z) * Rot(0, 180, 0), True, GREY, (0, 0, 300)),
        Item("stand of the home card", parts.home_stand(), upright(-25, 0, TOP_Z), True, ORANGE, (0, 0, 320)),
        Item("home card", card(), home_place(), True, WHITE, (0, 0, 345)),
    ]


def cable() -> Item:
    """Return the cable in the drum at home, as a picture shows it."""
    wound = np.linspace(0, TABLE["cable"]["turns"], 200)
    radius, angle = 40 + 40 * wound / wound[-1], np.radians(90 + 360 * wound)
    edges = [
        np.column_stack([(radius + side) * np.cos(angle), (radius + side) * np.sin(angle)]) for side in (-0.6, 0.6)
    ]
    outline = np.vstack([edges[0], edges[1][::-1]])
    ribbon = extrude(Polygon(*map(tuple, outline), align=None), TABLE["cable"]["width"])
    return Item("cable", ribbon, Pos(0, 0, parts.DECK_Z + parts.DECK + 0.3), colour="#c0392b", apart=(0, 0, 155))


def card() -> Part:
    """The home card, with its front in the plane y = 0 and its middle in the origin."""
    own = TABLE["home_card"]
    return box(
        own["columns"] * 15 + 10,
        own["thickness"],
        own["rows"] * 15 + 10,
        (0, own["thickness"] / 2, -(own["rows"] * 15 + 10) / 2),
    )


def home_place() -> Location:
    """Return the card's place on the platter, as the simulator has it."""
    x, y, z = TABLE["home_card"]["centre"]
    return Pos(x, y, TOP_Z + z) * Rot(-TABLE["home_card"]["tilt_deg"], 0, 0)


def frame() -> list[Item]:
    """Return rail, post, camera and backdrop."""
    side = PROFILE["side"]
    near, far = RAIL_Y
    y, z = camera_pivot()
    front = y - parts.PIVOT_OUT  # of the post
    tilt = TABLE["camera"]["tilt_deg"]
    clamp = Location(Plane((0, front, z), x_dir=(-1, 0, 0), z_dir=(0, 1, 0)))
    head = Pos(0, y, z) * Rot(-tilt, 0, 0)
    backdrop = TABLE["backdrop"]
    board = box(594, backdrop["thickness"], 420)
    webcam = box(30, 24, 30, (0, 12 + 39 - 24, parts.PLATE_UP)) + Pos(0, 39, 35) * Rot(90, 0, 0) * cylinder(8, 4)
    return [
        Item("rail", profile_bar(side, far - near, side), Pos(0, (near + far) / 2, 0), colour=METAL),
        Item("post", profile_bar(side, side, PROFILE["post"]), Pos(0, front - side / 2, side), colour=METAL),
        Item("bar", profile_bar(PROFILE["bar"], side, side), Pos(0, far + side / 2, 0), colour=METAL),
        Item("corner", parts.corner(), upright(-10, front, side), colour=ORANGE),
        Item("corner", parts.corner(), Rot(0, 0, 180) * upright(-10, side - front, side), colour=ORANGE),
        Item(
            "corner", parts.corner(), Location(Plane((10, far, side), x_dir=(1, 0, 0), z_dir=(0, 0, -1))), colour=ORANGE
        ),
        Item(
            "corner",
            parts.corner(),
            Location(Plane((-10, far, side), x_dir=(0, -1, 0), z_dir=(0, 0, -1))),
            colour=ORANGE,
        ),
        Item("camera clamp", parts.camera_clamp(), clamp, colour=ORANGE),
        Item("camera plate", parts.camera_plate(), head * Pos(0, 0, parts.PLATE_UP) * Rot(180, 0, 0), colour=BLUE),
        Item("camera", webcam, head, colour=DARK),
        *(
            Item("backdrop clip", parts.backdrop_clip(), upright(x - 12, far + 5, side), colour=ORANGE)
            for x in (-150, 150)
        ),
        Item("backdrop", board, Pos(0, far + 5 + 17.15 + backdrop["thickness"] / 2, side + 5), colour=WHITE),
    ]


def profile_bar(x: float, y: float, z: float) -> Part:
    """Return an extruded profile with its slots hinted at."""
    part = box(x, y, z)
    longest = max(x, y, z)
    for groove in ((6.2, longest, 2.0), (2.0, longest, 6.2)):
        if y == longest:
            cutter = box(groove[0], longest, groove[2])
            part -= [Pos(0, 0, z - 1) * cutter, Pos(0, 0, -1) * cutter] if groove[0] > 3 else []
    return part
