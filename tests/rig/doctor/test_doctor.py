"""Findings of `rig doctor`: each problem is found with its fix, and stops no other check."""

import os
import sqlite3
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rig.bench.computer import Disk, User
from rig.calibrations import CalibrationResult, CalibrationStore, Estimate
from rig.catalog import Catalog
from rig.core.clock import SystemClock
from rig.core.errors import DeviceSilent
from rig.doctor.checks import CHECKS
from rig.doctor.computer import udev_rules
from rig.doctor.examination import Check, run_checks
from rig.doctor.finding import Severity, fine
from rig.safety.saved_state import BenchLock, FileStore, LatchedFault, holder
from rig.safety.saved_state import BenchState as State
from sim.clock import VirtualClock
from sim.faults import Faults, fault_kinds
from sim.faults.schedule import read_faults
from tests.rig.catalog.catalog_samples import fill
from tests.rig.doctor.doctor_parts import unopened

PING, READ = 0x01, 0x02
GID = os.getgid()
ADA = User("ada", 4242, frozenset({GID + 1}))


def set_up(bench) -> None:
    """Give the servo the settings that the rig needs."""
    for name, value in {"Operating Mode": 4, "Return Delay Time": 0}.items():
        bench.devices.servo.memory[name] = value


def one(problems: dict[str, str]) -> tuple[str, str]:
    """Return the only trouble there is."""
    ((text, fix),) = problems.items()
    return text, fix


@pytest.fixture
def bench():
    with unopened() as bench:
        yield bench


def test_sound_bench_lacks_only_its_calibration(bench):
    set_up(bench)
    findings = bench.findings()
    assert {f.topic for f in findings} == {check.topic for check in CHECKS}
    (trouble,) = [f for f in findings if f.level is not Severity.FINE]
    assert trouble.topic == "calibration"
    assert trouble.fix == "rig calibrate imu --bench sim"
    assert bench.instructions <= {PING, READ}  # nothing is written, so nothing can move


def test_empty_computer_reports_each_missing_device():
    with unopened(plugged=False) as bench:
        bench.devices.adapter.unplug()
        bench.devices.camera.unplug()
        bench.devices.i2c.detach(0x68)
        findings = bench.findings()
        bad = {f.topic for f in findings if f.level is Severity.BAD}
        assert bad == {"port", "servo", "imu", "camera"}
        assert all(f.fix for f in findings if f.level is not Severity.FINE)
        assert {f.topic for f in findings if f.level is Severity.FINE} >= {"bench", "disk", "clock", "catalog"}


# -- the computer -----------------------------------------------------------------------------------------------------


def test_latency_timer_is_fixed_by_one_command():
    with unopened(plugged=False) as bench:
        bench.computer.serial_port(latency_ms=16)
        bench.computer.i2c_bus()
        bench.computer.camera()
        text, fix = one(bench.problems("port"))
        assert "is 16 ms" in text
        assert fix == "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer"


@pytest.mark.parametrize(("members", "command"), [((), "sudo usermod -aG dialout ada"), (("ada",), "newgrp dialout")])
def test_missing_permission_names_the_group_or_the_new_login(members, command):
    with unopened(plugged=False, user=ADA) as bench:
        bench.computer.group("dialout", GID, *members)
        bench.computer.serial_port(mode=0o660)
        bench.computer.i2c_bus(mode=0o666)
        bench.computer.camera(mode=0o666)
        text, fix = one(bench.problems("port"))
        assert "ada has no permission for /dev/ttyUSB0" in text
        assert fix == command


def test_port_of_root_is_fixed_by_udev_rules():
    with unopened(plugged=False, user=ADA) as bench:
        bench.computer.group("root", GID)
        bench.computer.serial_port(mode=0o600, serial="FT3M9M97")
        bench.computer.i2c_bus(mode=0o666)
        bench.computer.camera(mode=0o666)
        _, fix = one(bench.problems("port"))
        assert fix.startswith("rig doctor --udev --bench sim | sudo tee /etc/udev/rules.d/")
        rules = udev_rules(bench.context.computer.serial_ports())
        assert 'ATTR{latency_timer}="1"' in rules
        assert 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014", ATTRS{serial}=="FT3M9M97"' in rules
        assert 'SYMLINK+="rig-servo"' in rules
        assert rules.count("rig-servo") == 1


