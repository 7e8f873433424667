"""From unpacked parts to the first object, with Linux's real drivers."""

import json

import pytest

from tests.kernel.conftest import FirstDay
from tests.kernel.guest_bench import GuestBench

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

PORT = "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT7WBGZ1-if00-port0"
CAMERA = "/dev/v4l/by-id/usb-046d_HD_Pro_Webcam_C920_8E2A9F0F-video-index0"


def test_find_lists_the_devices(bench: GuestBench, first_day: FirstDay) -> None:
    assert first_day.find.code == 0, first_day.find.output
    for text in (
        "/dev/ttyUSB0: XL430-W250, firmware 46, id 1 at 57600 baud",
        f"MPU-6050 at 0x68 of {bench.i2c_bus}",
        "/dev/video0: HD Pro Webcam C920: 640x480",
        f'port = "{PORT}"',
        f'source = "{CAMERA}"',
    ):
        assert text in first_day.find.output


def test_udev_rule_shortens_the_latency_timer_and_names_the_port(first_day: FirstDay) -> None:
    assert (first_day.latency_before, first_day.latency_after) == ("16", "1")
    assert first_day.link == "/dev/ttyUSB0"


def test_udev_rules_keep_brltty_from_the_port(first_day: FirstDay) -> None:
    assert first_day.brltty_before == "SYSTEMD_WANTS=brltty-device@.service"
    assert first_day.brltty_after in ("", "SYSTEMD_WANTS=")


def test_setup_writes_the_configuration_and_checks_it(first_day: FirstDay) -> None:
    output = first_day.setup.output
    assert "Wrote rig.toml." in output
    assert "✓ servo       /dev/ttyUSB0: XL430-W250, firmware 46, id 1 at 57600 baud" in output
    assert f'port = "{PORT}"' in first_day.written.splitlines()
    assert f'source = "{CAMERA}"' in first_day.written.splitlines()
    assert "✗ servo       EEPROM Operating Mode: 3 → 4" in output
    assert "✓ imu         MPU-6050 at 0x68" in output
    assert "✓ camera      frames timed by stamped exposure" in output
    assert "✓ camera      locked and read back: exposure_us 10000, white_balance_k 5000, gain 0" in output
    assert "✓ port        latency timer of /dev/ttyUSB0 is 1 ms" in output


def test_settings_are_written_and_home_is_set(first_day: FirstDay) -> None:
    assert "Written and verified." in first_day.settings.output
    assert first_day.home.code == 0, first_day.home.output


def test_goto_rotates_the_table_and_status_shows_it(bench: GuestBench) -> None:
    goto = bench.rig("goto", 90)
    assert goto.code == 0, goto.output
    assert bench.played.table()[0] == pytest.approx(90, abs=0.7)
    status = bench.rig("status", "--json")
    assert status.code == 0
    known = json.loads(status.result)
    assert known["table_deg"] == pytest.approx(90, abs=0.7)


def test_an_object_is_enrolled_and_identified(bench: GuestBench) -> None:
    enroll = bench.rig("enroll", "mug-white", "--views", 4, timeout=300)
    assert "4 views enrolled" in enroll.output, enroll.output
    assert enroll.code == 0
    identify = bench.rig("identify", timeout=300)
    assert "mug-white" in identify.output, identify.output
    assert identify.code == 0
