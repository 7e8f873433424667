"""Lamps that flicker with the mains are named, and the exposure without bands."""

import numpy as np
import pytest

from rig.core.next_steps import Do
from rig.doctor.camera import mains_flicker, standing_flicker, standing_mains_hz
from rig.doctor.finding import FindingCode
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
    assert found.mains_hz == lamp_hz / 2
    assert found.depth == pytest.approx(0.05, rel=0.4)


@pytest.mark.parametrize(
    "scene", [{"depth": 0.0}, {"depth": 0.0, "drift": 0.2}, {"depth": 0.004}, {"depth": 0.0, "count": 3}]
)
def test_steady_light_and_slow_changes_are_no_mains_flicker(scene):
    assert mains_flicker(*images(100, **scene)) is None


@pytest.mark.parametrize(("fps", "mains_hz"), [(30, (60,)), (25, (50,)), (24, (60,)), (20, (50, 60)), (28, ())])
def test_mains_frequencies_whose_bands_stand_still_are_known(fps, mains_hz):
    assert standing_mains_hz((np.arange(11) / fps * 1e9).astype(np.int64)) == mains_hz


def rows(depth, *, readout_s=0.02, gamma=1.0, exposure=1.0):
    """Return the levels of rows under a lamp with bands that stand still, for a camera whose response has a gamma."""
    y = np.linspace(0, 1, 480)
    light = (40 + 60 * y + 25 * np.sin(7 * y)) * (1 + depth * np.cos(2 * np.pi * 120 * readout_s * y + 1))
    return 255 * (light * exposure / 255) ** gamma + np.random.default_rng(1).normal(0, 0.05, 480)


@pytest.mark.parametrize("readout_s", [0.008, 0.02, 0.033])
@pytest.mark.parametrize("gamma", [1.0, 0.5])
def test_bands_that_stand_still_are_found_by_two_exposure_times(readout_s, gamma):
    scene = {"readout_s": readout_s, "gamma": gamma}
    found = standing_flicker(rows(0.06, **scene, exposure=1.2), rows(0.0, **scene), 60.0)
    assert found.mains_hz == 60
    assert found.depth == pytest.approx(0.06 * gamma, rel=0.3)
    assert standing_flicker(rows(0.0, **scene, exposure=1.2), rows(0.0, **scene), 60.0) is None
    assert standing_flicker(np.zeros(480), np.zeros(480), 60.0) is None


def test_exposure_is_a_whole_number_of_periods():
    at_50, at_60 = mains_flicker(*images(100, 0.1, fps=30)), mains_flicker(*images(120, 0.1))
    assert [at_50.exposure_us(wanted) for wanted in (3000, 12_000, 18_000)] == [10_000, 10_000, 20_000]
    assert [at_60.exposure_us(wanted) for wanted in (3000, 10_000, 18_000)] == [8333, 8333, 16_667]


def test_doctor_names_the_mains_and_the_exposure_that_hides_it():
    with unopened("camera.exposure_us=5000") as bench:
        Faults(bench.devices).schedule(Fault.parse("mains_flicker"))
        found = bench.problems("camera")
        assert found == {FindingCode.MAINS_FLICKER: (Do.SET_KEY(key="camera.exposure_us", value="10000"),)}
    with unopened() as bench:  # the default of 10 ms
        Faults(bench.devices).schedule(Fault.parse("mains_flicker"))
        assert bench.problems("camera") == {}


def test_doctor_names_the_mains_whose_bands_stand_still():
    fault = ["mains_flicker:hz=60"]  # 120 Hz is four times the frame rate
    with unopened() as bench:
        Faults(bench.devices).schedule(*map(Fault.parse, fault))
        before = bench.devices.camera.exposure
        assert bench.problems("camera") == {
            FindingCode.MAINS_FLICKER: (Do.SET_KEY(key="camera.exposure_us", value="8333"),)
        }
        assert bench.devices.camera.exposure == before
    with unopened("camera.exposure_us=8333") as bench:
        Faults(bench.devices).schedule(*map(Fault.parse, fault))
        assert bench.problems("camera") == {}