@pytest.mark.parametrize(
    ("command", "fix"),
    [("dynamixel_wizard", "kill 77"), ("/usr/sbin/ModemManager", "sudo systemctl disable --now ModemManager")],
)
def test_port_in_use_names_the_process(command, fix, bench):
    bench.computer.process(77, command, "/dev/ttyUSB0")
    text, told = one(bench.problems("port"))
    assert f"in use by process 77 ({command})" in text
    assert told == fix


def test_other_port_is_proposed_by_its_permanent_name():
    with unopened(plugged=False) as bench:
        bench.computer.serial_port("ttyUSB3", serial="FT7")
        bench.computer.i2c_bus(4)
        bench.computer.camera(2, "Cam")
        fixes = list(bench.problems("port").values())
        assert fixes == [
            "rig config set servo.port /dev/serial/by-id/usb-FTDI_USB_-__Serial_Converter_FT7-if00-port0",
            "rig config set imu.bus 4",
            "rig config set camera.source /dev/v4l/by-id/usb-Cam-video-index0",
        ]
        bench.computer.serial_port("ttyUSB4", serial="B")
        assert next(iter(bench.problems("port").values())) == "rig setup --bench sim"


def test_bench_in_use_is_not_touched(bench):
    path = bench.context.config.state_path("sim")
    lock = BenchLock(path, SystemClock())
    bench.context.holder = holder(path)
    findings = bench.findings()
    lock.close()
    told = {f.topic: f for f in findings if f.level is Severity.WARNING}
    assert f"process {os.getpid()}" in told["bench"].text
    assert {"servo", "imu", "camera"} <= set(told)
    assert told["servo"].fix == "rig stop --bench sim"
    assert not bench.sent


def test_latched_fault_and_damaged_state_are_reported(bench):
    store = FileStore(bench.context.config.state_path("sim"))
    utc = "2026-05-01T10:00:00+00:00"
    store.save(State(fault=LatchedFault.of(DeviceSilent("Servo 1 is gone.", next_step="Look."), utc)))
    text, fix = one(bench.problems("bench"))
    assert "fault 402" in text
    assert "Servo 1 is gone." in text
    assert fix == "rig acknowledge --bench sim"
    store.latch(None)
    (store.path / "state.json").write_text("{")
    text, fix = one(bench.problems("bench"))
    assert "damaged" in text
    assert "rig home --turns" in fix


@pytest.mark.parametrize(("free", "level"), [(50e9, Severity.FINE), (1e9, Severity.WARNING), (1e8, Severity.BAD)])
def test_free_space_is_reported_in_objects(monkeypatch, free, level, bench):
    monkeypatch.setattr(type(bench.context.computer), "disk", lambda *_: Disk(int(free), network=False))
    (finding,) = bench.findings("disk")
    assert finding.level is level
    assert f"about {int(free / 500_000) // 72} more objects" in finding.text


@pytest.mark.parametrize(
    ("disk", "words", "fixed_by"),
    [
        (Disk(10**11, network=True), "network file system", ""),
        (Disk(10**11, network=False, writable=False), "may not write", "rig config set catalog.path FOLDER"),
    ],
)
def test_network_disk_and_read_only_folder_are_reported(monkeypatch, disk, words, fixed_by, bench):
    monkeypatch.setattr(type(bench.context.computer), "disk", lambda *_: disk)
    text, fix = one(bench.problems("disk"))
    assert words in text
    assert fixed_by in fix


def test_unsynchronized_clock_is_a_warning_and_wrong_date_is_bad():
    with unopened(plugged=False) as bench:
        assert "no time server that is known" in one(bench.problems("clock"))[0]
        bench.computer.keeps_time(synchronised=False)
        text, fix = one(bench.problems("clock"))
        assert "no time server has been reached" in text
        assert fix == "sudo timedatectl set-ntp true"
        bench.computer.keeps_time()
        assert not bench.problems("clock")
        bench.context.computer.clock = VirtualClock(start_utc=datetime(1970, 1, 1, tzinfo=UTC))
        (wrong,) = [f for f in bench.findings("clock") if f.level is Severity.BAD]
        assert "1970-01-01" in wrong.text


