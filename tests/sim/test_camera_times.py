"""The times of the simulated camera: buffers, stamps, the rows of the rolling shutter."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.camera import READOUT_NS, SimCapture
from sim.frame_times import FPS, row_weights, start_ns
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.objects.projection import CENTRE_PX, PX_PER_MM
from sim.world import World
from tests.fuzzing import examples
from tests.sim.drawn_camera import QUIET, Spot, camera, frame, grey, stamp_ns


def test_frames_come_at_thirty_a_second_with_the_time_of_their_exposure() -> None:
    world = World(noise=QUIET)
    capture = camera(world)
    for k in range(1, 40):
        assert capture.grab()
        assert stamp_ns(capture) == start_ns(k - 1) == (k - 1) * 1_000_000 // 30 * 1000
        assert world.clock.now_ns() == stamp_ns(capture) + 10_000_000 + READOUT_NS


def test_unfetched_frames_fill_four_buffers_and_later_ones_are_lost() -> None:
    world = World(noise=QUIET)
    capture = camera(world)
    capture.grab()
    first = stamp_ns(capture)
    world.clock.sleep(2.0)
    now_ns = world.clock.now_ns()
    stamps = []
    for _ in range(6):
        capture.grab()
        stamps.append(stamp_ns(capture))
    assert stamps[:4] == pytest.approx([first + k * 1e9 / FPS for k in range(1, 5)], abs=1001)
    assert world.clock.now_ns() > now_ns  # the four were there at once, the others had to be waited for
    assert stamps[4] > now_ns - 60_000_000
    assert stamps[5] > stamps[4]


@examples(6)
@given(st.lists(st.integers(0, 400_000_000), min_size=1, max_size=12))
def test_stamps_rise_and_no_frame_comes_before_it_is_exposed(waits_ns: list[int]) -> None:
    world = World(noise=QUIET.with_values(lost_frames=0.3))
    capture = camera(world)
    last = -1
    for wait_ns in waits_ns:
        world.clock.advance_to(world.clock.now_ns() + wait_ns)
        assert capture.grab()
        assert last < stamp_ns(capture) <= world.clock.now_ns() - READOUT_NS
        last = stamp_ns(capture)


def test_lost_frames_do_not_arrive() -> None:
    capture = camera(World(noise=QUIET.with_values(lost_frames=0.5)))
    stamps_ns = []
    for _ in range(40):
        assert capture.grab()
        stamps_ns.append(stamp_ns(capture))
    assert 1.5 < (stamps_ns[-1] - stamps_ns[0]) * FPS * 1e-9 / 39 < 2.6  # frames from one that arrives to the next


def test_old_frame_shows_the_world_at_its_exposure() -> None:
    world = World(noise=QUIET)
    world.put(grey(50))
    capture = camera(world)
    world.clock.sleep(1.0)
    world.put(grey(200))
    world.clock.sleep(1.0)
    ok, old = capture.read()
    assert ok
    assert old is not None
    assert (old == 50).all()
    assert (frame(capture) == 200).all()


def test_unplugged_camera_delivers_nothing() -> None:
    capture = camera(World(noise=QUIET))
    assert capture.read()[0]
    capture.unplug()
    assert capture.read() == (False, None)
    assert capture.isOpened()  # as OpenCV's V4L2 backend says
    assert (capture.node(), capture.get(cv2.CAP_PROP_GAIN)) == (None, -1)
    capture.replug()
    assert not capture.grab()  # only after it was opened again
    assert capture.reopen()
    assert (capture.node(), capture.grab()) == ((2,), True)


def rows_of_spot(noise: NoiseModel, seed: int = 0) -> tuple[NDArray[np.float64], float]:
    """Return in which column each row of a frame in motion shows the spot, and degrees of rotation per millisecond."""
    world = World(noise=noise, seed=seed)
    world.put(Spot())
    capture = camera(world, EXPOSURE=20)
    world.clock.sleep(1.0)
    world.drive(to_velocity(world.clock.now_ns() * 1e-9, 0.0, 0.0, 60.0, 1e6))
    for _ in range(6):  # the buffers are from before
        assert capture.grab()
    stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
    image = capture.retrieve()[1]
    assert image is not None
    grey = image[100:300, :, 0].astype(float)
    columns = (grey * np.arange(640)).sum(axis=1) / grey.sum(axis=1)
    lever = PX_PER_MM * 80
    seen_deg = np.degrees(np.arcsin((columns - CENTRE_PX[0]) / lever))
    middle_ns = stamp_ns + 1_000_000 + round(noise.camera_readout_ms * 1e6 / 480) * np.arange(100, 300)
    return seen_deg - world.table_angles(middle_ns), 0.06


def test_rows_are_exposed_one_after_the_other() -> None:
    error, _ = rows_of_spot(QUIET.with_values(camera_readout_ms=11.1))
    assert np.abs(error).max() < 0.06
    global_shutter, _ = rows_of_spot(QUIET)
    assert np.abs(global_shutter).max() < 0.06


def test_exposure_begins_before_the_stamp_by_offset_and_jitter() -> None:
    offsets = [-rows_of_spot(QUIET.with_values(stamp_offset_ms=5.0), seed)[0].mean() / 0.06 for seed in range(4)]
    drawn = [SimCapture(World(noise=NoiseModel(stamp_offset_ms=5.0), seed=s)).times.offset_ns * 1e-6 for s in range(4)]
    assert offsets == pytest.approx(drawn, abs=1.0)


def test_mean_time_of_each_row_is_the_middle_of_its_exposure() -> None:
    for steps in (2, 3, 8):
        times, weights = row_weights(10_000_000, 18_000_000, steps, 480)
        middles = (np.arange(480) + 0.5) / 480 * 18e6 + 5e6
        assert weights.min() >= 0
        assert np.abs(times @ weights - middles).max() < 100
