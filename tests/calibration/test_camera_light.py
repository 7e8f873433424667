"""The camera's noise, flat field, drift and sharpness: found, or refused with the reason."""

from dataclasses import replace
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest

from calibration import camera_light
from calibration.camera_light import CardFrames, drift, flat_field, photon_transfer, sharpness
from calibration.events import Ask
from rig.calibrations import CalibrationResult
from rig.devices.camera import CameraLocks
from sim.noise import NoiseModel, from_calibration
from sim.sensor import Sensor

WHEN = datetime(2026, 3, 1, tzinfo=UTC)
KEPT = {"when_utc": WHEN, "device": {}}
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
    """Return what 40 frames of a card over four minutes come to; ``slope`` is the light's drift in % a minute."""
    rng = np.random.default_rng(0)
    seconds = np.linspace(0, 240, 40)
    light = (1 + slope / 100 * seconds / 60) * (1 + flicker * rng.standard_normal(40))
    shaded = np.full((30, 40), float(np.mean(levels))) if mean is None else mean
    return CardFrames(light[:, None] * np.array(levels), seconds, shaded)


@pytest.mark.parametrize("seed", range(4))
def test_full_well_and_read_noise_lie_within_the_stated_uncertainty(seed):
    rng = np.random.default_rng(seed)
    true = NoiseModel(full_well_e=float(rng.uniform(3e3, 2e4)), read_noise_e=float(rng.uniform(8, 40)))
    fact = photon_transfer(frames(true, seed=seed), **KEPT)
    assert fact.passed, fact.refusals
    for name, value in (("full_well_e", true.full_well_e), ("read_noise_e", true.read_noise_e)):
        estimate = fact.estimates[name]
        assert abs(estimate.value - value) < 4 * estimate.uncertainty, name
        assert estimate.value == pytest.approx(value, rel=0.15), name


@pytest.mark.parametrize(
    ("scene", "exposure"),
    [(CARD, 1.0), (SCENE, 0.03), (SCENE, 0.0), (np.where(SCENE > 100, 255, 0).astype(np.uint8), 4.0)],
    ids=["no span", "dark", "black", "saturated"],
)
def test_a_scene_that_cannot_tell_the_noise_is_refused(scene, exposure):
    fact = photon_transfer(frames(NoiseModel(), scene, n=4, exposure=exposure), **KEPT)
    assert "grey levels, 80 are needed" in fact.refusals[0]
    assert not fact.estimates


def test_frames_that_a_camera_smoothed_are_refused():
    plain = frames(NoiseModel(full_well_e=0.0, read_noise_e=0.0), n=6).astype(np.int16)
    falling = np.random.default_rng(0).normal(0, 1, plain.shape) * (260 - plain) / 40
    fact = photon_transfer(np.clip(plain + falling, 0, 255).astype(np.uint8), **KEPT)
    assert "noise reduction" in fact.refusals[0]


@pytest.mark.parametrize("loss", [0.0, 0.12, 0.35])
def test_the_loss_in_the_corners_is_found_beside_a_lamp_that_lights_from_one_side(loss):
    y, x = np.mgrid[0:480, 0:640]
    x, y = (x - 319.5) / 319.5, (y - 239.5) / 319.5
    light = 1 + 0.05 * x - loss * (x**2 + y**2) / (1 + (239.5 / 319.5) ** 2)
    blocks = (170 * light).reshape(30, 16, 40, 16).mean(axis=(1, 3))
    fact = flat_field(card(mean=blocks + np.random.default_rng(3).normal(0, 0.2, blocks.shape)), **KEPT)
    assert fact.passed, fact.refusals
    for name, value in (("vignetting", loss), ("gradient_x", 0.05), ("gradient_y", 0.0)):
        estimate = fact.estimates[name]
        assert abs(estimate.value - value) < 4 * estimate.uncertainty, name


def _half_filled() -> np.ndarray:
    mean = np.full((30, 40), 170.0)
    mean[:, 30:] = 40.0
    return mean


@pytest.mark.parametrize(
    ("mean", "reason"),
    [
        (_half_filled(), "does not fill the frame"),
        (np.full((30, 40), 3.0), "too dark or saturated"),
        (np.full((30, 40), 255.0), "too dark or saturated"),
        (np.full((30, 40), 0.0), "too dark or saturated"),
        (
            170 * (1 - 0.7 * sum(g**2 for g in np.mgrid[-0.75:0.75:30j, -1:1:40j]) / 1.5625),
            "something covers the lens",
        ),
    ],
    ids=["half filled", "dark", "saturated", "black", "vignetted"],
)
def test_a_flat_field_that_is_none_is_refused(mean, reason):
    fact = flat_field(card(mean=mean), **KEPT)
    assert any(reason in refusal for refusal in fact.refusals), fact.refusals


def test_steady_light_passes_with_its_flicker():
    fact = drift(card(), LOCKS, LOCKS, **KEPT)
    assert fact.passed, fact.refusals
    flicker = fact.estimates["flicker"]
    assert abs(flicker.value - 0.004) < 4 * flicker.uncertainty
    assert abs(fact.estimates["drift"].value) < 4 * fact.estimates["drift"].uncertainty


@pytest.mark.parametrize(
    ("frames", "after", "reason"),
    [
        (card(slope=1.0), LOCKS, "The light drifted by 4"),
        (card(slope=-1.0), LOCKS, "let the lamps warm up"),
        (card(flicker=0.05), LOCKS, "whole periods of the mains"),
        (card((130.0, 170.0, 175.0)), LOCKS, "camera.white_balance_k"),
        (card((0.0, 0.0, 0.0)), LOCKS, "The card is black"),
        (card(), replace(LOCKS, exposure_us=8000.0), "settings changed by themselves"),
    ],
    ids=["brighter", "darker", "flicker", "colour cast", "black", "locks"],
)
def test_light_and_settings_that_do_not_stay_are_refused(frames, after, reason):
    fact = drift(frames, LOCKS, after, **KEPT)
    assert any(reason in refusal for refusal in fact.refusals), fact.refusals
    assert not fact.settings


def test_a_lens_out_of_focus_is_refused():
    assert sharpness([400.0, 410.0, 390.0], **KEPT).passed
    assert "focus the lens" in sharpness([4.0, 4.1, 3.9], **KEPT).refusals[0]


def test_the_bench_finds_its_own_camera_again(simulated, monkeypatch):
    monkeypatch.setattr(camera_light, "CARD_FRAMES", 12)
    true = NoiseModel(full_well_e=6000.0, read_noise_e=20.0, vignetting=0.2, light_flicker=0.006)
    s = simulated(noise=true, seed=1)
    told = [*camera_light.live_scene(s.bench), *camera_light.live_card(s.bench)]
    assert [type(event) for event in told[:1]] == [Ask]
    facts = [event for event in told if isinstance(event, CalibrationResult)]
    assert [fact.name for fact in facts] == ["camera.sharpness", "camera.noise", "camera.flat_field", "camera.drift"]
    assert all(fact.passed for fact in facts), [fact.refusals for fact in facts]
    found = from_calibration(facts)
    assert found.full_well_e == pytest.approx(true.full_well_e, rel=0.1)
    assert found.read_noise_e == pytest.approx(true.read_noise_e, rel=0.1)
    assert found.vignetting == pytest.approx(true.vignetting, abs=0.01)
    assert found.light_flicker == pytest.approx(true.light_flicker, rel=0.5)