def test_time_jump_and_long_pause_are_reported():
    class Bad(VirtualClock):
        """Sleeps too long, and its civil time jumps meanwhile."""

        jump = timedelta()

        def sleep(self, seconds):
            super().sleep(seconds + 1.0)
            self.jump = timedelta(hours=1)

        def utc(self):
            return super().utc() + self.jump

    with unopened() as bench:
        bench.context.computer.clock = Bad()
        texts = "\n".join(bench.problems("clock"))
        assert "took 1020 ms" in texts
        assert "jumped by +3600.0 s" in texts


# -- the servo --------------------------------------------------------------------------------------------------------


def test_torque_watchdog_and_factory_settings_are_reported_and_not_changed(bench):
    memory = bench.devices.servo.memory
    problems = bench.problems("servo")
    assert set(problems.values()) == {"rig servo settings --write --bench sim"}
    assert any(text.startswith("EEPROM Operating Mode: 3 → 4") for text in problems)
    assert any(text.startswith("EEPROM Return Delay Time: 250 → 0") for text in problems)
    memory["Torque Enable"], memory["Bus Watchdog"] = 1, 0xFF
    texts = "\n".join(bench.problems("servo"))
    assert "torque is on" in texts
    assert "watchdog tripped" in texts
    assert (memory["Torque Enable"], memory["Operating Mode"]) == (1, 3)


@pytest.mark.parametrize(
    ("place", "fix"),
    [
        ((3, 57_600), "rig config set servo.id 3"),
        ((1, 1_000_000), "rig config set servo.baud 1000000"),
        ((3, 1_000_000), "rig setup --bench sim"),
    ],
)
def test_servos_at_another_id_or_rate_are_found(place, fix):
    with unopened(servo_at=place) as bench:
        text, told = one(bench.problems("servo"))
        assert f"id {place[0]} at {place[1]} baud" in text
        assert told == fix
        bench.add_servo(4, 115_200)
        text, told = one(bench.problems("servo"))
        assert "2 others" in text
        assert told == "rig setup --bench sim"


def test_missing_servo_asks_for_power(bench):
    bench.devices.servo_bus.detach(bench.devices.servo)
    text, fix = one(bench.problems("servo"))
    assert "nor any other at any baud rate" in text
    assert "12 V" in fix


def test_second_servo_is_reported_and_duplicate_id_is_bad(bench):
    set_up(bench)
    bench.add_servo(7, 57_600)
    assert not bench.problems("servo")
    assert any("also on the bus" in f.text and "id 7" in f.text for f in bench.findings("servo"))
    bench.add_servo(1, 57_600)
    text, fix = one(bench.problems("servo"))
    assert "two servos answer at once to id 1" in text
    assert "rig servo set-id 2 --bench sim" in fix


def test_other_model_can_be_configured():
    with unopened("servo.model=xm430_w350") as bench:
        bench.devices.servo_bus.detach(bench.devices.servo)
        bench.add_servo(1, 57_600, "xl430_w250")
        assert one(bench.problems("servo"))[1] == "rig config set servo.model xl430_w250"


def test_ax_12a_reports_its_missing_functions():
    with unopened("servo.model=ax_12a", "table.mode=pan", "servo.baud=1000000") as bench:
        bench.devices.servo.memory["Return Delay Time"] = 0
        texts = "\n".join(bench.problems("servo"))
        assert "no watchdog" in texts
        assert "EEPROM" not in texts


# -- faults of the whole vocabulary -----------------------------------------------------------------------------------

