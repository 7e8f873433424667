"""The room around an orbiting camera: what changes with its azimuth, what stands, and the light."""

import numpy as np
import pytest

from sim.camera import SimCapture
from sim.objects.projection import Image
from sim.objects.shelf import shelf
from sim.objects.solid import empty_platter
from sim.room import relight, room
from sim.world import World
from tests.sim.drawn_camera import QUIET, camera, frame


def changed_share(orbits: bool, object_name: str | None = None) -> float:
    """Return the share of the pixels that change by more than 8 levels when the table rotates by 90°."""
    world = World(noise=QUIET)
    capture: SimCapture = camera(world)
    capture.orbits = orbits
    world.put(None if object_name is None else shelf()[object_name])
    before = frame(capture)
    world.slip(90.0)
    return float((np.abs(frame(capture) - before).max(axis=2) > 8).mean())


def test_most_of_the_background_changes_over_90_degrees_only_for_an_orbiting_camera() -> None:
    assert changed_share(orbits=True) > 0.5
    assert changed_share(orbits=False) == 0.0
    assert changed_share(orbits=False, object_name="mug-star") < 0.1


def test_room_depends_on_the_seed_only_and_closes_after_a_revolution() -> None:
    np.testing.assert_array_equal(room(3, 20.0), room(3, 380.0))
    assert (room(3, 20.0) != room(4, 20.0)).mean() > 0.5


def shift_px(rows: slice) -> float:
    """Return by how much these rows move to the right when the room rotates by 1°."""
    before, after = (room(0, angle)[rows, 100:540].astype(float) for angle in (0.0, 1.0))
    shifts = range(-20, 21)
    return min(shifts, key=lambda by: np.abs(np.roll(before, by, axis=1) - after)[:, 20:-20].mean())


def test_wall_behind_the_axis_moves_against_the_front_of_the_object() -> None:
    """A counter-clockwise rotation moves the front of an object to the right, and the wall behind to the left."""
    assert shift_px(slice(0, 100)) == pytest.approx(-450 * np.radians(1.0) * 2, abs=2.0)


def test_platter_under_the_object_stands() -> None:
    empty = empty_platter()
    on_platter = (empty != empty[0, 0]).any(axis=2)
    for angle in (0.0, 77.0):
        np.testing.assert_array_equal(room(0, angle)[on_platter], empty[on_platter])


def lit(rotated_deg: float) -> tuple[float, float]:
    """Return the mean light on the left and the right half of a white card under the room's lamp."""
    empty: Image = np.full((480, 640, 3), 40, dtype=np.uint8)
    image = empty.copy()
    image[100:300, 220:420] = 120
    relight(image, empty, rotated_deg)
    return float(image[100:300, 220:320].mean()), float(image[100:300, 320:420].mean())


def test_lamp_stays_in_the_room() -> None:
    """It is at the front left of the first view; a quarter of a revolution moves it to the front right, half behind."""
    assert lit(0.0) == pytest.approx((120.0, 120.0), abs=1.0)
    left, right = lit(90.0)
    assert right > left + 40
    assert np.mean(lit(180.0)) < 90
