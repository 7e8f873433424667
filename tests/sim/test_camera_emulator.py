"""The simulated camera: time, image formation, settings, and that the same seed gives the same bytes."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.camera import READOUT_NS, SimCapture
from sim.frame_times import FPS, start_ns
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.objects.projection import CENTRE_PX, PX_PER_MM, Image
from sim.objects.shelf import shelf
from sim.rolling_shutter import row_weights
from sim.sensor import white_balance
from sim.world import World
from tests.fuzzing import examples

QUIET = NoiseModel.none()


@dataclass(frozen=True)
class Card:
    """Fills the frame with a picture, whatever the table does."""

    picture: Image
    name: str = "card"

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        image[:] = self.picture


@dataclass(frozen=True)
class Spot:
    """A bright upright line 80 mm from the axis, smooth enough to be placed between pixels."""

    name: str = "spot"

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        image[:] = 0
        x = CENTRE_PX[0] + PX_PER_MM * (80 * np.sin(np.radians(azimuth_deg)) + offset_mm[0])
        image[100:300] = np.round(250 * np.exp(-((np.arange(640) - x) ** 2) / 18)).astype(np.uint8)[None, :, None]


def grey(level: int) -> Card:
    return Card(np.full((480, 640, 3), level, dtype=np.uint8))


def camera(world: World, **values: float) -> SimCapture:
    """Return a camera in manual mode: 10 ms, 0 dB, 5000 K, unless said otherwise."""
    capture = SimCapture(world)
    assert capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    assert capture.set(cv2.CAP_PROP_AUTO_WB, 0)
    for name, value in ({"EXPOSURE": 100, "WB_TEMPERATURE": 5000} | values).items():
        assert capture.set(getattr(cv2, f"CAP_PROP_{name}"), value)
    return capture


def frame(capture: SimCapture) -> NDArray[np.float64]:
    """Return the next frame that is exposed entirely under what holds now."""
    capture._clock.sleep(0.5)
    for _ in range(5):  # the buffers
        assert capture.grab()
    ok, image = capture.retrieve()
    assert ok
    assert image is not None
    return image.astype(np.float64)


def stamp_ns(capture: SimCapture) -> int:
    return round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)


# -- time -------------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("buffers", [1, 2, 10])
def test_number_of_buffers_can_be_chosen(buffers: int) -> None:
    world = World(noise=QUIET)
    capture = camera(world, BUFFERSIZE=buffers)
    world.clock.sleep(1.0)
    asked_ns = world.clock.now_ns()
    at_once = 0
    while capture.grab() and world.clock.now_ns() == asked_ns:
        at_once += 1
    assert at_once == buffers


@examples(6)
@given(st.lists(st.integers(0, 400_000_000), min_size=1, max_size=12))
def test_stamps_rise_and_no_frame_comes_before_it_is_exposed(waits_ns: list[int]) -> None:
    world = World(noise=QUIET)
    capture = camera(world)
    last = -1
    for wait_ns in waits_ns:
        world.clock.advance_to(world.clock.now_ns() + wait_ns)
        assert capture.grab()
        assert last < stamp_ns(capture) <= world.clock.now_ns() - READOUT_NS
        last = stamp_ns(capture)


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


# -- geometry and motion ----------------------------------------------------------------------------------------------


def centre(image: NDArray[np.float64]) -> tuple[float, float]:
    """Return mean and spread of the light across the image, in pixels."""
    light = image.sum(axis=(0, 2))
    x = np.arange(640)
    mean = float((light * x).sum() / light.sum())
    return mean, float(np.sqrt((light * (x - mean) ** 2).sum() / light.sum()))


def test_object_and_its_offset_rotate_with_the_table() -> None:
    world = World(noise=QUIET)
    capture = camera(world)
    world.put(Spot(), yaw_deg=20.0)
    assert centre(frame(capture))[0] == pytest.approx(320 + 160 * np.sin(np.radians(20)), abs=0.2)
    world.slip(15.0)
    assert centre(frame(capture))[0] == pytest.approx(320 + 160 * np.sin(np.radians(35)), abs=0.2)
    world = World(noise=QUIET)
    capture = camera(world)
    world.put(Spot(), offset_mm=(0.0, 10.0))
    assert centre(frame(capture))[0] == pytest.approx(320, abs=0.2)
    world.slip(-90.0)  # what was behind the axis is now to its right
    world.change(yaw_deg=90.0)
    assert centre(frame(capture))[0] == pytest.approx(320 + 20, abs=0.2)


def test_motion_blurs_and_rest_does_not() -> None:
    world = World(noise=QUIET)
    world.put(Spot())
    capture = camera(world, EXPOSURE=200)
    _, sharp = centre(frame(capture))
    world.drive(to_velocity(world.clock.now_ns() * 1e-9, 0.0, 0.0, 90.0, 1e9))
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    capture.grab()
    image = capture.retrieve()[1]
    assert image is not None
    position, blurred = centre(image.astype(float))
    begin, end = (world.table_deg(stamp_ns(capture) + t) for t in (0, 20_000_000))
    path = [320 + 160 * np.sin(np.radians(a)) for a in (begin, end)]
    assert position == pytest.approx(np.mean(path), abs=0.3)
    # A uniform smear of this length:
    assert np.sqrt(blurred**2 - sharp**2) == pytest.approx((path[1] - path[0]) / np.sqrt(12), rel=0.1)
    world.drive(to_velocity(world.clock.now_ns() * 1e-9, world.table_deg(), 90.0, 0.0, 1e9))
    assert centre(frame(capture))[1] == pytest.approx(sharp, rel=0.05)


# -- light ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.5, 1.5, 2.0])
def test_exposure_and_light_act_linearly(factor: float) -> None:
    world = World(noise=QUIET)
    world.put(grey(80))
    np.testing.assert_allclose(frame(camera(world, EXPOSURE=round(100 * factor))), 80 * factor, atol=0.5)
    world.change(light=(factor, 1.0, 1.0))
    assert frame(camera(world)).mean(axis=(0, 1)) == pytest.approx([80 * factor, 80, 80], abs=0.5)


def test_gain_is_in_decibel() -> None:
    world = World(noise=QUIET)
    world.put(grey(60))
    np.testing.assert_allclose(frame(camera(world, GAIN=6)), 60 * 10 ** (6 / 20), atol=0.5)


def test_white_balance_scales_the_channels() -> None:
    world = World(noise=QUIET)
    for level in (60, 120):
        world.put(grey(level))
        for kelvin in (3500, 5000, 6500):
            gains = white_balance(kelvin)
            assert frame(camera(world, WB_TEMPERATURE=kelvin)).mean(axis=(0, 1)) == pytest.approx(
                level * np.array(gains), abs=0.5
            )
    assert white_balance(5000) == pytest.approx((1, 1, 1))
    blue, green, red = white_balance(3500)  # tungsten light lacks blue, so the camera adds it
    assert blue > green > red


def test_wrong_focus_blurs() -> None:
    world = World(noise=QUIET)
    world.put(Spot())
    capture = camera(world)
    _, sharp = centre(frame(capture))
    capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)
    capture.set(cv2.CAP_PROP_FOCUS, 40)
    assert centre(frame(capture))[1] > 1.3 * sharp
    capture.set(cv2.CAP_PROP_AUTOFOCUS, 1)
    world.clock.sleep(2)
    assert centre(frame(capture))[1] == pytest.approx(sharp, rel=0.05)


def test_vignetting_darkens_the_corners_by_its_share() -> None:
    world = World(noise=QUIET.with_values(vignetting=0.3))
    world.put(grey(200))
    image = frame(camera(world))
    assert image[239:241, 319:321] == pytest.approx(200, abs=1)
    for corner in (image[0, 0], image[0, -1], image[-1, 0], image[-1, -1]):
        assert corner == pytest.approx(140, abs=1)


def test_flicker_changes_the_brightness_of_whole_frames() -> None:
    world = World(noise=QUIET.with_values(light_flicker=0.02))
    world.put(grey(128))
    capture = camera(world)
    levels = np.array([frame(capture).mean() for _ in range(60)])
    assert levels.std() / 128 == pytest.approx(0.02, rel=0.35)


# -- noise ------------------------------------------------------------------------------------------------------------


def variance(noise: NoiseModel, level: int, **values: float) -> float:
    """Return a pixel's variance in time from two frames of a grey card (photon transfer), quantisation taken off."""
    world = World(noise=noise, seed=5)
    world.put(grey(level))
    capture = camera(world, **values)
    return float(np.var(frame(capture) - frame(capture)) / 2 - 1 / 12)


