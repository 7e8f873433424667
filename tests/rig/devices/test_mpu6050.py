"""The real driver over the real smbus2, against the simulated sensor."""

import stat
from collections.abc import Iterator
from errno import EIO, ENXIO, ETIMEDOUT
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import load_config
from rig.core.errors import ConfigError, DeviceFault, DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.devices.mpu6050 import Mpu6050, Mpu6050Clone, Mpu6500, Mpu9250
from sim.bench import ShelfOperator, open_sim_bench
from sim.clock import VirtualClock
from sim.i2c import SimI2cBus
from sim.imu.mpu6050 import SimMpu6050, SimMpu6050Clone, SimMpu6500, SimMpu9250
from sim.motion import to_position, to_velocity
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World
from tests.fuzzing import examples

AT = 0x68


class Bench:
    """A world, the sensor in it, and the driver once it is opened."""

    def __init__(
        self,
        noise: NoiseModel | None = None,
        seed: int = 0,
        who_am_i: int | None = None,
        device: type[SimMpu6050] = SimMpu6050,
    ) -> None:
        self.world = World(noise=noise or NoiseModel.none(), seed=seed)
        self.clock = self.world.clock
        self.sensor = device(self.world, who_am_i=who_am_i)
        self.bus = SimI2cBus(self.clock)
        self.bus.attach(AT, self.sensor)
        self.imu: Mpu6050 | None = None

    def open(self, driver: type[Mpu6050] = Mpu6050, **settings: Any) -> Mpu6050:
        self.imu = driver(self.bus.path, clock=self.clock, **settings)
        return self.imu

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *_: object) -> None:
        if self.imu:
            self.imu.close()
        self.bus.close()

    def rotate(self, dps: float) -> None:
        now_ns = self.clock.now_ns()
        self.world.drive(to_velocity(now_ns * 1e-9, self.world.table_deg(), dps, dps, 1.0))

    def write(self, *data: int) -> None:
        """Do behind the driver's back what another program on the bus might."""
        self.sensor.start(reading=False)
        self.sensor.write(bytes(data))


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as b:
        yield b


@pytest.fixture
def imu(bench: Bench) -> Mpu6050:
    return bench.open()


# -- opening ------------------------------------------------------------------------------------------------------


def test_opening_wakes_and_configures_the_sensor(bench: Bench) -> None:
    imu = bench.open(range_dps=500, rate_hz=100, bandwidth_hz=20)
    written = bytes(bench.sensor._registers)
    assert written[0x19:0x1D] == bytes([9, 4, 0x08, 0x00])
    assert written[0x23] == 0x70
    assert written[0x6A:0x6C] == b"\x40\x01"
    assert (imu.identity.model, imu.identity.who_am_i, imu.identity.bus_address) == ("MPU-6050", 0x68, AT)
    assert imu.rate_hz == 100
    assert imu.range_dps == pytest.approx(500, rel=0.002)


def test_opening_resets_the_sensor(bench: Bench) -> None:
    bench.open(range_dps=2000, rate_hz=1000).close()
    bench.rotate(90.0)
    bench.clock.sleep(2.0)
    imu = bench.open()
    assert len(imu.read_samples().time_ns) <= 1
    bench.clock.sleep(0.1)
    assert imu.read_samples().gyro_dps[:, 2] == pytest.approx(90.0, abs=0.01)


@pytest.mark.parametrize(
    ("who_am_i", "likely"),
    [
        *((0x70, "MPU-6500"), (0x71, "MPU-9250"), (0x73, "MPU-9255")),
        *((0x42, "DS3231"), (0x00, "SDA is held low"), (0xFF, "not connected")),
    ],
)
def test_wrong_chip_is_named(who_am_i: int, likely: str) -> None:
    with Bench(who_am_i=who_am_i) as bench:
        with pytest.raises(DeviceMismatch, match=likely) as caught:
            bench.open()
        assert caught.value.evidence == {"got": who_am_i, "expected": 0x68}
        assert f"{who_am_i:#04x}" in caught.value.what
        assert bench.sensor._registers[0x6B] == 0x40  # nothing was written to the unknown device


