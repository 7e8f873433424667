"""Opening an MPU-6050 over the real smbus2: settings, sensors with the same registers, clones, missing devices."""

import stat
from errno import EAGAIN, EREMOTEIO, ETIMEDOUT
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from smbus2.smbus2 import I2C_SMBUS

from rig.core.errors import ConfigError, ControllerHangs, DeviceFault, DeviceMismatch, DeviceNotFound
from rig.core.next_steps import Do
from rig.devices.bno055 import Bno055
from rig.devices.i2c import DESIGNWARE
from rig.devices.mpu6050 import Mpu6050, Mpu6050Clone, Mpu6500, Mpu9250
from sim.clock import VirtualClock
from sim.imu.bno055 import SimBno055
from sim.imu.mpu6050 import SimMpu6050, SimMpu6050Clone, SimMpu6500, SimMpu9250
from sim.noise import NoiseModel
from tests.rig.imu_bench import AT, ImuBench

# -- opening ------------------------------------------------------------------------------------------------------


def test_opening_wakes_and_configures_the_sensor(bench: ImuBench) -> None:
    imu = bench.open(range_dps=500, rate_hz=100, bandwidth_hz=20)
    written = bytes(bench.sensor._registers)
    assert written[0x19:0x1D] == bytes([9, 4, 0x08, 0x00])
    assert written[0x23] == 0x70
    assert written[0x6A:0x6C] == b"\x40\x01"
    assert (imu.identity.model, imu.identity.who_am_i, imu.identity.bus_address) == ("MPU-6050", 0x68, AT)
    assert imu.rate_hz == 100
    assert imu.range_dps == pytest.approx(500, rel=0.002)


def test_opening_resets_the_sensor(bench: ImuBench) -> None:
    bench.open(range_dps=2000, rate_hz=1000).close()
    bench.rotate(90.0)
    bench.clock.sleep(2.0)
    imu = bench.open()
    assert len(imu.read_samples().time_ns) <= 1
    bench.clock.sleep(0.1)
    assert imu.read_samples().gyro_dps[:, 2] == pytest.approx(90.0, abs=0.01)


@pytest.mark.parametrize(
    ("who_am_i", "likely", "model"),
    [
        *((0x70, "MPU-6500", "mpu6500"), (0x71, "MPU-9250", "mpu9250"), (0x73, "MPU-9255", None)),
        *((0x72, "MPU-6050 clone", "mpu6050_clone"), (0x98, "MPU-6050 clone", "mpu6050_clone")),
        *((0x42, "DS3231", None), (0x00, "SDA is held low", None), (0xFF, "not connected", None)),
    ],
)
def test_wrong_chip_is_named_and_set_if_it_has_a_driver(who_am_i: int, likely: str, model: str | None) -> None:
    with ImuBench(who_am_i=who_am_i) as bench:
        with pytest.raises(DeviceMismatch, match=likely) as caught:
            bench.open()
        assert caught.value.evidence == {"got": who_am_i, "expected": 0x68}
        assert f"{who_am_i:#04x}" in caught.value.what
        assert bench.sensor._registers[0x6B] == 0x40  # nothing was written to the unknown device
        assert (caught.value.steps == (Do.SET_KEY(key="imu.model", value=model),)) == (model is not None)


# -- sensors with the registers of the MPU-6050 -----------------------------------------------------------------------

PARTS = [(Mpu6500, SimMpu6500), (Mpu9250, SimMpu9250), (Mpu6050Clone, SimMpu6050Clone)]


@pytest.mark.parametrize(("driver", "device"), PARTS)
def test_fifo_of_512_bytes_is_read_until_it_is_full(driver: type[Mpu6050], device: type[SimMpu6050]) -> None:
    with ImuBench(NoiseModel(), device=device) as bench:
        imu = bench.open(driver)
        imu.read_samples()
        bench.clock.sleep(0.415)  # 84 samples of 6 bytes fit
        full = imu.read_samples()
        assert (len(full.time_ns), full.lost) == (pytest.approx(83, abs=1), 0)
        bench.clock.sleep(0.44)
        assert imu.read_samples().lost == pytest.approx(90, abs=3)  # reading 504 bytes takes 11 ms


