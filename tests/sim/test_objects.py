"""The built-in objects: geometry, orientation, symmetry, and differences."""

from collections.abc import Iterable

import cv2
import numpy as np
import pytest
from hypothesis import strategies as st

from hbr import describe, tanimoto
from sim.objects.paint import Sheet, painted
from sim.objects.polyhedron import box, lying_cylinder
from sim.objects.projection import CENTRE_PX, COS, PX_PER_MM, SIN, Image
from sim.objects.revolution import Revolution
from sim.objects.shelf import CONFUSABLE, MORE_CONFUSABLE, shelf, twins
from sim.objects.solid import Part, Solid, empty_platter
from sim.objects.tube import Tube


def some(names: Iterable[str]) -> list[object]:
    """Return every fourth name for the default tests, and the others for the nightly tests."""
    return [name if i % 4 == 0 else pytest.param(name, marks=pytest.mark.nightly) for i, name in enumerate(names)]


RED, BLUE = (30, 30, 220), (220, 30, 30)
GREY, GREEN, YELLOW, WHITE = (150, 150, 148), (70, 140, 50), (50, 205, 240), (238, 240, 240)


def render(solid: Solid, azimuth_deg: float, offset_mm: tuple[float, float] = (0.0, 0.0)) -> Image:
    image = empty_platter()
    solid.draw(image, azimuth_deg, offset_mm)
    return image


def middle(image: Image, colour: tuple[int, int, int]) -> tuple[float, float]:
    """Return the centroid (x, y) of the pixels with the hue of ``colour``, with any shading."""
    hue = np.array(colour, dtype=float) / np.linalg.norm(colour)
    pixels = image.astype(float)
    length = np.linalg.norm(pixels, axis=2)
    y, x = np.nonzero((pixels @ hue > 0.97 * length) & (length > 60))
    assert len(x) > 20, "the colour is not to be seen"
    return float(x.mean()), float(y.mean())


def difference(a: Image, b: Image) -> float:
    return cv2.norm(a, b, cv2.NORM_L1) / a.size


def solid(*parts: Part) -> Solid:
    return Solid("sample", parts)


HALVES = painted(BLUE, [["panel", 0.0, 0.0, 0.5, 1.0, RED]])
PATCH = painted(GREY, [["panel", 0.48, 0.4, 0.52, 0.6, RED]])
CYLINDER = solid(Revolution(((50.0, 100.0), (50.0, 0.0)), PATCH))
DIE = solid(box((80, 80, 80), (RED, BLUE, GREEN, YELLOW), top=WHITE))


# -- geometry and orientation -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("azimuth_deg", [-60.0, -30.0, 0.0, 30.0, 60.0, 390.0])
def test_mark_on_a_rotated_body_is_where_the_projection_puts_it(azimuth_deg: float) -> None:
    a = np.radians(azimuth_deg)
    x, y = middle(render(CYLINDER, azimuth_deg), RED)
    assert x == pytest.approx(CENTRE_PX[0] + 50 * np.sin(a) * PX_PER_MM, abs=1.5)
    assert y == pytest.approx(CENTRE_PX[1] - (50 * COS - 50 * np.cos(a) * SIN) * PX_PER_MM, abs=1.5)


@pytest.mark.parametrize(
    "part",
    [
        Revolution(((40.0, 80.0), (40.0, 0.0)), HALVES),
        box((80, 80, 80), (HALVES, RED, RED, RED), top=GREY),
        lying_cylinder(40, 60, wall=GREY, end=HALVES, at=(0, 30, 40)),
    ],
    ids=["revolution", "box", "lying cylinder"],
)
def test_prints_are_not_mirrored(part: Part) -> None:
    image = render(solid(part), 0.0)
    assert middle(image, RED)[0] < CENTRE_PX[0] - 10 < CENTRE_PX[0] + 10 < middle(image, BLUE)[0]


def test_offset_moves_an_object_across_the_platter() -> None:
    x0, y0 = middle(render(DIE, 0.0), RED)
    for offset, move in (((10.3, 0.0), (20.6, 0.0)), ((0.0, 12.0), (0.0, -24 * SIN))):
        x, y = middle(render(DIE, 0.0, offset), RED)
        assert (x - x0, y - y0) == pytest.approx(move, abs=0.3)


def test_rotated_body_moves_by_fractions_of_a_pixel() -> None:
    def position(offset: float) -> float:
        image = np.zeros((480, 640, 3), dtype=np.uint8)
        CYLINDER.draw(image, 0.0, (offset, 0.0))
        light = image.sum(axis=(0, 2), dtype=float)
        return float((light * np.arange(640)).sum() / light.sum())

    for offset in (0.05, 0.1, 0.2, 0.35):  # grey levels are whole numbers: slow shading lags behind the edges
        assert position(offset) - position(0.0) == pytest.approx(offset * PX_PER_MM, rel=0.25)


