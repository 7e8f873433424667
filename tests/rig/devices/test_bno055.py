"""The BNO055 driver over the real smbus2, with the simulated sensor; tests/contract has the contract of all IMUs."""

from collections.abc import Iterator
from contextlib import closing
from math import degrees, sqrt

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.core.errors import DeviceFault, DeviceMismatch, DeviceSilent
from rig.devices.bno055 import Bno055
from rig.motion.turntable import Turntable
from sim.imu.bno055 import SILENT_S, SimBno055
from sim.motion import to_position
from sim.noise import NoiseModel
from tests.fuzzing import examples
from tests.rig.imu_bench import ImuBench

AT = 0x28


def powered(noise: NoiseModel | None = None, chip_id: int = 0xA0, *, powered_s: float = 2.0) -> ImuBench:
    """Return a world and the sensor in it, powered for a while."""
    bench = ImuBench(noise, device=SimBno055, driver=Bno055, chip_id=chip_id)
    bench.clock.sleep(powered_s)
    return bench


@pytest.fixture
def bench() -> Iterator[ImuBench]:
    bench = powered()
    yield bench
    bench.bus.close()


@pytest.fixture
def imu(bench: ImuBench) -> Iterator[Bno055]:
    with closing(bench.open()) as imu:
        yield imu


# -- opening -----------------------------------------------------------------------------------------------------------


def test_opening_waits_for_the_gyro_calibration() -> None:
    bench = powered(NoiseModel())
    with closing(bench.bus), closing(bench.open()) as imu:
        assert imu._last.calibrated
        imu.read_samples()
        rotated = 0.0
        for _ in range(100):
            bench.clock.sleep(0.04)
            rotated += imu.read_samples().gyro_dps[:, 2].sum() / imu.rate_hz
        assert abs(rotated) < 0.3


def test_opening_on_a_moving_table_ends_in_bounded_time(bench: ImuBench) -> None:
    bench.rotate(20.0)
    with closing(bench.open()) as imu:
        assert not imu._last.calibrated
        assert bench.clock.now_ns() < 6.5e9


@pytest.mark.parametrize(("chip_id", "likely"), [(0x00, "SDA is held low"), (0xFF, "not connected"), (0x42, "BNO085")])
def test_wrong_chip_is_named(chip_id: int, likely: str) -> None:
    bench = powered(chip_id=chip_id)
    with closing(bench.bus), pytest.raises(DeviceMismatch, match=likely) as caught:
        bench.open()
    assert caught.value.evidence == {"got": chip_id, "expected": 0xA0}
    assert bench.sensor._registers[0x3D] == 0  # nothing was written to the unknown device


# -- readings ----------------------------------------------------------------------------------------------------------


CARRIED_DEG = 0.01 + 0.015 / 16
"""What a reading at rest leaves to the next one; a rate of 0 may be read as one step of the gyro, 1/16 °/s."""
ROUNDED_DEG = degrees(sqrt(2) / 2**14)
"""Largest error of an orientation by rounding: half a step in two components, which belong to half of the angle."""


@examples(6)
@given(
    angles=st.lists(st.floats(-300.0, 300.0), min_size=1, max_size=3),
    pause_s=st.floats(0.012, 0.3),
    speed=st.floats(20.0, 200.0),
)
@example(angles=[0.015625, 21.0], pause_s=0.125, speed=20.0)  # it takes the first rotation for a bias of 0.016 °/s
def test_samples_sum_to_the_rotation_for_any_reading_pattern(angles: list[float], pause_s: float, speed: float) -> None:
    """The sum is the rotation that the sensor measures. It may differ from the table's: the sensor learns its bias.

    So a rotation of some hundredths of a degree in a second of rest, or the end of a larger one, becomes an error of as
    many hundredths per second.
    """
    bench = powered()
    with closing(bench.bus), closing(bench.open()) as imu:
        imu.read_samples()
        for angle in angles:
            start_s, start_deg = bench.clock.now_ns() * 1e-9, bench.world.table_deg()
            bench.world.drive(to_position(start_s, start_deg, 0.0, start_deg + angle, speed, 300.0))
            rotated, done_s = 0.0, abs(angle) / speed + speed / 300.0 + 1.0
            start_yaw_deg = bench.sensor.yaw_deg
            while bench.clock.now_ns() * 1e-9 < start_s + done_s:
                bench.clock.sleep(pause_s)
                samples = imu.read_samples()
                assert samples.lost == 0
                rotated += samples.gyro_dps[:, 2].sum() / imu.rate_hz
            measured_deg = bench.sensor.yaw_deg - start_yaw_deg
            assert rotated == pytest.approx(measured_deg, abs=2 * (CARRIED_DEG + ROUNDED_DEG))


def test_saturation_matches_the_stated_range(bench: ImuBench, imu: Bno055) -> None:
    imu.read_samples()
    bench.rotate(2100.0)
    bench.clock.sleep(0.1)
    imu.read_samples()
    bench.clock.sleep(0.02)
    assert np.abs(imu.read_samples().gyro_dps).max() >= imu.range_dps


# -- what goes wrong ---------------------------------------------------------------------------------------------------


def test_reset_while_running_is_detected(bench: ImuBench, imu: Bno055) -> None:
    bench.sensor.power_cycle()
    with pytest.raises(DeviceSilent, match="acknowledge"):
        imu.read_samples()
    bench.clock.sleep(SILENT_S)
    for reading in (imu.read_samples, imu.read_gravity_g, imu.temperature_c):
        with pytest.raises(DeviceFault, match="supply was interrupted") as caught:
            reading()
    assert caught.value.evidence["operating_mode"] == {"got": 0, "expected": 8}


def test_stopped_fusion_is_detected(bench: ImuBench, imu: Bno055) -> None:
    bench.sensor.fail(0x0A)
    with pytest.raises(DeviceFault, match="fusion") as caught:
        imu.read_samples()
    assert caught.value.evidence["system_error"] == 0x0A
    assert "i2c-gpio" in caught.value.next_step


# -- clock stretching on a Raspberry Pi 4 -----------------------------------------------------------------------------


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_bus_that_corrupts_the_identity_is_named_with_its_fix(bench: ImuBench, share: float) -> None:
    bench.bus.stretch_errors = share
    with pytest.raises(DeviceFault) as corrupt:
        for _ in range(8):  # a single reading may be right
            bench.open().close()
    assert "i2c_arm_baudrate=10000" in corrupt.value.next_step
    assert "i2c-gpio" in corrupt.value.next_step


def test_rare_corrupt_readings_are_repeated_and_counted(bench: ImuBench, imu: Bno055) -> None:
    bench.bus.stretch_errors = 0.2
    bench.rotate(30.0)
    begun_ns = bench.clock.now_ns()
    rotated = 0.0
    for _ in range(50):
        bench.clock.sleep(0.04)
        rotated += float(imu.read_samples().gyro_dps[:, 2].sum()) / imu.rate_hz
    assert rotated == pytest.approx(30.0 * (bench.clock.now_ns() - begun_ns) * 1e-9, abs=2.0)
    assert imu.statistics.corrupt > 3


def test_bench_works_with_a_bus_at_10_khz(simulated) -> None:
    s = simulated("imu.model=bno055")
    bus = s.operator.devices.i2c
    bus.bit_ns, bus.stretch_errors = 100_000, 1.0  # at this low speed, a stretch ends within its bit
    with Turntable(s.bench) as table:
        for angle_deg in (90.0, 45.0):
            move = table.goto(angle_deg)
            assert move.agrees
            assert move.gyro.valid
    assert s.bench.imu.statistics.corrupt == 0
