"""Findings about the computer: ports, permissions, other programs, the bench's state, disk and clock."""

import os
from contextlib import contextmanager
from datetime import UTC, datetime

import pytest

from rig.bench.computer import Disk, SerialPort, User
from rig.bench.hardware import HardwareBench
from rig.core.clock import SystemClock
from rig.core.errors import BenchBusy, DeviceSilent
from rig.core.next_steps import Do
from rig.doctor.computer import RULES_FILES, udev_rules
from rig.doctor.finding import Severity
from rig.doctor.servo_scan import single_servo
from rig.safety.saved_state import BenchLock, FileStore, LatchedFault, holder
from rig.safety.saved_state import BenchState as State
from sim.clock import VirtualClock
from tests.rig.doctor.doctor_parts import unopened

GID = os.getgid()
ADA = User("ada", 4242, frozenset({GID + 1}))


def test_latency_timer_is_fixed_by_one_command():
    with unopened(plugged=False) as bench:
        bench.computer.serial_port(latency_ms=16)
        bench.computer.i2c_bus()
        bench.computer.camera()
        problem = bench.problem("port")
        assert (problem.code, problem.evidence["latency_ms"]) == ("high_latency", 16)
        assert problem.fix.startswith("rig doctor --udev --bench sim | sudo tee ")


@pytest.mark.parametrize(
    ("members", "code", "command"),
    [
        ((), "not_in_group", "sudo usermod -aG dialout ada"),
        (("ada",), "group_at_next_login", "newgrp dialout"),
    ],
)
def test_missing_permission_names_the_group_or_the_new_login(members, code, command):
    with unopened(plugged=False, user=ADA) as bench:
        bench.computer.group("dialout", GID, *members)
        bench.computer.serial_port(mode=0o660)
        bench.computer.i2c_bus(mode=0o666)
        bench.computer.camera(mode=0o666)
        problem = bench.problem("port")
        assert (problem.code, problem.fix) == (code, command)
        assert (problem.evidence["user"], problem.evidence["path"]) == ("ada", "/dev/ttyUSB0")


def test_port_of_root_is_fixed_by_udev_rules():
    with unopened(plugged=False, user=ADA) as bench:
        bench.computer.group("root", GID)
        bench.computer.serial_port(mode=0o600, serial="FT3M9M97")
        bench.computer.i2c_bus(mode=0o666)
        bench.computer.camera(mode=0o666)
        problem = bench.problem("port")
        assert problem.code == "root_only"
        assert problem.fix.startswith("rig doctor --udev --bench sim | sudo tee /etc/udev/rules.d/")
        rules = udev_rules(bench.context.computer.serial_ports())
        assert 'ATTR{latency_timer}="1"' in rules
        assert 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014", ATTRS{serial}=="FT3M9M97"' in rules
        assert 'SYMLINK+="rig-servo"' in rules
        assert rules.count("rig-servo") == 1
        assert 'ENV{ID_MM_PORT_IGNORE}="1"' in rules
        assert 'ATTR{serial}=="FT3M9M97", ENV{ID_MM_DEVICE_IGNORE}="1", ENV{BRLTTY_BRAILLE_DRIVER}=""' in rules
        assert all(file in rules and file in problem.fix for file in RULES_FILES)


def test_udev_rules_of_an_adapter_without_a_serial_number_give_no_permanent_name():
    usb = {"idVendor": "1a86", "idProduct": "7523"}
    port = SerialPort("/dev/ttyUSB0", "CH340", None, "dialout", True, (), None, usb)
    rules = udev_rules([port])
    assert 'ATTR{idProduct}=="7523", ENV{ID_MM_DEVICE_IGNORE}="1"' in rules
    assert "rig-servo" not in rules


def test_missing_port_is_explained_by_brltty():
    with unopened(plugged=False) as bench:
        bench.computer.i2c_bus()
        bench.computer.camera()
        bench.computer.process(77, "/usr/bin/brltty -b hd")
        problem = bench.problem("port")
        assert (problem.code, problem.fix) == ("brltty_takes_port", "sudo apt remove brltty")


def test_port_that_modem_manager_will_open_is_reported(bench):
    """It runs as root, so a user does not see that it has the port open."""
    assert bench.problems("port") == {}
    bench.computer.process(78, "/usr/sbin/ModemManager")
    problem = bench.problem("port")
    assert problem.code == "modem_manager"
    assert "udevadm trigger" in problem.fix
    node = (bench.computer.root / "dev/ttyUSB0").stat().st_rdev
    bench.computer.write(f"run/udev/data/c{os.major(node)}:{os.minor(node)}", "S:rig-servo\nE:ID_MM_PORT_IGNORE=1\n")
    assert bench.problems("port") == {}


def test_bench_is_not_opened_while_another_program_has_the_port_open(bench):
    """The simulated computer opens the port: the other program has not locked it."""

    class Local(HardwareBench):
        @contextmanager
        def computer(self, config, options, seed):
            yield bench.context.computer

    bench.computer.process(77, "minicom -D /dev/ttyUSB0", "/dev/ttyUSB0")
    for opening in (
        lambda: Local().open(bench.context.config, None, None),
        lambda: single_servo(bench.context).__enter__(),
    ):
        with pytest.raises(BenchBusy, match=r"process 77 \(minicom") as caught:
            opening()
        assert "kill 77" in caught.value.next_step
    assert not bench.sent