def test_mpu6500_that_is_awake_after_a_reset_is_a_fault() -> None:
    with ImuBench(device=SimMpu6500) as bench:
        imu = bench.open(Mpu6500)
        bench.sensor.power_cycle()
        with pytest.raises(DeviceFault, match="supply was interrupted"):
            imu.read_gravity_g()


@pytest.mark.parametrize(
    ("who_am_i", "rate_hz", "device"),
    [(0x72, 4.0, SimMpu6050), (0x98, 200.0, SimMpu6050Clone), (0x72, 1000.0, SimMpu6050Clone)],
)
def test_clone_with_plausible_samples_is_accepted(who_am_i: int, rate_hz: float, device: type[SimMpu6050]) -> None:
    with ImuBench(NoiseModel(), who_am_i=who_am_i, device=device) as bench:
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
def test_clone_with_implausible_samples_is_rejected(spoil: Any, problem: str) -> None:
    with ImuBench(NoiseModel(), device=SimMpu6050Clone) as bench:
        spoil(bench.sensor)
        with pytest.raises(DeviceMismatch, match=problem):
            bench.open(Mpu6050Clone)


@pytest.mark.parametrize(
    ("device", "driver", "pin"), [(SimMpu6050, Mpu6050, "AD0"), (SimBno055, partial(Bno055, address=0x28), "ADR")]
)
def test_missing_sensor_names_address_and_next_step(device: Any, driver: Any, pin: str) -> None:
    with ImuBench(device=device, driver=driver) as bench:
        bench.bus.detach(bench.sensor.address)
        with pytest.raises(DeviceNotFound, match=f"{bench.sensor.address:#04x}") as caught:
            bench.open()
    for hint in (pin, "i2cdetect -y", "SDA"):
        assert hint in caught.value.next_step


def test_controller_that_hangs_has_its_own_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(adapter: str, *failures: int, device: Any = SimMpu6050, driver: Any = Mpu6050) -> Any:
        with ImuBench(device=device, driver=driver) as bench:
            waiting, kernel = list(failures), bench.bus.ioctl
            bench.bus.name = adapter

            def ioctl(fd: int, request: int, argument: Any) -> int:
                if waiting and request == I2C_SMBUS:
                    raise OSError(waiting.pop(0), "")
                return kernel(fd, request, argument)

            monkeypatch.setattr(bench.bus, "ioctl", ioctl)
            return bench.open().identity.model

    for parts in ({}, {"device": SimBno055, "driver": partial(Bno055, address=0x28)}):
        for failures in ((ETIMEDOUT,) * 4, (EREMOTEIO, ETIMEDOUT, EREMOTEIO, EAGAIN)):
            with pytest.raises(ControllerHangs, match="hangs") as caught:
                opened(DESIGNWARE, *failures, **parts)
            assert "off for 10 seconds" in caught.value.next_step
    with pytest.raises(DeviceNotFound):  # an unplugged sensor
        opened(DESIGNWARE, *(EREMOTEIO,) * 3)
    with pytest.raises(DeviceNotFound):
        opened("bcm2835 (i2c@7e804000)", *(ETIMEDOUT,) * 3)
    assert opened(DESIGNWARE, *(ETIMEDOUT,) * 3) == "MPU-6050"  # after the bus was opened again


def test_missing_bus_names_how_to_enable_it(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match=str(tmp_path)) as caught:
        Mpu6050(str(tmp_path / "i2c-1"), clock=VirtualClock())
    assert "raspi-config" in caught.value.next_step
    with pytest.raises(DeviceNotFound, match="/dev/i2c-987"):
        Mpu6050(987, clock=VirtualClock())


def test_missing_permission_names_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "i2c-1"
    path.touch(stat.S_IRUSR)

    def denied(*_: object) -> int:  # root may open any file, so the kernel's answer is simulated
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


@given(rate_hz=st.floats(allow_nan=True, allow_infinity=True) | st.integers(1, 1000).map(lambda n: 1000 / n))
def test_rate_is_set_exactly_or_rejected(rate_hz: float) -> None:
    with ImuBench() as bench:
        divides = rate_hz in [1000 / n for n in range(1, 257)]
        try:
            assert bench.open(rate_hz=rate_hz).rate_hz == pytest.approx(rate_hz)
        except ConfigError:
            assert not divides
        else:
            assert any(rate_hz == pytest.approx(1000 / n) for n in range(1, 257))
