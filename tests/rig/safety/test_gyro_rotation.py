"""Rotations by the gyro: the real driver's samples, integrated between two rests."""

from collections.abc import Iterator
from math import erf, inf, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.errors import ConfigError, DeviceFault, DeviceSilent, NotReady, UsageError
from rig.devices.imu import ImuSamples
from rig.safety.gyro_rotation import GyroIssue, GyroRotationMeter, Rotation, compare
from sim.motion import to_position, to_velocity
from sim.noise import NoiseModel
from tests.rig.imu_bench import ImuBench


class GyroBench(ImuBench):
    """A bench with noise, whose sensor is open, and the meter of its rotations."""

    def __init__(self, noise: NoiseModel | None = None, seed: int = 0, rate_hz: float = 200, **heading: Any) -> None:
        super().__init__(noise or NoiseModel(), seed)
        self.heading = GyroRotationMeter(self.open(rate_hz=rate_hz), self.clock, **heading)

    def drive(self, by_deg: float, v_max: float = 90.0) -> None:
        self.world.drive(to_position(self.clock.now_ns() * 1e-9, *self.world.shaft(), self.shaft + by_deg, v_max, 300))

    @property
    def shaft(self) -> float:
        return self.world.shaft()[0]

    def move(self, by_deg: float, v_max: float = 90.0) -> Rotation:
        """Rotate as the turntable does."""
        self.heading.begin()
        self.drive(by_deg, v_max)
        for _ in range(int(abs(by_deg) / v_max / 0.03) + 20):
            self.clock.sleep(0.03)
            self.heading.update()
        while self.heading.peak_dps() > 0.3:
            self.clock.sleep(0.03)
        return self.heading.end()


@pytest.fixture
def bench() -> Iterator[GyroBench]:
    with GyroBench() as b:
        yield b


# -- the bias at rest ---------------------------------------------------------------------------------------------


def test_bias_is_within_its_uncertainty() -> None:
    pulls = []
    for seed in range(60):
        with GyroBench(seed=seed) as bench:
            bias = bench.heading.rest()
            pulls.append((bias.rate_dps - bench.sensor.inertial.gyro_bias_dps[2]) / bias.sigma_dps)
            assert bias.samples >= 100
            assert bias.peak_dps < 0.3
    assert 0.75 < np.std(pulls) < 1.35  # 60 draws: ±20 % at two sigma


def test_longer_rest_reduces_the_bias_uncertainty(bench: GyroBench) -> None:
    first = bench.heading.rest()
    bench.clock.sleep(0.5)
    before_ns = bench.clock.now_ns()
    second = bench.heading.rest()
    assert second.samples > 1.8 * first.samples
    assert second.sigma_dps < 0.8 * first.sigma_dps
    assert bench.clock.now_ns() - before_ns < 50_000_000  # reading, no waiting


@pytest.mark.parametrize("when_s", [0.1, 0.5, 1.2])
def test_bias_is_rejected_while_the_table_moves(bench: GyroBench, when_s: float) -> None:
    known = bench.heading.rest()
    bench.drive(90.0)
    bench.clock.sleep(when_s)
    with pytest.raises(NotReady, match="not at rest"):
        bench.heading.rest()
    assert bench.heading.bias is known
    bench.clock.sleep(2.0)
    bench.heading.rest()  # starts again


def test_bias_is_rejected_during_a_steady_rotation(bench: GyroBench) -> None:
    bench.world.drive(to_velocity(bench.clock.now_ns() * 1e-9, 0.0, 60.0, 60.0, 1.0))
    bench.clock.sleep(1.0)
    bench.imu.read_samples()
    with pytest.raises(NotReady, match="not at rest"):
        bench.heading.rest()


def test_noisy_sensor_has_a_larger_bias_uncertainty() -> None:
    with GyroBench(NoiseModel().with_values(gyro_noise_dps_rthz=0.02)) as noisy, GyroBench() as normal:
        assert noisy.heading.rest().sigma_dps > 2 * normal.heading.rest().sigma_dps


