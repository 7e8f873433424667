"""Cables that are pulled, at rest and while the table rotates."""

import json

import pytest

from tests.kernel.guest_bench import GuestBench
from tests.kernel.test_ends import STOPPED_S, rotating
from tests.kernel.test_first_day import CAMERA

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]


def test_without_the_servo_the_table_does_not_move_and_status_shows_the_others(bench: GuestBench) -> None:
    bench.unplug(bench.played.servo)
    goto = bench.rig("goto", 30)
    assert goto.code == 4, goto.output
    assert "Check the USB cable" in goto.output
    status = bench.rig("status", "--json")
    known = json.loads(status.result)
    assert known["imu"]["model"] == "MPU-6050"
    bench.plug_in(bench.played.servo)
    assert bench.sh("cat /sys/bus/usb-serial/devices/ttyUSB0/latency_timer; readlink -f /dev/rig-servo") == (
        "1\n/dev/ttyUSB0"
    )
    assert bench.rig("goto", 30).code == 0


def test_imu_and_camera_that_were_unplugged_at_rest_are_used_again(bench: GuestBench) -> None:
    bus = bench.i2c_bus
    bench.unplug(bench.played.imu, bench.played.camera)
    goto, snapshot = bench.rig("goto", 10), bench.rig("snapshot", "missing.png")
    assert (goto.code, snapshot.code) == (4, 4), (goto.output, snapshot.output)
    assert bus in goto.output
    assert CAMERA in snapshot.output
    bench.plug_in(bench.played.imu, bench.played.camera)
    assert bench.rig("goto", 10).code == 0
    assert bench.rig("snapshot", "plugged.png").code == 0


def test_table_stops_when_the_servo_is_unplugged_while_it_rotates(bench: GuestBench) -> None:
    goto = rotating(bench)
    bench.played.servo.unplug()
    bench.until(lambda: bench.played.table()[1] == 0, "the table stands", STOPPED_S)
    ended = goto.wait()
    assert ended.code != 0
    bench.plug_in(bench.played.servo)
    bench.restore()
    assert bench.rig("goto", 90).code == 0


def test_table_stops_when_the_imu_is_unplugged_while_it_rotates(bench: GuestBench) -> None:
    goto = rotating(bench)
    bench.unplug(bench.played.imu)
    bench.until(lambda: bench.played.table()[1] == 0, "the table stands", 30)
    ended = goto.wait()
    assert ended.code == 4, ended.output
    assert "stopped answering" in ended.output
    bench.plug_in(bench.played.imu)
    bench.restore()
    assert bench.rig("goto", 60).code == 0


@pytest.mark.parametrize("pause_s", [0.0, 1.0])
def test_an_enrollment_continues_when_the_camera_was_unplugged(bench: GuestBench, pause_s: float) -> None:
    enroll = bench.start("enroll", f"mug-{pause_s:.0f}", "--views", 4)
    bench.until_printed(enroll, "view 1, azimuth")
    bench.played.camera.unplug()
    bench.until(lambda: bench.played.camera.plug is None, "the camera is unplugged")
    bench.pause(pause_s)
    bench.plug_in(bench.played.camera)
    ended = enroll.wait(300)
    assert ended.code == 0, ended.output
    assert "4 views enrolled" in ended.output
