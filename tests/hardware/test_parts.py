"""The printed parts of the table: they print without support, fit the servos, and do not collide."""

from functools import cache
from itertools import product
from math import cos, hypot, isclose, pi, radians, sin

import numpy as np
import pytest

pytest.importorskip("build123d", reason="The CAD packages are not installed: run `make hardware`.")

from build123d import GeomType, Pos, Rot
from OCP.BRepAdaptor import BRepAdaptor_Surface

from docs.hardware import parts, wiring
from docs.hardware.assembly import RAIL_Y, camera_pivot, frame, home_place, table
from docs.hardware.mesh import normals, triangles
from docs.hardware.parts import PLATTER_Z, PROFILE, SERVOS, TABLE, TOP_Z
from rig.config import RigConfig
from rig.views.charuco_board import CharucoBoard
from sim.calibration_board import home_mark
from sim.optics import Optics
from sim.servo.models import servo_model
from tests.docs.pages import DOCS

PRINT = TABLE["print"]
CLAMP_HALF = 23.0  # of the camera head on the post
EVERY_PART = pytest.mark.parametrize(
    "name", [*parts.PRINTED, *(f"{fitted}-{servo}" for fitted in parts.FITTED for servo in SERVOS)]
)
pytestmark = pytest.mark.nightly  # `make hardware` runs them


@cache
def part_of(name):
    function, _, servo = name.partition("-")
    return parts.FITTED[function](servo) if servo else parts.PRINTED[function]()


@cache
def mesh_of(name):
    return triangles(part_of(name))


@EVERY_PART
def test_part_is_one_watertight_solid_on_the_bed(name):
    corners, faces = mesh_of(name)
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {(a, b) for a, b in edges.tolist()}
    assert len(forward) == len(edges)  # no edge twice in the same direction
    assert all((b, a) in forward for a, b in forward)
    assert len(part_of(name).solids()) == 1
    a, b, c = (corners[faces[:, i]] for i in range(3))
    volume = float((np.cross(a, b) * c).sum()) / 6
    assert volume > 0
    assert isclose(volume, part_of(name).volume, rel_tol=0.01)
    size = np.ptp(corners, axis=0)
    assert size.max() <= PRINT["bed"]
    assert corners[:, 2].min() == pytest.approx(0.0, abs=1e-6)


