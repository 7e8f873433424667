"""The camera's noise, flat field, drift and sharpness: found, or rejected."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration import camera_light
from calibration.camera_light import CardFrames, drift, flat_field, photon_transfer, sharpness
from calibration.procedure import Ask
from rig.calibrations import CalibrationResult, RejectionCode
from rig.devices.camera import CameraLocks
from sim.noise import NoiseModel
from sim.sensor import Sensor
from tests.calibration.rejected import codes

LOCKS = CameraLocks(10_000.0, 1.0, 5000.0, auto_exposure=False, auto_white_balance=False)
EVEN = (1.0, 1.0, 1.0)
STEPS = np.repeat(np.linspace(20, 220, 16).astype(np.uint8), 40)
SCENE = np.broadcast_to(STEPS[None, :, None], (480, 640, 3)).copy()
CARD = np.full((480, 640, 3), 170, np.uint8)


def frames(noise: NoiseModel, scene=SCENE, *, n: int = 12, exposure: float = 1.0, seed: int = 0):
    """Return ``n`` frames of a simulated sensor, binned to a quarter of their pixels for speed."""
    rng = np.random.default_rng(seed)
    sensor = Sensor(noise, rng, binning=2)
    small = cv2.resize(scene, (320, 240), interpolation=cv2.INTER_AREA)
    return np.stack([sensor.expose(small, light=EVEN, exposure=exposure, gains=EVEN, rng=rng) for _ in range(n)])


def card(levels=(170.0, 170.0, 170.0), *, mean=None, slope: float = 0.0, flicker: float = 0.004) -> CardFrames:
    """Return the means of 40 frames of a card over four minutes; ``slope`` is the light's drift in % per minute."""
    rng = np.random.default_rng(0)
    seconds = np.linspace(0, 240, 40)
    light = (1 + slope / 100 * seconds / 60) * (1 + flicker * rng.standard_normal(40))
    shaded = np.full((30, 40), float(np.mean(levels))) if mean is None else mean
    return CardFrames(light[:, None] * np.array(levels), seconds, shaded)


@pytest.mark.parametrize("seed", range(4))
def test_full_well_and_read_noise_lie_within_the_stated_uncertainty(seed):
    rng = np.random.default_rng(seed)
    true = NoiseModel(full_well_e=float(rng.uniform(3e3, 2e4)), read_noise_e=float(rng.uniform(8, 40)))
    result = photon_transfer(frames(true, seed=seed))
    assert result.passed, result.rejections
    for name, value in (("full_well_e", true.full_well_e), ("read_noise_e", true.read_noise_e)):
        estimate = result.estimates[name]
        assert abs(estimate.value - value) < 4 * estimate.uncertainty, name
        assert estimate.value == pytest.approx(value, rel=0.15), name


@pytest.mark.parametrize(
    ("scene", "exposure"),
    [(CARD, 1.0), (SCENE, 0.03), (SCENE, 0.0), (np.where(SCENE > 100, 255, 0).astype(np.uint8), 4.0)],
    ids=["no span", "dark", "black", "saturated"],
)
def test_scene_with_low_contrast_is_rejected(scene, exposure):
    result = photon_transfer(frames(NoiseModel(), scene, n=4, exposure=exposure))
    assert codes(result) == [RejectionCode.CONTRAST_TOO_LOW]
    assert not result.estimates


def test_processed_frames_are_rejected():
    plain = frames(NoiseModel(full_well_e=0.0, read_noise_e=0.0), n=6).astype(np.int16)
    falling = np.random.default_rng(0).normal(0, 1, plain.shape) * (260 - plain) / 40
    result = photon_transfer(np.clip(plain + falling, 0, 255).astype(np.uint8))
    assert codes(result) == [RejectionCode.NOISE_INDEPENDENT_OF_LIGHT]


@pytest.mark.parametrize("loss", [0.0, 0.12, 0.35])
def test_vignetting_is_found_beside_a_light_gradient(loss):
    y, x = np.mgrid[0:480, 0:640]
    x, y = (x - 319.5) / 319.5, (y - 239.5) / 319.5
    light = 1 + 0.05 * x - loss * (x**2 + y**2) / (1 + (239.5 / 319.5) ** 2)
    blocks = (170 * light).reshape(30, 16, 40, 16).mean(axis=(1, 3))
    result = flat_field(card(mean=blocks + np.random.default_rng(3).normal(0, 0.2, blocks.shape)))
    assert result.passed, result.rejections
    for name, value in (("vignetting", loss), ("gradient_x", 0.05), ("gradient_y", 0.0)):
        estimate = result.estimates[name]
        assert abs(estimate.value - value) < 4 * estimate.uncertainty, name