FOUND = {
    "servo.off": ("servo", "no servo answers"),
    "servo.stuck": ("servo", "frozen"),
    "servo.garbage": ("servo", "impossible"),
    "servo.slow": ("servo", "slow"),
    "servo.intermittent": ("servo", "repeated"),
    "crc_flip": ("servo", "repeated"),
    "late_reply": ("servo", "repeated"),
    "babble": ("servo", "do not belong to a servo"),
    "unplug": ("servo", "Cannot open"),
    "duplicate_id": ("servo", "two servos"),
    "wrong_model": ("servo", "not the configured model"),
    "brownout": ("servo", "no servo answers"),
    "overload": ("servo", "overload"),
    "overheat": ("servo", "overheating"),
    "imu.off": ("imu", "no device answers"),
    "imu.stuck": ("imu", "frozen"),
    "imu.garbage": ("imu", "more than a table at rest"),
    "imu.slow": ("imu", "samples in"),
    "imu_saturated": ("imu", "saturated"),
    "i2c_stuck": ("imu", "is stuck"),
    "camera.off": ("camera", "no camera"),
    "camera.stuck": ("camera", "no frame"),
    "camera.garbage": ("camera", "noise instead of an image"),
    "camera.wrong": ("camera", "320x240"),
    "camera.slow": ("camera", "2 a second"),
    "camera.delayed": ("camera", "too old"),
    "frozen_frame": ("camera", "frozen"),
    "black_frame": ("camera", "black"),
    "light_flicker": ("camera", "light changes"),
}
"""Faults that show while nothing moves: which check finds them, and a word of what it says."""

LOOKS = {"frozen_frame", "black_frame", "blur", "exposure_jump", "light_flicker", "object_falls"}
"""Those that a camera may see; its frames are what takes time here."""


@pytest.mark.parametrize("name", sorted(fault_kinds()))
def test_all_checks_end_under_every_fault_and_find_visible_ones(name, bench):
    set_up(bench)
    faults = Faults(bench.devices)
    faults.schedule(*read_faults([name]))
    seen = name.startswith("camera") or name in LOOKS
    findings = bench.findings("port", "servo", "imu", "clock", *(["camera"] if seen else []))
    faults.clear()
    problems = [f for f in findings if f.level is not Severity.FINE]
    assert all(f.fix for f in problems)
    assert not any("the check itself failed" in f.text or "given up" in f.text for f in findings)
    if name in FOUND:
        topic, word = FOUND[name]
        assert any(f.topic == topic and word.lower() in f.text.lower() for f in problems), problems
        others = {f.topic for f in problems} - {topic}
        assert not others


# -- the IMU ----------------------------------------------------------------------------------------------------------


def test_imu_of_another_address_axis_or_kind_is_found():
    with unopened("imu.address=0x69") as bench:
        device = bench.devices.i2c.detach(0x69)
        bench.devices.i2c.attach(0x68, device)
        assert one(bench.problems("imu"))[1] == "rig config set imu.address 0x68"
    with unopened("imu.model=bno055") as bench:
        bench.context.computer.clock.sleep(1.0)  # it is silent for a while after power-up
        assert not bench.problems("imu")
    with unopened("imu.axis=x") as bench:
        assert one(bench.problems("imu"))[1] == "rig config set imu.axis z"
    with unopened() as bench:
        bench.devices.imu.who_am_i = 0x70
        assert "MPU-6500" in one(bench.problems("imu"))[0]


def test_imu_on_a_rig_head_is_checked():
    with unopened("imu.connection=head", "head.port=/dev/ttyUSB1") as bench:
        set_up(bench)
        bench.computer.serial_port("ttyUSB1", serial="HEAD")
        assert not bench.problems("port", "servo", "imu")
        assert any("rig head" in f.text for f in bench.findings("imu"))
        bench.devices.head.unplugged = True
        assert "No rig head" in one(bench.problems("imu"))[0]


def test_servo_behind_the_relay_is_not_reported_missing():
    with unopened("imu.connection=head", "head.port=/dev/ttyUSB1", "head.power=true") as bench:
        text, _ = one(bench.problems("servo"))
        assert "relay" in text


# -- what is kept -----------------------------------------------------------------------------------------------------


def enroll(path: Path, views: int) -> None:
    with Catalog.open(path, clock=SystemClock()) as catalog:
        fill(catalog, "mug", views)


