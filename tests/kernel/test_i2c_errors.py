"""Errors of the I2C bus, as Linux's drivers report them."""

from contextlib import closing

import pytest

from tests.kernel.guest_bench import GuestBench
from tests.kernel.machine import ARM64
from tests.kernel.usb.diolan_u2c import DiolanU2c

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]


def test_a_missing_acknowledge_is_reported_as_a_missing_sensor(bench: GuestBench) -> None:
    with bench.played.time.present():
        bench.played.devices.i2c.nack_conditions.append(lambda address: address == 0x68)
    goto = bench.rig("goto", 10)
    assert goto.code == 4
    assert f"No sensor answers at I2C address 0x68 of {bench.i2c_bus}" in goto.output
    assert "errno: 6" in goto.output  # ENXIO
    bench.restore()
    assert bench.rig("goto", 10).code == 0


def test_a_bus_that_hangs_is_an_interrupted_transfer(bench: GuestBench) -> None:
    with bench.played.time.present():
        bench.played.devices.i2c.stuck = True
    goto = bench.rig("goto", 20)
    assert goto.code == 4
    assert "errno: 5" in goto.output  # EIO: the adapter did not answer


def test_a_bus_that_hangs_is_a_timeout_at_an_adapter_that_reports_it(bench: GuestBench) -> None:
    played = bench.played
    with closing(DiolanU2c(played.devices.i2c, played.time)) as adapter:
        bus = bench.plug_in_adapter(adapter, "i2c-diolan-u2c")
        found = bench.rig("find")
        assert f"MPU-6050 at 0x68 of {bus}" in found.output
        with played.time.present():
            played.devices.i2c.stuck = True
        goto = bench.rig("goto", 20, "--set", f"imu.bus={bus}")
        assert goto.code == 4
        assert "errno: 110" in goto.output  # ETIMEDOUT


def test_a_kernel_driver_at_the_address_is_named_and_can_be_unbound(bench: GuestBench) -> None:
    number = bench.i2c_bus.removeprefix("/dev/i2c-")
    adapter = f"/sys/bus/i2c/devices/i2c-{number}"
    bench.sh(f"modprobe inv-mpu6050-i2c && echo mpu6050 0x68 > {adapter}/new_device && udevadm settle")
    try:
        goto = bench.rig("goto", 30)
        assert goto.code == 4
        assert f"The kernel driver inv-mpu6050-i2c uses I2C address 0x68 of {bench.i2c_bus}" in goto.output
        find = bench.rig("find")
        assert "inv-mpu6050-i2c" in find.output
        unbind = f"echo {number}-0068 | sudo tee /sys/bus/i2c/drivers/inv-mpu6050-i2c/unbind"
        assert unbind in goto.output
        assert unbind in find.output
        bench.sh(unbind.replace("sudo ", ""))
        assert bench.rig("goto", 30).code == 0
    finally:
        bench.sh(f"echo 0x68 > {adapter}/delete_device; modprobe -r inv-mpu6050-i2c")


def test_another_error_of_a_bus_without_the_sensor_does_not_end_the_search(bench: GuestBench) -> None:
    if bench.machine.kernel.architecture is ARM64:
        pytest.skip("Debian's kernel for arm64 has no i2c-stub")
    bench.sh("modprobe i2c-stub chip_addr=0x50 && udevadm settle")
    try:
        stub = bench.sh("basename $(dirname $(grep -l 'SMBus stub' /sys/bus/i2c/devices/i2c-*/name))")
        find = bench.rig("find", "--set", f"imu.bus=/dev/{stub}")
        assert f"MPU-6050 at 0x68 of {bench.i2c_bus}" in find.output
        goto = bench.rig("goto", 40, "--set", f"imu.bus=/dev/{stub}")
        assert goto.code == 4
        assert "errno: 19" in goto.output  # ENODEV
        assert f"No sensor answers at I2C address 0x68 of /dev/{stub}" in goto.output
    finally:
        bench.sh("modprobe -r i2c-stub")