def _half_filled() -> np.ndarray:
    mean = np.full((30, 40), 170.0)
    mean[:, 30:] = 40.0
    return mean


@pytest.mark.parametrize(
    ("mean", "code"),
    [
        (_half_filled(), RejectionCode.CARD_UNEVEN),
        (np.full((30, 40), 3.0), RejectionCode.CARD_EXPOSURE),
        (np.full((30, 40), 255.0), RejectionCode.CARD_EXPOSURE),
        (np.full((30, 40), 0.0), RejectionCode.CARD_EXPOSURE),
        (
            170 * (1 - 0.7 * sum(g**2 for g in np.mgrid[-0.75:0.75:30j, -1:1:40j]) / 1.5625),
            RejectionCode.VIGNETTING_TOO_LARGE,
        ),
    ],
    ids=["half filled", "dark", "saturated", "black", "vignetted"],
)
def test_wrong_card_is_rejected(mean, code):
    result = flat_field(card(mean=mean))
    assert code in codes(result)


def test_steady_light_passes_with_its_flicker():
    result = drift(card(), LOCKS, LOCKS)
    assert result.passed, result.rejections
    flicker = result.estimates["flicker"]
    assert abs(flicker.value - 0.004) < 4 * flicker.uncertainty
    assert abs(result.estimates["drift"].value) < 4 * result.estimates["drift"].uncertainty


@pytest.mark.parametrize(
    ("frames", "after", "code"),
    [
        (card(slope=1.0), LOCKS, RejectionCode.LIGHT_DRIFTED),
        (card(slope=-1.0), LOCKS, RejectionCode.LIGHT_DRIFTED),
        (card(flicker=0.05), LOCKS, RejectionCode.LIGHT_FLICKERS),
        (card((130.0, 170.0, 175.0)), LOCKS, RejectionCode.COLOUR_CAST),
        (card((0.0, 0.0, 0.0)), LOCKS, RejectionCode.CARD_BLACK),
        (card(), replace(LOCKS, exposure_us=8000.0), RejectionCode.LOCKS_CHANGED),
    ],
    ids=["brighter", "darker", "flicker", "colour cast", "black", "locks"],
)
def test_unstable_light_and_settings_are_rejected(frames, after, code):
    result = drift(frames, LOCKS, after)
    assert code in codes(result)
    assert not result.settings


def test_lens_out_of_focus_is_rejected():
    assert sharpness([400.0, 410.0, 390.0]).passed
    assert codes(sharpness([4.0, 4.1, 3.9])) == [RejectionCode.NOT_SHARP]


@pytest.mark.parametrize("seed", range(6))
def test_first_frame_of_the_card_shows_the_card(simulated, monkeypatch, seed):
    monkeypatch.setattr(camera_light, "CARD_FRAMES", 4)
    s = simulated(noise=NoiseModel(), seed=seed)
    results = [event for event in camera_light.CameraCard().live(s.bench) if isinstance(event, CalibrationResult)]
    grey = np.mean(results[-1].evidence["levels_bgr"], axis=1)
    assert grey[0] == pytest.approx(np.median(grey), rel=0.05)


def test_simulated_camera_is_found(simulated, monkeypatch):
    monkeypatch.setattr(camera_light, "CARD_FRAMES", 12)
    true = NoiseModel(full_well_e=6000.0, read_noise_e=20.0, vignetting=0.2, light_flicker=0.006)
    s = simulated(noise=true, seed=1)
    events = [*camera_light.CameraNoise().live(s.bench), *camera_light.CameraCard().live(s.bench)]
    assert [type(event) for event in events[:1]] == [Ask]
    results = [event for event in events if isinstance(event, CalibrationResult)]
    assert [result.name for result in results] == [
        "camera.sharpness",
        "camera.noise",
        "camera.flat_field",
        "camera.drift",
    ]
    assert all(result.passed for result in results), [result.rejections for result in results]
    found = {name: estimate.value for result in results for name, estimate in result.estimates.items()}
    assert found["full_well_e"] == pytest.approx(true.full_well_e, rel=0.1)
    assert found["read_noise_e"] == pytest.approx(true.read_noise_e, rel=0.1)
    assert found["vignetting"] == pytest.approx(true.vignetting, abs=0.01)
    assert found["flicker"] == pytest.approx(true.light_flicker, rel=0.5)