@pytest.mark.parametrize(
    ("command", "fix"),
    [
        ("dynamixel_wizard", "kill 77"),
        ("/usr/sbin/ModemManager", "sudo systemctl disable --now ModemManager"),
        ("/usr/bin/brltty -b hd", "sudo apt remove brltty"),
    ],
)
def test_port_in_use_names_the_process(command, fix, bench):
    bench.computer.process(77, command, "/dev/ttyUSB0")
    problem = bench.problem("port")
    assert (problem.code, problem.fix) == ("device_file_in_use", fix)
    assert f"in use by process 77 ({command})" in problem.words


def test_set_up_is_proposed_if_other_devices_are_connected():
    with unopened(plugged=False) as bench:
        missing = [f for f in bench.findings("port") if f.code == "not_connected"]
        assert [f.evidence["found"] for f in missing] == [[]] * 3
        assert [f.fix for f in missing] == ["Plug the adapter in", "sudo modprobe i2c-dev", "Connect the camera"]
        bench.computer.serial_port("ttyUSB3", serial="FT7")
        bench.computer.i2c_bus(4)
        bench.computer.camera(2, "Cam")
        missing = [f for f in bench.findings("port") if f.code == "not_connected"]
        assert [f.evidence["kind"] for f in missing] == ["serial port", "I2C bus", "camera"]
        assert [f.steps for f in missing] == [(Do.SETUP(),)] * 3


def test_bench_in_use_is_not_touched(bench):
    path = bench.context.config.state_path("sim")
    lock = BenchLock(path, SystemClock())
    bench.context.holder = holder(path)
    findings = bench.findings()
    lock.close()
    warnings = {f.topic: f for f in findings if f.level is Severity.WARNING}
    assert warnings["bench"].code == "bench_in_use"
    assert warnings["bench"].evidence["pid"] == os.getpid()
    assert {warnings[topic].code for topic in ("servo", "imu", "camera")} == {"not_checked"}
    assert warnings["servo"].fix == "Stop the table and switch its torque off: `rig stop --bench sim`."
    assert not bench.sent


def test_latched_fault_and_damaged_state_are_reported(bench):
    store = FileStore(bench.context.config.state_path("sim"))
    utc = "2026-05-01T10:00:00+00:00"
    store.save(State(fault=LatchedFault.of(DeviceSilent("Servo 1 is gone.", next_step="Look."), utc)))
    problem = bench.problem("bench")
    assert (problem.code, problem.evidence["code"]) == ("fault_latched", 402)
    assert problem.evidence["detail"] == "Servo 1 is gone."
    assert problem.steps == (Do.ACKNOWLEDGE(),)
    store.latch(None)
    (store.path / "state.json").write_text("{")
    problem = bench.problem("bench")
    assert problem.code == "state_damaged"
    assert problem.steps[1:4:2] == (Do.ACKNOWLEDGE(), Do.SET_REVOLUTIONS(revolutions=0))


@pytest.mark.parametrize(("free", "level"), [(50e9, Severity.FINE), (1e9, Severity.WARNING), (1e8, Severity.BAD)])
def test_free_space_is_reported_in_objects(monkeypatch, free, level, bench):
    monkeypatch.setattr(type(bench.context.computer), "disk", lambda *_: Disk(int(free), network=False))
    (finding,) = bench.findings("disk")
    assert (finding.code, finding.level) == ("free_space", level)
    assert finding.evidence["objects"] == int(free / 500_000) // 72


@pytest.mark.parametrize(
    ("disk", "code", "fixed_by"),
    [
        (Disk(10**11, network=True), "network_disk", ""),
        (Disk(10**11, network=False, writable=False), "not_writable", "rig config set catalog.path FOLDER"),
    ],
)
def test_network_disk_and_read_only_folder_are_reported(monkeypatch, disk, code, fixed_by, bench):
    monkeypatch.setattr(type(bench.context.computer), "disk", lambda *_: disk)
    problem = bench.problem("disk")
    assert problem.code == code
    assert fixed_by in problem.fix


def test_unsynchronised_clock_is_a_warning_and_wrong_date_is_bad():
    with unopened(plugged=False) as bench:
        assert bench.problem("clock").code == "not_synchronized"
        bench.computer.keeps_time(synchronised=False)
        problem = bench.problem("clock")
        assert problem.code == "not_synchronized"
        assert problem.fix == "sudo timedatectl set-ntp true"
        bench.computer.keeps_time()
        assert not bench.problems("clock")
        bench.context.computer.clock = VirtualClock(start_utc=datetime(1970, 1, 1, tzinfo=UTC))
        (wrong,) = [f for f in bench.findings("clock") if f.level is Severity.BAD]
        assert wrong.code == "wrong_date"