@pytest.mark.parametrize("duration_s", [0.0, -1.0, 1.01, inf])
def test_invalid_rest_duration_is_rejected(bench: GyroBench, duration_s: float) -> None:
    with pytest.raises(UsageError):
        bench.heading.rest(duration_s)


def test_sensor_without_samples_is_not_at_rest(bench: GyroBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.heading.rest()
    assert bench.heading.peak_dps() < 1
    empty = ImuSamples(np.empty(0, np.int64), np.empty((0, 3)))
    monkeypatch.setattr(bench.imu, "read_samples", lambda: empty)
    bench.clock.sleep(0.5)
    assert bench.heading.peak_dps() == inf  # the last samples are known, and too old
    bench.clock.sleep(2.0)
    with pytest.raises(DeviceSilent):
        bench.heading.rest()


# -- rotations ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by_deg", [90.0, -35.0, 5.0, -180.0])
def test_rotation_without_errors_is_exact(by_deg: float) -> None:
    with GyroBench(NoiseModel.none()) as bench:
        bench.heading.rest(1.0)  # a sensor without noise does not count as hanging
        rotation = bench.move(by_deg)
        assert rotation.valid
        assert rotation.angle_deg == pytest.approx(by_deg, abs=0.02)


@pytest.mark.parametrize("rate_hz", [50, 100, 500, 1000])
def test_fifo_is_read_in_time_at_each_rate(rate_hz: float) -> None:
    with GyroBench(NoiseModel.none(), rate_hz=rate_hz) as bench:
        bench.heading.rest()
        rotation = bench.move(60.0)
        assert rotation.valid
        assert rotation.angle_deg == pytest.approx(60.0, abs=0.1)
        assert bench.imu.statistics.overflows == 0


@pytest.mark.parametrize(
    ("noise", "scale_sigma"),
    [
        pytest.param(NoiseModel(), 0.01, id="uncalibrated"),
        pytest.param(
            NoiseModel().with_values(gyro_scale_error=0, imu_tilt_deg=0),
            0.0,
            id="scale-calibrated",
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_errors_match_the_stated_uncertainty(noise: NoiseModel, scale_sigma: float) -> None:
    """The ratio |error|/σ over parts and moves shows that the uncertainty is neither too small nor too large."""
    pulls = []
    for seed in range(80):
        with GyroBench(noise, seed, scale_sigma=scale_sigma) as bench:
            bench.heading.rest()
            before = bench.world.table_deg()
            rotation = bench.move([30.0, -90.0, 5.0, 150.0][seed % 4])
            assert rotation.valid
            pulls.append((rotation.angle_deg - (bench.world.table_deg() - before)) / rotation.sigma_deg)
    for k in (1, 2):
        inside = np.mean(np.abs(pulls) < k)
        assert inside == pytest.approx(erf(k / sqrt(2)), abs=0.16 / k)
    assert np.max(np.abs(pulls)) < 4


def test_uncertainty_grows_with_time_angle_and_bias_uncertainty() -> None:
    noise = NoiseModel.none().with_values(gyro_noise_dps_rthz=0.005)
    with GyroBench(noise, scale_sigma=0.02) as bench:
        bias = bench.heading.rest()
        rotation = bench.move(60.0, v_max=30.0)
        arw = 0.005 / sqrt(2)
        t = rotation.duration_s
        expected = sqrt(arw**2 * t + (bias.sigma_dps * t) ** 2 + (0.02 * rotation.angle_deg) ** 2)
        assert rotation.sigma_deg == pytest.approx(expected)
        assert t == pytest.approx(60 / 30 + 0.7, abs=0.4)


def test_mounting_upside_down_and_scale_are_corrected() -> None:
    with GyroBench(NoiseModel.none(), sign=-1, scale=1.5) as bench:
        bench.heading.rest()
        assert bench.move(40.0).angle_deg == pytest.approx(-60.0, abs=0.03)
    with GyroBench(NoiseModel.none(), axis="x") as bench:
        bench.heading.rest()
        assert bench.move(40.0).angle_deg == pytest.approx(0.0, abs=0.01)


def test_slipping_platter_disagrees_with_the_encoder() -> None:
    noise = NoiseModel().with_values(gyro_scale_error=0, imu_tilt_deg=0)
    with GyroBench(noise, scale_sigma=0.001) as bench:
        bench.heading.rest()
        good = compare(30.0, bench.move(30.0), encoder_sigma_deg=0.05, backlash_deg=0.25)
        assert good.agrees
        bench.heading.rest()
        for step in range(9):
            bench.clock.call_at(bench.clock.now_ns() + (300 + 3 * step) * 1_000_000, lambda: bench.world.slip(-0.1))
        slipped = compare(30.0, bench.move(30.0), encoder_sigma_deg=0.05, backlash_deg=0.25)
        assert not slipped.agrees
        assert slipped.difference_deg == pytest.approx(0.9, abs=0.1)


@pytest.mark.parametrize("steady", [False, True])
def test_shock_or_rate_beyond_the_range_is_not_valid(bench: GyroBench, steady: bool) -> None:
    bench.heading.rest()
    if steady:
        bench.world.drive(to_velocity(bench.clock.now_ns() * 1e-9, 0.0, 0.0, 400.0, 2000.0))
        bench.heading.begin()
        for _ in range(5):
            bench.clock.sleep(0.1)
            bench.heading.update()
        rotation = bench.heading.end()
    else:
        bench.clock.call_at(bench.clock.now_ns() + 300_000_000, lambda: bench.world.slip(-10.0))
        rotation = bench.move(30.0)
    assert not rotation.valid
    assert rotation.issue is GyroIssue.OUT_OF_RANGE


def test_rotation_with_lost_samples_is_not_valid(bench: GyroBench) -> None:
    bench.heading.rest()
    bench.heading.begin()
    bench.drive(90.0)
    bench.clock.sleep(1.5)  # longer than the FIFO is
    rotation = bench.heading.end()
    assert not rotation.valid
    assert rotation.issue is GyroIssue.LOST_SAMPLES
    with pytest.raises(UsageError, match="lost"):
        compare(90.0, rotation, encoder_sigma_deg=0.1)
    bench.heading.rest()
    assert bench.move(20.0).valid


def test_overflow_between_moves_is_harmless(bench: GyroBench) -> None:
    bench.heading.rest()
    bench.clock.sleep(20.0)
    bench.heading.rest()
    assert bench.move(45.0).angle_deg == pytest.approx(45.0, rel=0.04)


def test_update_leaves_the_bus_alone_while_the_fifo_is_nearly_empty(bench: GyroBench) -> None:
    bench.heading.rest()
    bench.heading.begin()
    before = bench.imu.statistics.transfers
    for _ in range(100):
        bench.clock.sleep(0.01)
        bench.heading.update()
    assert 8 <= bench.imu.statistics.transfers - before <= 12  # five drains of two transactions


# -- at rest or not -----------------------------------------------------------------------------------------------


def test_peak_rate_distinguishes_moving_ringing_and_rest(bench: GyroBench) -> None:
    assert bench.heading.peak_dps() == inf  # nothing is known yet
    bench.heading.rest(0.2)
    assert bench.heading.peak_dps(0.15) < inf
    assert bench.heading.peak_dps(0.5) == inf  # the window is not full
    bench.heading.rest()
    assert bench.heading.peak_dps() < 0.3
    bench.heading.begin()
    bench.drive(45.0)
    bench.clock.sleep(0.4)
    assert bench.heading.peak_dps() > 50
    peaks = []
    for _ in range(8):
        bench.clock.sleep(0.1)
        peaks.append(bench.heading.peak_dps())
    assert peaks[1] > 1.0  # the platter still rings when the shaft stands
    assert peaks[-1] < 0.3
    bench.heading.end()
    assert bench.heading.peak_dps() < 0.3


# -- misuse -------------------------------------------------------------------------------------------------------


def test_wrong_order_of_calls_is_rejected(bench: GyroBench) -> None:
    with pytest.raises(NotReady, match="bias"):
        bench.heading.begin()
    with pytest.raises(NotReady, match="begun"):
        bench.heading.end()
    bench.heading.rest()
    bench.heading.begin()
    bench.heading.end()
    with pytest.raises(NotReady, match="begun"):
        bench.heading.end()


def test_rest_drops_the_rotation_of_an_interrupted_move(bench: GyroBench) -> None:
    bench.heading.rest()
    bench.heading.begin()
    bench.drive(20.0)
    bench.clock.sleep(0.8)
    bias = bench.heading.rest()  # checks only the samples from now on
    assert bias.samples == pytest.approx(100, abs=3)
    with pytest.raises(NotReady, match="begun"):
        bench.heading.end()
    assert bench.move(20.0).angle_deg == pytest.approx(20.0, rel=0.04)


@pytest.mark.parametrize("wrong", [{"axis": "w"}, {"sign": 0}, {"scale": 0.0}, {"scale": -1.0}, {"scale_sigma": -0.1}])
def test_impossible_mounting_is_rejected(bench: GyroBench, wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        GyroRotationMeter(bench.imu, bench.clock, **wrong)


@given(
    encoder=st.floats(-360, 360),
    gyro=st.floats(-360, 360),
    sigma=st.floats(0.001, 5),
    backlash=st.floats(0, 1),
)
def test_agreement_is_symmetric_and_bounded(encoder: float, gyro: float, sigma: float, backlash: float) -> None:
    def agreement(e: float, g: float) -> Any:
        return compare(e, Rotation(g, sigma, 1.0), encoder_sigma_deg=0.1, backlash_deg=backlash)

    forth, back = agreement(encoder, gyro), agreement(gyro, encoder)
    assert forth.agrees == back.agrees
    assert forth.agrees == (abs(encoder - gyro) <= forth.bound_deg)
    assert forth.bound_deg >= 4 * sigma + backlash
    assert agreement(encoder, encoder).agrees


@pytest.mark.parametrize(
    ("hung", "words"),
    [
        pytest.param(
            lambda words: np.broadcast_to(np.array([0, 0, 0, 0, 40, -17, 90]), words.shape), "hangs", id="stuck"
        ),
        pytest.param(lambda words: np.full_like(words, 32767), "end of its range", id="saturated"),
    ],
)
@pytest.mark.parametrize("moving", [True, False])
def test_gyro_that_repeats_one_sample_is_detected(bench: GyroBench, hung: Any, words: str, moving: bool) -> None:
    bench.heading.rest()
    bench.sensor.distortions.append(lambda w: hung(w).astype(">i2"))
    broken_ns = bench.clock.now_ns()
    with pytest.raises(DeviceFault, match=words):
        if moving:
            bench.move(90.0)
        else:
            bench.heading.rest(1.0)
    assert bench.clock.now_ns() - broken_ns < 0.5e9


@given(st.floats(0.01, 1.0))  # a sample of the last 5 ms may arrive later
def test_rotation_until_a_time_before_the_rest_is_zero(before_s):
    with GyroBench() as bench:
        bench.heading.rest()
        bench.heading.begin()
        bench.clock.sleep(0.2)
        bench.heading.end()
        ended_ns = bench.clock.now_ns()
        bench.clock.sleep(0.2)
        bench.heading.begin()
        rotation = bench.heading.since_rest(ended_ns - round(before_s * 1e9))
        assert rotation.duration_s == 0.0
        assert (rotation.angle_deg, rotation.sigma_deg) == pytest.approx((0.0, 0.0), abs=1e-12)