def test_catalog_is_checked(bench):
    assert "none yet" in bench.findings("catalog")[0].text
    path = bench.context.catalog_path
    enroll(path, 6)
    (finding,) = bench.findings("catalog")
    assert finding.level is Severity.FINE
    assert "1 objects, 6 views" in finding.text
    image = next((path / "images").rglob("*.png"))
    image.write_bytes(b"no image")
    text, fix = one(bench.problems("catalog"))
    assert "1 of 6 verified images" in text
    assert fix == "rig catalog verify --repair --bench sim"
    image.unlink()
    (path / "catalog.sqlite").write_bytes(b"SQLite format 3\0" + b"rubbish" * 999)
    (finding,) = bench.findings("catalog")
    assert finding.level is Severity.BAD
    assert finding.exit_code == 7


def test_catalog_with_orphaned_rows_is_damaged(bench):
    path = bench.context.catalog_path
    enroll(path, 4)
    with sqlite3.connect(path / "catalog.sqlite") as connection:
        connection.execute("PRAGMA foreign_keys = off")
        connection.execute("DELETE FROM sessions")
    connection.close()
    assert any("damaged" in text for text in bench.problems("catalog"))


def result(bench, days_ago: float, valid_days: float | None = None, **device: object) -> CalibrationResult:
    return CalibrationResult(
        name="imu.scale",
        estimates={"scale": Estimate(1.01, 0.001, "")},
        residual=0.1,
        limit=0.2,
        residual_unit="°",
        refusals=(),
        when_utc=bench.context.computer.clock.utc() - timedelta(days=days_ago),
        device=device,
        evidence={},
        valid_days=valid_days,
    )


def test_missing_expired_and_other_device_calibrations_are_warnings(bench):
    set_up(bench)
    store = CalibrationStore(bench.context.config.calibration_path("sim"))
    assert "never calibrated" in one(bench.problems("calibration"))[0]
    store.add(result(bench, 100, valid_days=30))
    text, fix = one(bench.problems("calibration"))
    assert "calibrated 100 days ago; it is valid for 30 days" in text
    assert fix == "rig calibrate imu --bench sim"
    store.add(result(bench, 1, imu={"who_am_i": 0x99}))
    bench.findings("servo", "imu")  # the devices are known only when they were met
    assert "calibrated 100 days ago" in one(bench.problems("calibration"))[0]
    for path in store.folder.glob("*.json"):
        path.unlink()
    store.add(result(bench, 1, imu={"who_am_i": 0x99}))
    assert "another device: imu.who_am_i was 153, is 104" in one(bench.problems("calibration"))[0]
    store.add(result(bench, 0.5, valid_days=30))
    assert not bench.problems("calibration")
    (store.folder / "20260430T000000.000000Z-imu.scale.json").write_text("{")
    assert "Cannot read the calibration" in one(bench.problems("calibration"))[0]


# -- the examination itself -------------------------------------------------------------------------------------------


def test_hanging_or_failing_check_stops_no_other():
    released = threading.Event()

    def hangs(context):
        yield fine("hangs", "begun")
        released.wait()
        yield fine("hangs", "never told")

    def refused(context):
        raise DeviceSilent("No answer.", next_step="Knock.")
        yield

    def pulled(context):
        yield fine("pulled", "begun")
        raise OSError(5, "Input/output error")

    def broken(context):
        yield from ()
        raise KeyError("oh")

    checks = [
        Check("hangs", hangs, deadline_s=0.05, if_it_hangs="Pull the plug"),
        Check("refused", refused),
        Check("pulled", pulled),
        Check("broken", broken),
        Check("well", lambda _: iter([fine("well", "well")])),
    ]
    with unopened() as bench:
        findings = list(run_checks(bench.context, checks))
    released.set()
    told = [(f.topic, f.level, f.fix, f.exit_code) for f in findings]
    assert told == [
        ("hangs", Severity.FINE, "", 0),
        ("hangs", Severity.BAD, "Pull the plug", 9),
        ("refused", Severity.BAD, "Knock.", 4),
        ("pulled", Severity.FINE, "", 0),
        ("pulled", Severity.BAD, "rig doctor --bench sim", 4),
        ("broken", Severity.BAD, "Report this with the output of `rig doctor --json`", 1),
        ("well", Severity.FINE, "", 0),
    ]
