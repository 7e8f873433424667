"""The room around an orbiting camera: what changes with its azimuth, what stands, and the light."""

import numpy as np
import pytest

from sim.camera import SimCapture
from sim.objects.projection import TO_LIGHT
from sim.objects.shelf import shelf
from sim.objects.solid import empty_platter
from sim.room import room
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


def test_platter_under_the_object_stands() -> None:
    empty = empty_platter()
    on_platter = (empty != empty[0, 0]).any(axis=2)
    np.testing.assert_array_equal(room(0, 77.0)[on_platter], empty[on_platter])


LAMP_DEG = float(np.degrees(np.arctan2(TO_LIGHT[1], TO_LIGHT[0]))) + 90  # azimuth of a camera below the lamp


def lit(from_lamp_deg: float) -> tuple[float, float]:
    """Return the mean light on the left and the right half of a vase that is the same from all sides.

    The camera is ``from_lamp_deg`` counter-clockwise of the lamp.
    """
    world = World(noise=QUIET)
    capture: SimCapture = camera(world)
    capture.orbits = True
    world.slip(LAMP_DEG + from_lamp_deg)
    empty = frame(capture)
    world.put(shelf()["vase-blue"])
    seen = frame(capture)
    rows = slice(0, seen.shape[0] // 2)  # above the platter and its shadow
    vase = (np.abs(seen - empty).max(axis=2) > 8)[rows]
    middle = round(float(np.flatnonzero(vase.any(axis=0)).mean()))
    halves = ((seen[rows, part], vase[:, part]) for part in (slice(None, middle), slice(middle, None)))
    left, right = (float(pixels[inside].mean()) for pixels, inside in halves)
    return left, right


def test_lamp_stays_in_the_room() -> None:
    """The vase is brightest from the lamp's side and darkest from the other; between them the lamp is at one side."""
    front, behind = lit(0.0), lit(180.0)
    assert front[0] == pytest.approx(front[1], rel=0.15)  # the highlight at the left is painted
    assert behind[0] == pytest.approx(behind[1], rel=0.15)
    from_right, from_left = lit(90.0), lit(-90.0)
    assert from_right[0] > 1.2 * from_right[1]
    assert from_left[1] > 1.2 * from_left[0]
    means = [np.mean(halves) for halves in (front, from_right, from_left, behind)]
    assert means[0] > 1.2 * max(means[1:3])
    assert min(means[1:3]) > 1.1 * means[3]
