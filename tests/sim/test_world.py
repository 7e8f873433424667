"""The world: one motion for all devices, now and in the past, and the scene on the platter."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.motion import to_position
from sim.noise import NoiseModel
from sim.world import HISTORY_S, Scene, World
from tests.fuzzing import examples

quick = examples(7)
perfect = NoiseModel.none()


def drive(world: World, goal: float, v_max: float = 60.0, a_max: float = 300.0) -> None:
    """Send the shaft to ``goal`` from its present angle."""
    world.drive(to_position(world.clock.now_ns() * 1e-9, *world.shaft(), goal, v_max, a_max))


moves = st.lists(st.tuples(st.floats(-400, 400), st.floats(0.01, 3.0)), min_size=1, max_size=5)


def run(moves_made: list[tuple[float, float]], noise: NoiseModel, view: Callable[[World], None]) -> World:
    world = World(noise=noise)
    for goal, seconds in moves_made:
        drive(world, goal)
        world.clock.sleep(seconds)
        view(world)
    return world


@quick
@given(moves)
def test_past_does_not_change(moves_made: list[tuple[float, float]]) -> None:
    seen: list[tuple[int, float]] = []
    world = run(moves_made, NoiseModel(), lambda w: seen.append((w.clock.now_ns(), w.table_deg())))
    kept = [(t, angle) for t, angle in seen if t > world.clock.now_ns() - HISTORY_S * 1e9]
    times = [t for t, _ in kept]
    assert world.table_angles(times) == pytest.approx([angle for _, angle in kept], abs=1e-9)
    assert [world.table_deg(t) for t in times] == pytest.approx([angle for _, angle in kept], abs=1e-9)


@quick
@given(moves, st.integers(2, 200))
def test_reading_the_world_changes_nothing(moves_made: list[tuple[float, float]], views: int) -> None:
    def stare(world: World) -> None:
        for t in np.linspace(0, world.clock.now_ns(), views).astype(np.int64):
            world.table_deg(int(t))

    watched = run(moves_made, NoiseModel(), stare)
    unwatched = run(moves_made, NoiseModel(), lambda _: None)
    assert watched.table_deg() == unwatched.table_deg()


def test_interrupted_motion_continues_without_a_jump() -> None:
    world = World(noise=NoiseModel(backlash_deg=0.5, structure_hz=11.0))
    drive(world, 90.0)
    world.clock.sleep(0.7)
    before = world.table_deg()
    drive(world, -90.0)
    assert world.table_deg() == pytest.approx(before, abs=1e-9)
    world.clock.sleep(6.0)
    assert world.shaft() == (-90.0, 0.0)
    assert world.table_deg() == pytest.approx(-90.0 + 0.25, abs=1e-3)


def test_slip_rotates_the_platter_and_not_the_shaft() -> None:
    world = World(noise=perfect)
    drive(world, 30.0)
    world.clock.sleep(2.0)
    slipped_ns = world.clock.now_ns()
    world.slip(-4.0, seconds=0.1)
    assert world.table_deg() == pytest.approx(30.0)
    world.clock.sleep(0.05)
    now_ns = world.clock.now_ns()
    assert world.table_angles([now_ns - 25_000_000, now_ns]) == pytest.approx([29.0, 28.0])  # at a constant rate
    world.clock.sleep(0.45)
    assert world.shaft()[0] == 30.0
    now_ns = world.clock.now_ns()
    assert world.table_angles([now_ns - 300_000_000, now_ns]) == pytest.approx([26.0, 26.0])
    assert world.table_deg(slipped_ns) == pytest.approx(30.0)
    world.slip(1.0)
    drive(world, 60.0)
    world.clock.sleep(2.0)
    assert world.table_deg() == pytest.approx(57.0)


# -- the scene -----------------------------------------------------------------------------------------------------


class Mug:
    name = "mug"


def test_past_scenes_do_not_change() -> None:
    world = World(noise=perfect)
    dark = (0.1, 0.1, 0.1)
    world.clock.sleep(1.0)
    world.put(Mug())
    world.clock.sleep(1.0)
    world.change(light=dark)
    world.clock.sleep(1.0)
    assert world.scene.light == dark
    world.change(light=(1.0, 1.0, 1.0))
    world.clock.sleep(1.0)
    lights = [world.scene_at(t).light for t in (500_000_000, 1_500_000_000, 2_500_000_000, 3_500_000_000)]
    assert lights == [(1.0, 1.0, 1.0), (1.0, 1.0, 1.0), dark, (1.0, 1.0, 1.0)]
    assert world.scene_at(500_000_000) == Scene()
    assert world.scene_at(2_500_000_000).object is world.scene.object


# -- randomness ----------------------------------------------------------------------------------------------------