@pytest.mark.parametrize(
    ("who_am_i", "model"), [(0x70, "mpu6500"), (0x71, "mpu9250"), (0x72, "mpu6050_clone"), (0x98, "mpu6050_clone")]
)
def test_other_sensor_with_a_driver_is_the_next_step(who_am_i: int, model: str) -> None:
    with Bench(who_am_i=who_am_i) as bench, pytest.raises(DeviceMismatch) as caught:
        bench.open()
    assert caught.value.next_step == f"Run `rig config set imu.model {model}`."


# -- sensors with the registers of the MPU-6050 -----------------------------------------------------------------------

PARTS = [(Mpu6500, SimMpu6500), (Mpu9250, SimMpu9250), (Mpu6050Clone, SimMpu6050Clone)]


@pytest.mark.parametrize(("driver", "device"), PARTS)
def test_fifo_of_512_bytes_is_read_until_it_is_full(driver: type[Mpu6050], device: type[SimMpu6050]) -> None:
    with Bench(NoiseModel(), device=device) as bench:
        imu = bench.open(driver)
        imu.read_samples()
        bench.clock.sleep(0.415)  # 84 samples of 6 bytes fit
        full = imu.read_samples()
        assert (len(full.time_ns), full.lost) == (pytest.approx(83, abs=1), 0)
        bench.clock.sleep(0.44)
        assert imu.read_samples().lost == pytest.approx(90, abs=3)  # reading 504 bytes takes 11 ms


@pytest.mark.parametrize(("driver", "device"), PARTS[:2])
def test_temperature_has_the_scale_of_the_part(driver: type[Mpu6050], device: type[SimMpu6050]) -> None:
    with Bench(device=device) as bench:
        bench.sensor.temperature_c = 31.5
        imu = bench.open(driver)
        bench.clock.sleep(0.1)
        assert imu.temperature_c() == pytest.approx(31.5, abs=0.01)


def test_mpu6500_that_is_awake_after_a_reset_is_a_fault() -> None:
    with Bench(device=SimMpu6500) as bench:
        imu = bench.open(Mpu6500)
        bench.sensor.power_cycle()
        with pytest.raises(DeviceFault, match="supply was interrupted"):
            imu.read_gravity_g()


@pytest.mark.parametrize("who_am_i", [0x72, 0x98])
@pytest.mark.parametrize("rate_hz", [4.0, 200.0, 1000.0])
@pytest.mark.parametrize("device", [SimMpu6050, SimMpu6050Clone])
def test_clone_that_behaves_is_accepted(who_am_i: int, rate_hz: float, device: type[SimMpu6050]) -> None:
    with Bench(NoiseModel(), who_am_i=who_am_i, device=device) as bench:
        imu = bench.open(Mpu6050Clone, rate_hz=rate_hz)
        assert (imu.identity.model, imu.identity.who_am_i) == ("MPU-6050 clone", who_am_i)
        bench.clock.sleep(max(0.03, 4 / rate_hz))
        samples = imu.read_samples()  # the self-test is over
        assert len(samples.time_ns) >= 3
        assert np.abs(samples.gyro_dps).max() < 25


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda sensor: setattr(sensor, "clock_error", -0.5), "samples instead of 50"),
        (
            lambda sensor: sensor.distortions.append(lambda words: words * np.array([1, 1, 1, 1, 0, 0, 0], ">i2")),
            "all its samples are equal",
        ),
        (lambda sensor: setattr(sensor.inertial, "accel_bias_g", sensor.inertial.up), "gravity is 2.0"),
        (lambda sensor: sensor.distortions.append(lambda words: words[::-1] * np.int16(300)), "scatter"),
        (lambda sensor: setattr(sensor, "self_test_dps", np.array([58.0, 0.0, 58.0])), "to its self-test"),
    ],
    ids=["rate", "frozen", "gravity", "noise", "self-test"],
)
def test_clone_that_misbehaves_is_rejected(spoil: Any, problem: str) -> None:
    with Bench(NoiseModel(), device=SimMpu6050Clone) as bench:
        spoil(bench.sensor)
        with pytest.raises(DeviceMismatch, match=problem):
            bench.open(Mpu6050Clone)