def test_variance_grows_with_the_signal_as_shot_noise_does() -> None:
    noise = QUIET.with_values(full_well_e=4000, read_noise_e=20)
    volts = 255 / 4000
    for level in (20, 60, 120, 200):
        assert variance(noise, level) == pytest.approx(volts * level + (volts * 20) ** 2, rel=0.03)
    # The gain amplifies signal and noise alike: the same electrons, four times the variance.
    assert variance(noise, 50, GAIN=6) == pytest.approx(10**0.6 * variance(noise, 50), rel=0.05)


def test_either_noise_can_be_switched_off() -> None:
    assert variance(QUIET.with_values(read_noise_e=60), 40) == pytest.approx((60 * 255 / 10000) ** 2, rel=0.05)
    assert variance(QUIET.with_values(read_noise_e=60), 200) == pytest.approx((60 * 255 / 10000) ** 2, rel=0.05)
    assert variance(QUIET.with_values(full_well_e=2000), 100) == pytest.approx(100 * 255 / 2000, rel=0.03)
    world = World(noise=QUIET)
    world.put(grey(77))
    assert (frame(camera(world)) == 77).all()


def test_noise_is_new_in_every_frame() -> None:
    world = World(noise=QUIET.with_values(full_well_e=4000))
    world.put(grey(120))
    capture = camera(world)
    frames = [frame(capture)[::3, ::3].ravel() - 120 for _ in range(6)]
    correlation = np.corrcoef(frames)
    assert np.abs(correlation[~np.eye(6, dtype=bool)]).max() < 0.03


