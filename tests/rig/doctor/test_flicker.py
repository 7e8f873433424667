"""Lamps that flicker with the mains are named, and the exposure without bands."""

import numpy as np
import pytest

from rig.core.next_steps import Do
from rig.doctor.camera import _flicker, mains_flicker, standing_mains_hz, whole_periods_us
from rig.doctor.finding import Severity
from sim.faults import Fault, Faults
from tests.rig.doctor.doctor_parts import unopened


def images(lamp_hz, depth, *, fps=25.0, readout_s=0.02, drift=0.0, count=11):
    """Return the row levels and times of images of a scene under a lamp."""
    rng = np.random.default_rng(1)
    times_s = np.cumsum([0, 1, 1, 1, 1, 4, 5, 5, 4, 5, 5][:count]) / fps
    rows = np.linspace(0, 1, 480)
    scene = 60 + 30 * np.sin(7 * rows)
    lamp = 1 + depth * np.cos(2 * np.pi * lamp_hz * (times_s[:, None] + readout_s * rows))
    level = 1 + drift * np.sin(2 * np.pi * 1.3 * times_s)[:, None]
    return scene * lamp * level * rng.normal(1, 0.004, (count, 1)) + rng.normal(0, 0.1, (count, 480)), (
        times_s * 1e9
    ).astype(np.int64)


@pytest.mark.parametrize(("lamp_hz", "fps"), [(100, 30), (120, 25), (100, 24), (120, 28)])
@pytest.mark.parametrize("readout_s", [0.0, 0.008, 0.033])
def test_mains_is_named_with_its_depth(lamp_hz, fps, readout_s):
    found = mains_flicker(*images(lamp_hz, 0.05, fps=fps, readout_s=readout_s))
    assert found == (lamp_hz / 2, pytest.approx(0.05, rel=0.4))


@pytest.mark.parametrize(
    "scene", [{"depth": 0.0}, {"depth": 0.0, "drift": 0.2}, {"depth": 0.004}, {"depth": 0.0, "count": 3}]
)
def test_steady_light_and_slow_changes_are_no_mains_flicker(scene):
    assert mains_flicker(*images(100, **scene)) is None


@pytest.mark.parametrize(("fps", "mains_hz"), [(30, (60,)), (25, (50,)), (24, (60,)), (20, (50, 60)), (28, ())])
def test_mains_frequencies_whose_bands_stand_still_are_known(fps, mains_hz):
    assert standing_mains_hz((np.arange(11) / fps * 1e9).astype(np.int64)) == mains_hz


def test_exposure_is_a_whole_number_of_periods():
    assert [whole_periods_us(50, wanted) for wanted in (3000, 12_000, 18_000)] == [10_000, 10_000, 20_000]
    assert [whole_periods_us(60, wanted) for wanted in (3000, 10_000, 18_000)] == [8333, 8333, 16_667]


def test_doctor_names_the_mains_and_the_exposure_that_hides_it():
    with unopened("camera.exposure_us=5000") as bench:
        Faults(bench.devices).schedule(Fault.parse("mains_flicker"))
        found = bench.problems("camera")
        assert found == {"mains_flicker": (Do.SET_KEY(key="camera.exposure_us", value="10000"),)}
    with unopened() as bench:  # the default of 10 ms
        Faults(bench.devices).schedule(Fault.parse("mains_flicker"))
        assert bench.problems("camera") == {}


def test_bands_that_would_stand_still_are_named_with_the_exposure_without_them():
    found = {f.code: f.steps for f in bench_findings() if f.level is Severity.FINE}
    assert found["standing_flicker_not_checked"] == (Do.SET_KEY(key="camera.exposure_us", value="8333"),)
    codes = {f.code for f in bench_findings("camera.exposure_us=8333")}
    assert "standing_flicker_not_checked" not in codes


@pytest.mark.parametrize(("exposure_us", "names_it"), [(None, True), (5_000.0, True), (10_000.0, False)])
def test_bands_that_would_stand_still_are_named_unless_the_exposure_is_known_to_have_none(exposure_us, names_it):
    times_ns = (np.arange(11) / 25 * 1e9).astype(np.int64)  # at 25 frames/s, those of 50 Hz mains
    frames = [np.full((480, 4, 3), 90, np.uint8)] * 11
    found = list(_flicker(exposure_us, frames, times_ns, {"mean_levels": [90.0, 90.0]}))
    assert bool(found) == names_it
    assert all(one.steps == (Do.SET_KEY(key="camera.exposure_us", value="10000"),) for one in found)


def bench_findings(*settings):
    with unopened(*settings) as bench:  # 120 Hz is four times the frame rate
        return bench.findings("camera")
