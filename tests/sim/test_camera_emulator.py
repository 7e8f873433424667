"""The simulated camera: image formation, noise, settings, and equal bytes for equal seeds."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sim.camera import SimCapture
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.objects.projection import Image
from sim.objects.shelf import shelf
from sim.world import World
from tests.sim.drawn_camera import QUIET, Card, Spot, camera, frame, grey, stamp_ns

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


def test_vignetting_darkens_the_corners_and_flicker_whole_frames_by_their_share() -> None:
    world = World(noise=QUIET.with_values(vignetting=0.3, light_flicker=0.02))
    world.put(grey(200))
    capture = camera(world)
    frames = np.array([frame(capture)[::479, ::71] for _ in range(30)])  # the first and the last row
    levels = frames.mean(axis=(1, 2, 3))
    assert frames[:, :, [0, -1]].mean() == pytest.approx(0.7 * 200, abs=1)
    assert levels.std() / levels.mean() == pytest.approx(0.02, rel=0.35)


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