def test_same_seed_gives_the_same_bytes_for_any_number_of_frames() -> None:
    def last(seed: int, *, view_all: bool) -> Image:
        world = World(seed=seed)
        world.put(shelf()["mug-star"], 30.0)
        capture = camera(world)
        for _ in range(8):
            capture.grab()
            if view_all:
                capture.retrieve()
        image = capture.retrieve()[1]
        assert image is not None
        return image

    np.testing.assert_array_equal(last(3, view_all=True), last(3, view_all=False))
    assert (last(3, view_all=False) != last(4, view_all=False)).mean() > 0.3


# -- settings ---------------------------------------------------------------------------------------------------------


def test_automatic_settings_drift_with_the_scene_until_they_are_off() -> None:
    world = World(noise=QUIET)
    capture = SimCapture(world)
    settled = []
    for colour in ((30, 40, 160), (220, 200, 60)):
        world.put(Card(np.full((480, 640, 3), colour, dtype=np.uint8)))
        world.clock.sleep(5.0)
        settled.append((capture.get(cv2.CAP_PROP_EXPOSURE), capture.get(cv2.CAP_PROP_WB_TEMPERATURE)))
    assert settled[0][0] > 1.3 * settled[1][0]
    assert settled[0][1] < 0.8 * settled[1][1]

    capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    capture.set(cv2.CAP_PROP_AUTO_WB, 0)
    world.put(grey(20))
    world.clock.sleep(5.0)
    assert (capture.get(cv2.CAP_PROP_EXPOSURE), capture.get(cv2.CAP_PROP_WB_TEMPERATURE)) == settled[1]