def test_near_side_of_a_handle_covers_its_body_and_the_far_side_is_covered() -> None:
    mug = solid(CYLINDER.parts[0], Tube(((0, -50, 80, 4), (0, -70, 60, 4), (0, -50, 20, 4)), RED))
    facing, away = render(mug, 0.0), render(mug, 180.0)
    assert middle(facing, RED)[0] == pytest.approx(CENTRE_PX[0], abs=1.0)
    bare = render(solid(CYLINDER.parts[0]), 180.0)
    body = np.s_[230:390, 225:415]
    np.testing.assert_array_equal(away[body], bare[body])


def test_inside_of_a_vessel_is_seen_through_its_mouth() -> None:
    outside, floor = ((45.0, 60.0), (48.0, 60.0), (48.0, 0.0)), ((45.0, 60.0), (45.0, 5.0), (0.0, 5.0))
    image = render(solid(Revolution(outside, painted(BLUE), inside=floor, lining=RED)), 0.0)
    # The mouth is an ellipse about the rim's middle.
    assert middle(image, RED)[1] == pytest.approx(CENTRE_PX[1] - 60 * COS * PX_PER_MM, abs=3.0)


def test_box_rotates_counter_clockwise_from_above_and_shows_the_named_sides() -> None:
    positions = [middle(render(DIE, azimuth), RED)[0] for azimuth in (-40.0, -20.0, 0.0, 20.0, 40.0)]
    assert positions == sorted(positions)
    for azimuth, colour in ((0.0, RED), (-90.0, BLUE), (180.0, GREEN), (90.0, YELLOW)):
        assert middle(render(DIE, azimuth), colour)[0] == pytest.approx(CENTRE_PX[0], abs=1.0)


# -- the shelf --------------------------------------------------------------------------------------------------------


def test_built_in_objects_include_symmetric_and_confusable_ones() -> None:
    objects = shelf()
    assert len(objects) >= 24
    assert all(name == solid.name for name, solid in objects.items())
    assert len([t for t in objects.values() if t.symmetry_deg == 0]) >= 3
    assert {t.symmetry_deg for t in objects.values()} >= {0.0, 90.0, 180.0, 360.0}
    assert all(a in objects and b in objects for a, b in CONFUSABLE)


@pytest.mark.parametrize("name", some(shelf()))
def test_every_object_fits_the_frame_and_rotates_smoothly(name: str) -> None:
    solid, empty = shelf()[name], empty_platter()
    for azimuth in (0.0, 77.0, 201.0):
        image = render(solid, azimuth, (3.0, 2.0))
        changed = (image != empty).any(axis=2)
        assert changed.mean() > 0.03
        assert changed[4:-4, 4:-4].sum() == changed.sum()
        little = difference(image, render(solid, azimuth + 0.1, (3.0, 2.0)))
        much = difference(image, render(solid, azimuth + 3.0, (3.0, 2.0)))
        assert little <= 0.35 * much + 0.02


@pytest.mark.parametrize("name", [n for n, t in shelf().items() if t.symmetry_deg < 360])
def test_symmetric_objects_look_the_same_after_their_rotation(name: str) -> None:
    solid = shelf()[name]
    rotation = solid.symmetry_deg or 41.3
    for azimuth in (0.0, 17.0):
        a, b = render(solid, azimuth), render(solid, azimuth + rotation)
        assert difference(a, b) < 0.1
        assert tanimoto(describe(a), describe(b)).item() > 0.99


@pytest.mark.parametrize(("one", "other"), CONFUSABLE)
def test_confusable_objects_differ_from_some_sides_only(one: str, other: str) -> None:
    a, b = shelf()[one], shelf()[other]
    apart = np.array([difference(render(a, o), render(b, o)) for o in np.arange(0.0, 360.0, 20.0)])
    assert 0.25 <= (apart < 0.02).mean() <= 0.9
    assert apart.max() > 0.3


@pytest.mark.parametrize(("one", "other"), MORE_CONFUSABLE)
def test_further_twins_differ_little_but_visibly(one: str, other: str) -> None:
    apart = [difference(render(twins()[one], o), render(twins()[other], o)) for o in (0.0, 90.0, 180.0, 270.0)]
    assert 0.02 < max(apart) < 4


def test_profiles_meet_the_requirements_of_tracing() -> None:
    for solid in shelf().values():
        for part in solid.parts:
            if isinstance(part, Revolution):
                assert (np.diff([h for _, h in part.profile]) <= 1e-9).all(), solid.name
                assert (np.diff([h for _, h in part.inside]) <= 1e-9).all(), solid.name
                assert not part.inside or part.inside[0] == part.profile[0], solid.name


# -- curves and brushes -----------------------------------------------------------------------------------------------

points = st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), min_size=2, max_size=8)


def test_shapes_run_over_the_seam_of_a_sheet() -> None:
    seam, centre = Sheet((60, 120), (0, 0, 0)), Sheet((60, 120), (0, 0, 0))
    for sheet, u in ((seam, 0.0), (centre, 0.5)):
        sheet.disc(u, 0.4, 0.3, (255, 255, 255))
        sheet.star(u, 0.8, 0.15, (0, 255, 0))
    # Only the smoothed edges on the seam itself differ.
    assert difference(np.roll(seam.pixels, 60, axis=1), centre.pixels) < 0.1
