"""Samples and faults of an MPU-6050: the real driver over the real smbus2, against the simulated sensor."""

from errno import EIO, ENXIO, ETIMEDOUT

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.errors import DeviceFault, DeviceSilent
from rig.devices.mpu6050 import Mpu6050
from tests.fuzzing import examples
from tests.rig.imu_bench import AT, ImuBench

# -- samples ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("range_dps", [250, 500, 1000, 2000])
def test_rates_are_in_degrees_per_second_up_to_the_end_of_all_ranges(bench: ImuBench, range_dps: int) -> None:
    imu = bench.open(range_dps=range_dps)
    bench.rotate(-123.4)
    bench.clock.sleep(0.3)
    gyro = imu.read_samples().gyro_dps
    assert gyro[-1] == pytest.approx([0, 0, -123.4], abs=range_dps / 32000)
    for sign in (1, -1):
        bench.rotate(sign * 2 * range_dps)
        bench.clock.sleep(0.3)
        assert abs(imu.read_samples().gyro_dps[-1, 2]) >= imu.range_dps


@given(pauses_ms=st.lists(st.integers(0, 300), min_size=2, max_size=10), divider=st.integers(2, 40))
@examples(9)
def test_sample_times_are_even_and_correct(pauses_ms: list[int], divider: int) -> None:
    """Times are computed from the count and the rate; they must be the true sample times."""
    period_ns = divider * 1_000_000
    with ImuBench() as bench:
        imu = bench.open(rate_hz=1000 / divider)
        start_ns = bench.sensor._epoch_ns
        parts, newest_ns = [], 0
        for pause in pauses_ms:
            bench.clock.sleep(min(pause, 100 * divider) * 1e-3)
            latched_ns = bench.clock.now_ns() + 3 * 22_500  # the count, after address, register and address
            samples = imu.read_samples()
            assert samples.lost == 0
            parts.append(samples.time_ns)
            newest_ns = start_ns + (latched_ns - start_ns) // period_ns * period_ns
            if samples.time_ns.size:
                assert samples.time_ns[-1] == pytest.approx(newest_ns, abs=period_ns // 2 + 200_000)
        time_ns = np.concatenate(parts)
        assert all(np.diff(time_ns) > 0)
        assert all(np.ptp(np.diff(part)) <= 1 for part in parts if part.size > 1)
        due = (newest_ns - start_ns) // period_ns
        assert due - 1 <= time_ns.size <= due + 1  # none lost, none invented


@pytest.mark.parametrize("clock_error", [-0.03, -0.005, 0.005, 0.03])
def test_times_follow_a_sensor_whose_clock_is_off(bench: ImuBench, clock_error: float) -> None:
    bench.sensor.clock_error = clock_error
    imu = bench.open()
    last_ns = 0
    for _ in range(100):
        bench.clock.sleep(0.15)
        before_ns = bench.clock.now_ns()
        samples = imu.read_samples()
        assert samples.lost == 0
        assert before_ns - 5_000_000 <= samples.time_ns[-1] <= bench.clock.now_ns()
        assert samples.time_ns[0] > last_ns
        last_ns = samples.time_ns[-1]


def test_reading_samples_takes_two_transactions(bench: ImuBench, imu: Mpu6050) -> None:
    bench.clock.sleep(0.5)
    before = imu.statistics.transfers
    samples = imu.read_samples()
    assert imu.statistics.transfers - before == 2
    assert bench.bus.wire[-1].data == b"".join(np.rint(samples.gyro_dps * 131).astype(">i2"))


def test_gravity_and_temperature_are_measured(bench: ImuBench, imu: Mpu6050) -> None:
    bench.sensor.temperature_c = 31.0
    bench.clock.sleep(0.1)
    assert imu.read_gravity_g() == pytest.approx([0, 0, 1], abs=1e-4)
    assert imu.temperature_c() == pytest.approx(31.0, abs=0.01)


# -- faults -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_ns", [0, 100_000])
def test_nack_of_the_count_or_the_data_is_retried_and_loses_nothing(
    bench: ImuBench, delay_ns: int, imu: Mpu6050
) -> None:
    bench.clock.sleep(0.1)
    bench.clock.call_at(bench.clock.now_ns() + delay_ns, bench.bus.nack)
    samples = imu.read_samples()
    assert 20 <= len(samples.time_ns) <= 21
    assert samples.lost == 0
    assert imu.statistics.retries == 1


@pytest.mark.parametrize("fault", [ENXIO, ETIMEDOUT, EIO], ids=["unplugged", "stuck", "stuck behind a USB adapter"])
def test_missing_sensor_raises_device_silent(bench: ImuBench, fault: int, imu: Mpu6050) -> None:
    bench.clock.sleep(0.1)
    if fault == ENXIO:
        bench.bus.detach(AT)
    else:
        bench.bus.stuck, bench.bus.stuck_error = True, fault
    with pytest.raises(DeviceSilent, match="0x68") as caught:
        imu.read_samples()
    assert (caught.value.evidence["attempts"], caught.value.evidence["errno"]) == (3, fault)


def test_pause_of_the_computer_while_the_bytes_are_counted_loses_no_sample(bench: ImuBench, imu: Mpu6050) -> None:
    bench.clock.sleep(0.1)
    imu.read_samples()
    bench.clock.sleep(0.3)
    pauses_ns = iter([350_000_000])
    bench.bus.held = lambda time_ns: time_ns + next(pauses_ns, 0)
    samples = imu.read_samples()
    assert samples.lost == 0
    assert samples.time_ns.size == pytest.approx(0.65 * imu.rate_hz, abs=2)


def test_fifo_overflow_is_reported_and_cleared(bench: ImuBench, imu: Mpu6050) -> None:
    bench.rotate(30.0)
    bench.clock.sleep(1.5)
    overflowed = imu.read_samples()
    assert overflowed.time_ns.size == overflowed.gyro_dps.size == 0
    assert 298 <= overflowed.lost <= 303
    assert imu.statistics.overflows == 1
    bench.clock.sleep(0.2)
    after = imu.read_samples()
    assert after.lost == 0
    assert 38 <= after.time_ns.size <= 41
    assert after.gyro_dps == pytest.approx(np.tile([0, 0, 30.0], (after.time_ns.size, 1)), abs=0.01)


@pytest.mark.parametrize("pause_ms", [140, 240])
def test_fifo_that_overflows_between_count_and_data_gives_no_corrupt_samples(
    bench: ImuBench, pause_ms: int, imu: Mpu6050
) -> None:
    """A computer that is busy, or sleeps, continues late."""
    bench.rotate(100.0)
    imu.read_samples()
    bench.clock.sleep(0.75)  # 150 of 170 samples
    transfers = []

    def pause(_: int) -> bool:
        transfers.append(bench.clock.now_ns())
        if len(transfers) == 3:  # the register of the data; 1 and 2 read the count
            bench.clock.sleep(pause_ms * 1e-3)
        return False

    bench.bus.nack_conditions.append(pause)
    samples = imu.read_samples()
    assert samples.lost >= 150
    assert samples.time_ns.size == 0
    bench.clock.sleep(0.1)
    assert imu.read_samples().gyro_dps[:, 2] == pytest.approx(100.0, abs=1)


@given(frames=st.integers(168, 172), early_us=st.integers(-50, 250))
@examples(17)
def test_full_fifo_never_corrupts_samples(frames: int, early_us: int) -> None:
    """Another sample may arrive between the reading of the count and that of the data."""
    with ImuBench() as bench:
        imu = bench.open()
        bench.rotate(100.0)
        imu.read_samples()
        taken = (bench.clock.now_ns() - bench.sensor._epoch_ns) // 5_000_000
        bench.clock.advance_to(bench.sensor._epoch_ns + (taken + frames) * 5_000_000 - early_us * 1000)
        samples = imu.read_samples()
        assert samples.lost or samples.time_ns.size
        assert samples.gyro_dps[5:] == pytest.approx(
            np.tile([0, 0, 100.0], (max(len(samples.time_ns) - 5, 0), 1)), abs=1
        )


@pytest.mark.parametrize("after_bytes", [2, 6, 12, 100])
def test_interrupted_transfer_counts_lost_samples(bench: ImuBench, after_bytes: int, imu: Mpu6050) -> None:
    bench.rotate(10.0)
    bench.clock.sleep(0.2)
    bench.bus.cut_read(after_bytes)  # the two bytes of the count still pass
    samples = imu.read_samples()
    assert samples.time_ns.size == 0
    assert samples.lost == pytest.approx(40, abs=2)
    assert imu.statistics.retries == 1
    bench.clock.sleep(0.1)
    after = imu.read_samples()
    assert after.lost == 0
    assert after.gyro_dps[:, 2] == pytest.approx(10.0, abs=0.01)


@pytest.mark.parametrize("polled_ms", [5, 20, 100, 500])
def test_power_cycle_is_detected(bench: ImuBench, polled_ms: int, imu: Mpu6050) -> None:
    bench.rotate(45.0)
    bench.clock.sleep(0.1)
    imu.read_samples()
    bench.sensor.power_cycle()

    def poll() -> None:
        for _ in range(20):
            bench.clock.sleep(polled_ms * 1e-3)
            assert imu.read_samples().time_ns.size == 0

    with pytest.raises(DeviceFault, match="supply was interrupted"):
        poll()
    for reading in (imu.read_samples, imu.read_gravity_g, imu.temperature_c):
        with pytest.raises(DeviceFault):
            reading()


@pytest.mark.parametrize(
    ("register", "value", "words", "evidence"),
    [
        (0x19, 19, "another program", {"register_0x19": {"got": "13030000", "expected": "04030000"}}),  # the rate
        (0x6B, 0x41, "fell asleep", {}),
    ],
)
def test_settings_changed_by_another_program_are_detected(
    bench: ImuBench, register: int, value: int, words: str, evidence: dict[str, object], imu: Mpu6050
) -> None:
    bench.write(register, value)
    bench.clock.sleep(0.4)
    with pytest.raises(DeviceFault, match=words) as caught:
        imu.read_samples()
    assert caught.value.evidence.items() >= evidence.items()


def test_samples_read_by_another_program_count_as_lost(bench: ImuBench, imu: Mpu6050) -> None:
    bench.clock.sleep(0.3)
    bench.write(0x6A, 0x04)
    bench.write(0x6A, 0x40)
    bench.clock.sleep(0.1)
    samples = imu.read_samples()
    assert samples.time_ns.size == pytest.approx(20, abs=1)
    assert samples.lost == pytest.approx(60, abs=1)