def test_opening_a_bench_notes_a_clone() -> None:
    world = World(seed=1)
    with open_sim_bench(load_config(None, ["imu.model=mpu6050_clone"]), ShelfOperator(world, shelf())) as bench:
        assert bench.imu.identity.gyro_noise_dps_rthz == 0.01
        assert any("clone" in finding for finding in bench.findings)


def test_missing_sensor_names_address_and_next_step(bench: Bench) -> None:
    bench.bus.detach(AT)
    with pytest.raises(DeviceNotFound, match="0x68") as caught:
        bench.open()
    for hint in ("AD0", "i2cdetect -y", "SDA"):
        assert hint in caught.value.next_step


def test_missing_bus_names_how_to_enable_it(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match=str(tmp_path)) as caught:
        Mpu6050(str(tmp_path / "i2c-1"), clock=VirtualClock())
    assert "raspi-config" in caught.value.next_step
    with pytest.raises(DeviceNotFound, match="/dev/i2c-987"):
        Mpu6050(987, clock=VirtualClock())


def test_missing_permission_names_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "i2c-1"
    path.touch(stat.S_IRUSR)

    def denied(*_: object) -> int:  # root may open anything, so the kernel's answer is played
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("smbus2.smbus2.os.open", denied)
    with pytest.raises(DeviceNotFound, match="Permission denied") as caught:
        Mpu6050(str(path), clock=VirtualClock())
    assert "group i2c" in caught.value.next_step


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_file_that_is_not_a_bus_is_rejected_and_closed(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.touch()
    before = open_files()
    with pytest.raises(DeviceNotFound, match="cannot be opened") as caught:
        Mpu6050(str(path), clock=VirtualClock())
    assert "i2cdetect -l" in caught.value.next_step
    assert open_files() == before


def test_all_wrong_settings_are_reported_at_once(bench: Bench) -> None:
    with pytest.raises(ConfigError) as caught:
        bench.open(range_dps=300, rate_hz=210, bandwidth_hz=44)
    assert set(caught.value.evidence) == {"range_dps", "rate_hz", "bandwidth_hz"}


@given(rate_hz=st.floats(allow_nan=True, allow_infinity=True) | st.integers(1, 1000).map(lambda n: 1000 / n))
def test_rate_is_set_exactly_or_rejected(rate_hz: float) -> None:
    with Bench() as bench:
        divides = rate_hz in [1000 / n for n in range(1, 257)]
        try:
            assert bench.open(rate_hz=rate_hz).rate_hz == pytest.approx(rate_hz)
        except ConfigError:
            assert not divides
        else:
            assert any(rate_hz == pytest.approx(1000 / n) for n in range(1, 257))


def test_sensor_that_loses_settings_is_a_fault(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = bench.sensor.write
    monkeypatch.setattr(bench.sensor, "write", lambda data: kept(data[:1]) + len(data) - 1)
    with pytest.raises(DeviceFault) as caught:
        bench.open()
    assert caught.value.evidence["register_0x23"] == {"got": "00", "expected": "70"}


# -- samples ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("range_dps", [250, 500, 1000, 2000])
def test_rates_are_in_degrees_per_second_up_to_the_end_of_all_ranges(bench: Bench, range_dps: int) -> None:
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
    """Times come out of the count and the rate alone; they must still be those at which the sensor sampled."""
    period_ns = divider * 1_000_000
    with Bench() as bench:
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
def test_times_follow_a_sensor_whose_clock_is_off(bench: Bench, clock_error: float) -> None:
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


def test_samples_match_the_motion(bench: Bench) -> None:
    """The order within the FIFO and the times: each sample shows the rate of its own moment (less the filter's lag)."""
    imu = bench.open(bandwidth_hz=188)
    now_s = bench.clock.now_ns() * 1e-9
    imu.read_samples()
    bench.world.drive(to_position(now_s, 0.0, 0.0, 60.0, 120.0, 400.0))
    parts = []
    for _ in range(8):
        bench.clock.sleep(0.1)
        parts.append(imu.read_samples())
    time_ns = np.concatenate([p.time_ns for p in parts])
    rate = np.concatenate([p.gyro_dps[:, 2] for p in parts])
    assert rate.max() == pytest.approx(120, abs=1)
    np.testing.assert_allclose(rate, bench.world.table_motion(time_ns)[1], atol=400 * 0.006)


def test_reading_samples_takes_two_transactions(bench: Bench, imu: Mpu6050) -> None:
    bench.clock.sleep(0.5)
    before = imu.statistics.transfers
    samples = imu.read_samples()
    assert imu.statistics.transfers - before == 2
    assert bench.bus.wire[-1].data == b"".join(np.rint(samples.gyro_dps * 131).astype(">i2"))


def test_gravity_and_temperature(bench: Bench, imu: Mpu6050) -> None:
    bench.sensor.temperature_c = 31.0
    bench.clock.sleep(0.1)
    assert imu.read_gravity_g() == pytest.approx([0, 0, 1], abs=1e-4)
    assert imu.temperature_c() == pytest.approx(31.0, abs=0.01)


# -- faults -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_ns", [0, 100_000])
def test_nack_of_the_count_or_the_data_is_retried_and_loses_nothing(bench: Bench, delay_ns: int, imu: Mpu6050) -> None:
    bench.clock.sleep(0.1)
    bench.clock.call_at(bench.clock.now_ns() + delay_ns, bench.bus.nack)
    samples = imu.read_samples()
    assert 20 <= len(samples.time_ns) <= 21
    assert samples.lost == 0
    assert imu.statistics.retries == 1


@pytest.mark.parametrize("fault", [ENXIO, ETIMEDOUT, EIO], ids=["unplugged", "stuck", "stuck behind a USB adapter"])
def test_missing_sensor_raises_device_silent(bench: Bench, fault: int, imu: Mpu6050) -> None:
    bench.clock.sleep(0.1)
    if fault == ENXIO:
        bench.bus.detach(AT)
    else:
        bench.bus.stuck, bench.bus.stuck_error = True, fault
    with pytest.raises(DeviceSilent, match="0x68") as caught:
        imu.read_samples()
    assert (caught.value.evidence["attempts"], caught.value.evidence["errno"]) == (3, fault)


def test_fifo_overflow_is_reported_and_cleared(bench: Bench, imu: Mpu6050) -> None:
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
    bench: Bench, pause_ms: int, imu: Mpu6050
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
    with Bench() as bench:
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
def test_interrupted_transfer_counts_lost_samples(bench: Bench, after_bytes: int, imu: Mpu6050) -> None:
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
def test_power_cycle_is_detected(bench: Bench, polled_ms: int, imu: Mpu6050) -> None:
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
    bench: Bench, register: int, value: int, words: str, evidence: dict[str, object], imu: Mpu6050
) -> None:
    bench.write(register, value)
    bench.clock.sleep(0.4)
    with pytest.raises(DeviceFault, match=words) as caught:
        imu.read_samples()
    assert caught.value.evidence.items() >= evidence.items()


def test_samples_read_by_another_program_count_as_lost(bench: Bench, imu: Mpu6050) -> None:
    bench.clock.sleep(0.3)
    bench.write(0x6A, 0x04)
    bench.write(0x6A, 0x40)
    bench.clock.sleep(0.1)
    samples = imu.read_samples()
    assert samples.time_ns.size == pytest.approx(20, abs=1)
    assert samples.lost == pytest.approx(60, abs=1)


def test_closed_driver_leaves_no_open_file(bench: Bench) -> None:
    before = open_files()
    imu = bench.open()
    assert open_files() == before + 1
    imu.close()
    imu.close()
    assert open_files() == before
    bench.bus.detach(AT)
    with pytest.raises(DeviceNotFound):
        bench.open()
    assert open_files() == before