@EVERY_PART
def test_no_wall_is_too_thin(name):
    """From points of the surface straight into the material: the way to the other side, if that lies opposite."""
    corners, faces = mesh_of(name)
    outwards, areas = normals(corners, faces)
    rng = np.random.default_rng(1)
    chosen = rng.choice(len(faces), 400, p=areas / areas.sum())
    u, v = rng.random((2, 400, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (corners[faces[:, i]] for i in range(3))
    starts = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    for start, direction in zip(starts, -outwards[chosen], strict=True):
        assert _way(start + 1e-4 * direction, direction, a, b - a, c - a, outwards) >= PRINT["wall"] - 0.05, (
            start.round(1)
        )


def _way(start, direction, a, ab, ac, outwards):
    """Return the distance along a ray to the first triangle that it leaves at less than 60° (Möller and Trumbore)."""
    p = np.cross(direction, ac)
    det = (ab * p).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = start - a
        u = (t * p).sum(1) / det
        q = np.cross(t, ab)
        v = (q @ direction) / det
        way = (ac * q).sum(1) / det
        hit = (np.abs(det) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (way > 0) & (outwards @ direction > 0.5)
    return float(way[hit].min(initial=np.inf))


@EVERY_PART
def test_part_prints_without_support(name):
    """No face is steeper than the limit, except bridges (support on all sides) and narrow ledges."""
    corners, faces = mesh_of(name)
    facing, _ = normals(corners, faces)
    centres = corners[faces].mean(axis=1)
    hangs = (facing[:, 2] < -sin(radians(PRINT["overhang_deg"]))) & (centres[:, 2] > 0.05)
    for region in _regions(faces, np.flatnonzero(hangs)):
        supported, free = _boundary(corners, faces, region)
        limit = PRINT["ledge"] if free else PRINT["bridge"] / 2
        assert supported, centres[region[0]].round(1)
        segments = np.array([corners[list(edge)] for edge in supported])
        for face in region:
            for point in _points(corners[faces[face]]):
                assert _distance(point, segments) <= limit, (point.round(1), limit)


def _regions(faces, chosen):
    """Return the chosen faces in groups that share edges."""
    at_edge: dict[frozenset[int], list[int]] = {}
    for face in chosen:
        for i in range(3):
            at_edge.setdefault(frozenset((faces[face][i], faces[face][i - 1])), []).append(face)
    left, regions = set(chosen.tolist()), []
    while left:
        waiting, region = [left.pop()], []
        while waiting:
            face = waiting.pop()
            region.append(face)
            for i in range(3):
                for other in at_edge[frozenset((faces[face][i], faces[face][i - 1]))]:
                    if other in left:
                        left.remove(other)
                        waiting.append(other)
        regions.append(region)
    return regions


def _boundary(corners, faces, region):
    """Return the edges of a region whose neighbour leads down, which supports it, and whether others are free."""
    inside = {frozenset((faces[face][i], faces[face][i - 1])) for face in region for i in range(3)}
    neighbours = [face for face in range(len(faces)) if face not in set(region)]
    supported, free = [], False
    for face in neighbours:
        for i in range(3):
            edge = frozenset((faces[face][i], faces[face][i - 1]))
            if edge in inside:
                third = corners[faces[face][i - 2]]
                if third[2] < corners[list(edge)][:, 2].mean() - 1e-6:
                    supported.append(tuple(edge))
                else:
                    free = True
    return supported, free


def _points(triangle):
    steps = np.linspace(0, 1, 7)
    return [
        triangle[0] + u * (triangle[1] - triangle[0]) + v * (triangle[2] - triangle[0])
        for u, v in product(steps, steps)
        if u + v <= 1
    ]


def _distance(point, segments):
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    share = np.clip(((point - start) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12), 0, 1)
    return float(np.linalg.norm(start + share[:, None] * along - point, axis=1).min())


def _holes(part, radius):
    """Return the places of the vertical holes of a radius, rounded to 0.01 mm."""
    found = set()
    for wall in part.faces().filter_by(GeomType.CYLINDER):
        cylinder = BRepAdaptor_Surface(wall.wrapped).Cylinder()
        axis = cylinder.Axis()
        if isclose(cylinder.Radius(), radius, abs_tol=1e-6) and abs(axis.Direction().Z()) > 0.99:
            found.add((round(axis.Location().X(), 2) + 0.0, round(axis.Location().Y(), 2) + 0.0))
    return found


# ROBOTIS drawings "XL-430" (24 March 2018) and "X330" (28 May 2020). That of the XC430 is taken from the XL430, that of
# the MX-28 (horn HN07-N101) is not confirmed by a drawing.
DRAWN = {
    "xl430_w250": (16.0, 4, {(-8.0, 11.0), (-8.0, -11.0), (32.0, 11.0), (32.0, -11.0)}, parts.M2_5),
    "xc430_w240": (16.0, 4, {(-8.0, 11.0), (-8.0, -11.0), (32.0, 11.0), (32.0, -11.0)}, parts.M2_5),
    "xl330_m288": (12.0, 4, {(-7.5, 8.0), (-7.5, -8.0), (22.5, 8.0), (22.5, -8.0)}, parts.M2),
    "mx_28": (16.0, 8, set(), parts.M2_5),
}


@pytest.mark.parametrize("servo", SERVOS)
def test_holes_are_those_of_the_servo(servo):
    circle, count, body, screw = DRAWN[servo]
    horn = _holes(part_of(f"hub-{servo}"), parts.M2 / 2)
    assert len(horn) == count
    assert all(isclose(hypot(x, y), circle / 2, abs_tol=0.01) for x, y in horn)
    assert body <= _holes(part_of(f"servo_plate-{servo}"), screw / 2)
    hub = {(round(x, 2), round(y, 2)) for x, y in parts.around(parts.HUB_SCREWS_R, 4, 45)}
    assert hub <= _holes(part_of(f"hub-{servo}"), parts.TAP3 / 2)
    assert hub <= _holes(part_of("platter"), parts.M3 / 2)
    assert set(parts.HANGERS) <= _holes(part_of(f"servo_plate-{servo}"), parts.M3 / 2) & _holes(
        part_of("deck"), parts.M3 / 2
    )


def _common(one, other):
    a, b = one.bounding_box(), other.bounding_box()
    if any(
        getattr(a.min, axis) >= getattr(b.max, axis) or getattr(b.min, axis) >= getattr(a.max, axis) for axis in "XYZ"
    ):
        return 0.0
    both = one & other
    return 0.0 if both is None else sum(solid.volume for solid in both.solids())


@pytest.mark.parametrize("servo", SERVOS)
def test_nothing_collides_through_a_revolution(servo):
    items = table(servo) + frame()
    fixed = [item for item in items if not item.rotates]
    moving = [item for item in items if item.rotates]
    for group in (fixed, moving):
        for i, one in enumerate(group):
            for other in group[i + 1 :]:
                assert _common(one.solid, other.solid) < 0.1, (one.name, other.name)
    for angle in range(0, 360, 30 if servo == "xl430_w250" else 90):
        for one, other in product(moving, fixed):
            assert _common(one.rotated(angle), other.solid) < 0.1, (one.name, other.name, angle)


def test_mass_and_inertia_are_those_of_the_dimensions():
    """Also: the ringing fits them and the controller, and the rim is as thick as the simulated camera sees it."""
    density = PRINT["density_g_cm3"] * 1e-6
    rotating = [part_of("platter"), part_of("hub-xl430_w250")]
    assert density * sum(part.volume for part in rotating) == pytest.approx(TABLE["platter"]["mass_kg"], rel=0.02)
    inertia = density * 1e-6 * sum(part.matrix_of_inertia[2][2] for part in rotating)
    assert inertia == pytest.approx(TABLE["platter"]["inertia_kg_m2"], rel=0.02)
    stiffness = (2 * pi * TABLE["structure"]["frequency_hz"]) ** 2 * inertia  # N·m/rad
    assert stiffness == pytest.approx(1.5 / radians(servo_model("xl430_w250").stall_error_deg), rel=0.25)
    box = part_of("platter").bounding_box()
    assert pytest.approx(TABLE["platter"]["radius"]) == box.size.X / 2
    assert pytest.approx(TABLE["platter"]["thickness"]) == box.size.Z


def test_cable_fits_the_drum_at_both_limits():
    cable = TABLE["cable"]
    low, high = RigConfig().table.limits_deg
    layers = (cable["turns"] + high / 360) * cable["thickness"] / 2
    tight = cable["length"] / (2 * pi * (cable["turns"] + high / 360)) - layers
    loose = cable["length"] / (2 * pi * (cable["turns"] + low / 360)) + layers
    assert tight > TABLE["bearing"]["outer"] / 2 + 3.15  # the wall around the bearing
    assert loose < parts.DRUM_R
    free = PLATTER_Z - parts.DECK_Z - parts.DECK
    assert cable["width"] < free - parts.CLIP[2]  # whose screws are countersunk
    assert cable["width"] < free - 1.6 - 1.65  # IMU cover, and heads of ISO 7380


def test_camera_stands_where_the_simulator_has_it():
    """The lens of the assembly, its direction and the length of the post."""
    rotation = np.array(Optics().rotation).reshape(3, 3)
    assert rotation[2] == pytest.approx(
        [0, np.cos(radians(TABLE["camera"]["tilt_deg"])), -sin(radians(TABLE["camera"]["tilt_deg"]))]
    )
    y, z = camera_pivot()
    tilt = Rot(-TABLE["camera"]["tilt_deg"], 0, 0)
    lens = (Pos(0, y, z) * tilt * Pos(0, parts.LENS_FORWARD, parts.LENS_UP)).position
    assert np.array([lens.X, lens.Y, lens.Z]) == pytest.approx(
        rotation.T @ -np.array(Optics().translation_mm) + (0, 0, TOP_Z)
    )
    assert z + CLAMP_HALF <= PROFILE["side"] + PROFILE["post"]


def test_home_card_stands_where_the_simulator_has_it():
    board = home_mark(Optics())
    rotation, translation = board.pose(0.0)
    to_room, origin = Optics().to_camera(0.0)
    corner = to_room.T @ (translation - origin) + (0, 0, TOP_Z)
    across, down = (to_room.T @ rotation)[:, :2].T
    middle = corner + across * board.board.size_mm[0] / 2 + down * board.board.size_mm[1] / 2
    place = home_place()
    assert np.array([place.position.X, place.position.Y, place.position.Z]) == pytest.approx(middle)
    up = (place * Pos(0, 0, 1)).position - place.position
    assert np.array([up.X, up.Y, up.Z]) == pytest.approx(-down)
    (stand,) = (item.solid for item in table() if item.name == "stand of the home card")
    (card,) = (item.solid for item in table() if item.name == "home card")
    assert stand.distance_to(card) < 0.2


def test_guide_has_the_numbers_of_the_parts():
    guide = " ".join((DOCS / "how-to" / "build-the-table.md").read_text().split())
    near, far = RAIL_Y
    y, z = camera_pivot()
    front = y - parts.PIVOT_OUT
    # The other tilt: nearer, so that the post is long enough, with the platter's middle at the same place of the image.
    tilt, nearer = radians(20), 450 / TABLE["camera"]["distance"]
    _, down, away = nearer * np.array(Optics().translation_mm)
    steep = (0.0, down * sin(tilt) - away * cos(tilt), down * cos(tilt) + away * sin(tilt) + TOP_Z)
    its_y, its_z = camera_pivot(steep, 20)
    its_front = its_y - parts.PIVOT_OUT
    assert 20 in TABLE["camera"]["marks_deg"]
    assert its_z + CLAMP_HALF <= PROFILE["side"] + PROFILE["post"]
    own = SERVOS["xl430_w250"]
    under = parts.HORN_Z - own["horn_height"]
    board = CharucoBoard()
    card = TABLE["home_card"]
    for words in (
        f"{far:.0f} mm from this end, and {-near:.0f} mm from the other one",
        f"{-front:.0f} mm before the axis ({front - near:.0f} mm from the end of the rail)",
        f"{z:.0f} mm above the desk at the pivot",
        f"the lens is {parts.LENS[2]:.0f} mm above the desk and {-parts.LENS[1]:.0f} mm before the axis",
        f"The post's front {-its_front:.0f} mm before the axis ({its_front - near:.0f} mm from the end of the rail)",
        f"the pivot {its_z:.0f} mm above the desk",
        f"the lens {steep[2]:.0f} mm above it and {-steep[1]:.0f} mm before the axis",
        f"the plate hangs {parts.DECK_Z - under - parts.PLATE:.0f} mm below the deck",
        f"Below the servo, {under - own['body'][2] - parts.BASE_Z - parts.FLOOR:.0f} mm are free",
        f"plates {card['columns'] * 15 + 10} × {card['rows'] * 15 + 10} and "
        f"{board.size_mm[0] + 10:.0f} × {board.size_mm[1] + 10:.0f} mm, {card['thickness']:.0f} mm thick",
        f"profile 2020 with slot 6: {PROFILE['rail']:.0f}, {PROFILE['post']:.0f} and {PROFILE['bar']:.0f} mm",
        f"Wind {TABLE['cable']['length'] / 10:.0f} cm of the ribbon",
    ):
        assert words in guide


def test_wiring_diagram_is_that_of_the_code():
    assert (DOCS / "images" / "wiring.svg").read_text(encoding="utf-8") == wiring.picture()