def test_automatic_exposure_does_not_depend_on_reading_frames() -> None:
    def exposure(views: int) -> float:
        world = World(noise=QUIET)
        world.put(shelf()["teapot"])
        capture = SimCapture(world)
        for _ in range(views):
            world.clock.advance_to(world.clock.now_ns() + 3_000_000_000 // views)
            capture.read()
        world.clock.advance_to(4_000_000_000)
        return capture.get(cv2.CAP_PROP_EXPOSURE)

    assert exposure(1) == exposure(7) == exposure(60)


def test_automatic_and_unknown_settings_cannot_be_set_and_values_are_clipped() -> None:
    capture = SimCapture(World(noise=QUIET))
    capture.drift(autofocus=True)
    assert not capture.set(cv2.CAP_PROP_EXPOSURE, 50)
    assert not capture.set(cv2.CAP_PROP_WB_TEMPERATURE, 4000)
    assert not capture.set(cv2.CAP_PROP_FOCUS, 10)
    assert capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    assert capture.set(cv2.CAP_PROP_EXPOSURE, 50)
    assert capture.get(cv2.CAP_PROP_EXPOSURE) == 50
    assert capture.set(cv2.CAP_PROP_AUTO_WB, 0)
    capture.set(cv2.CAP_PROP_EXPOSURE, 5000)
    assert capture.get(cv2.CAP_PROP_EXPOSURE) == 333
    capture.set(cv2.CAP_PROP_WB_TEMPERATURE, 9000)
    assert capture.get(cv2.CAP_PROP_WB_TEMPERATURE) == 6500
    assert not capture.set(cv2.CAP_PROP_ZOOM, 2)
    assert capture.get(cv2.CAP_PROP_ZOOM) == -1
    assert not capture.set(cv2.CAP_PROP_FRAME_WIDTH, 1280)
    assert capture.get(cv2.CAP_PROP_FRAME_WIDTH) == 640


def test_setting_acts_on_frames_exposed_after_it() -> None:
    world = World(noise=QUIET)
    world.put(grey(100))
    capture = camera(world)
    world.clock.sleep(0.5)
    capture.set(cv2.CAP_PROP_EXPOSURE, 50)
    assert capture.read()[1].mean() == 100  # type: ignore[union-attr]
    assert frame(capture).mean() == 50


def test_invisible_object_is_rejected_with_a_message() -> None:
    @dataclass(frozen=True)
    class Ghost:
        name: str = "ghost"

    world = World(noise=QUIET)
    capture = camera(world)
    world.put(Ghost())
    with pytest.raises(TypeError, match="draw"):
        frame(capture)


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
    return seen_deg - world.table_motion(middle_ns)[0], 0.06


def test_rows_are_exposed_one_after_the_other() -> None:
    error, _ = rows_of_spot(QUIET.with_values(camera_readout_ms=11.1))
    assert np.abs(error).max() < 0.06
    global_shutter, _ = rows_of_spot(QUIET)
    assert np.abs(global_shutter).max() < 0.06


def test_exposure_begins_before_the_stamp_by_offset_and_jitter() -> None:
    offsets = [-rows_of_spot(QUIET.with_values(stamp_offset_ms=5.0), seed)[0].mean() / 0.06 for seed in range(4)]
    drawn = [SimCapture(World(noise=NoiseModel(stamp_offset_ms=5.0), seed=s)).times.offset_ns * 1e-6 for s in range(4)]
    assert offsets == pytest.approx(drawn, abs=1.0)


def test_lost_frames_do_not_arrive() -> None:
    world = World(noise=QUIET.with_values(lost_frames=0.5))
    capture = camera(world)
    stamps = []
    for _ in range(40):
        assert capture.grab()
        stamps.append(round(capture.get(cv2.CAP_PROP_POS_MSEC) * FPS / 1000))
    assert 1.5 < (stamps[-1] - stamps[0]) / 39 < 2.6


def test_views_at_rest_do_not_depend_on_the_errors_of_camera_time() -> None:
    images = []
    for noise in (QUIET, QUIET.with_values(camera_readout_ms=20.0, stamp_offset_ms=20.0, stamp_jitter_ms=2.0)):
        world = World(noise=noise)
        world.put(shelf()["mug-star"])
        images.append(frame(camera(world)))
    assert np.array_equal(*images)


def test_mean_time_of_each_row_is_the_middle_of_its_exposure() -> None:
    for steps in (2, 3, 8):
        times, weights = row_weights(10_000_000, 18_000_000, steps)
        middles = (np.arange(480) + 0.5) / 480 * 18e6 + 5e6
        assert weights.min() >= 0
        assert np.abs(times @ weights - middles).max() < 100
