"""The devices of a computer, found in the files of Linux."""

import os

import pytest

from rig.bench.computer import Computer, Process, User
from rig.core.errors import BenchBusy
from sim.computer import ComputerFiles

GID = os.getgid()


@pytest.fixture
def computer(tmp_path):
    return ComputerFiles(tmp_path)


def host(computer: ComputerFiles, *gids: int, uid: int = 4242) -> Computer:
    return Computer(computer.root, user=User("ada", uid, frozenset(gids)))


def test_serial_port_has_adapter_stable_name_and_latency(computer):
    computer.serial_port("ttyUSB10", serial="FT1", latency_ms=16)
    computer.serial_port("ttyUSB9", serial="FT2", latency_ms=None)
    first, second = host(computer).serial_ports()
    assert (first.path, second.path) == ("/dev/ttyUSB9", "/dev/ttyUSB10")  # in numeric order
    assert (first.latency_ms, second.latency_ms) == (None, 16)
    assert second.name == "FTDI USB <-> Serial Converter"
    assert second.usb["serial"] == "FT1"
    assert second.stable == "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT1-if00-port0"
    assert host(computer).same_file(second.stable, second.path)
    assert not host(computer).same_file(second.stable, first.path)


def test_terminals_and_unused_ports_are_not_listed(computer):
    computer.write("sys/class/tty/tty1/dev", "4:1")
    computer.write("sys/class/tty/ttyUSB0/dev", "188:0")  # no device: it was pulled out just now
    reserved = computer.root / "sys/devices/platform/serial8250/ttyS3"
    reserved.mkdir(parents=True)
    computer.link("sys/class/tty/ttyS3/device", reserved)
    soldered = computer.root / "sys/devices/soc/uart0"
    soldered.mkdir(parents=True)
    computer.link("sys/class/tty/ttyAMA0/device", soldered)
    computer.write("dev/ttyAMA0")
    (port,) = host(computer).serial_ports()
    assert (port.path, port.usb) == ("/dev/ttyAMA0", {})
    computer.serial_port()
    assert [port.path for port in host(computer).serial_ports()] == ["/dev/ttyUSB0", "/dev/ttyAMA0"]  # on USB first


def test_port_without_adapter_can_be_named(computer):
    computer.write("dev/pts/3")
    named = host(computer, uid=0).serial_port("/dev/pts/3")
    assert (named.path, named.usb, named.usable) == ("/dev/pts/3", {}, True)
    assert host(computer).serial_port("/dev/pts/4") is None
    computer.serial_port()
    stable = "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_SIM00001-if00-port0"
    assert host(computer).serial_port(stable).path == "/dev/ttyUSB0"


@pytest.mark.parametrize(
    ("mode", "gids", "uid", "usable"),
    [
        (0o660, (GID,), 4242, True),
        (0o660, (), 4242, False),
        (0o640, (GID,), 4242, False),  # may read, not write
        (0o606, (), 4242, True),
        (0o606, (GID,), 4242, False),  # the group's bits count for its members
        (0o600, (), os.getuid(), True),
        (0o000, (), 0, True),
    ],
)
def test_permissions_follow_the_file_and_the_user(computer, mode, gids, uid, usable):
    computer.group("dialout", GID, "ada")
    computer.serial_port(mode=mode)
    (port,) = host(computer, *gids, uid=uid).serial_ports()
    assert port.usable is usable
    assert port.group == "dialout"


def test_new_group_membership_is_found(computer):
    computer.group("dialout", GID, "eve", "ada")
    computer.group("i2c", GID + 1)
    outside = host(computer)
    assert outside.joined("dialout")
    assert not outside.joined("i2c")
    assert host(computer, GID + 1).joined("i2c")
    assert not outside.joined("video")


def test_program_that_uses_a_port_is_found_by_either_name(computer):
    computer.serial_port()
    (port,) = host(computer).serial_ports()
    computer.process(312, "dynamixel_wizard --fast", port.stable)
    computer.process(313, "cat", "/dev/null")
    (computer.root / "proc" / "self").mkdir()
    (port,) = host(computer).serial_ports()
    assert port.holders == (Process(312, "dynamixel_wizard --fast"),)


def test_port_in_use_is_rejected_except_by_a_guardian(computer):
    """The guardian of a killed program uses the port for a moment; opening the port waits for it."""
    computer.serial_port()
    computer.process(314, "python -P -m rig.devices.dynamixel.guardian /dev/ttyUSB0", "/dev/ttyUSB0")
    host(computer).require_unused("/dev/ttyUSB0")
    computer.process(312, "minicom", "/dev/ttyUSB0")
    with pytest.raises(BenchBusy) as busy:
        host(computer).require_unused("/dev/ttyUSB0")
    assert busy.value.evidence["pids"] == [312]


def test_camera_is_the_device_file_with_images(computer):
    computer.camera(0, "HD Webcam", index=0)
    computer.camera(1, "HD Webcam", index=1)
    (camera,) = host(computer).cameras()
    assert (camera.path, camera.name) == ("/dev/video0", "HD Webcam")
    assert camera.stable == "/dev/v4l/by-id/usb-HD_Webcam-video-index0"


def test_camera_is_identified_wherever_it_is_connected(computer):
    computer.camera(0, "Cam", serial="A1", usb_port="1-1")
    computer.camera(2, "Cam two", serial="B2", usb_port="1-2")
    computer.camera(4, "Cam three", usb_port="1-3")
    devices = [host(computer).camera_device(source) for source in (0, 2, 4)]
    assert devices == [
        "USB 046d:0825, serial number A1",
        "USB 046d:0825, serial number B2",
        "USB 046d:0825 at usb-1-3-video-index0",  # without a serial number, its place counts
    ]
    assert host(computer).camera_device("/dev/v4l/by-id/usb-Cam-video-index0") == devices[0]
    assert host(computer).camera_device("/dev/video2") == host(computer).camera_device("2") == devices[1]
    assert host(computer).camera_device("film.mp4") is None


def test_computer_without_devices_lists_nothing(tmp_path):
    bare = host(ComputerFiles(tmp_path))
    assert (bare.serial_ports(), bare.i2c_buses(), bare.cameras()) == ([], [], [])
    assert bare.time_synchronised() is None


def test_time_service_reports_synchronisation(computer):
    computer.keeps_time(synchronised=False)
    assert host(computer).time_synchronised() is False
    computer.keeps_time()
    assert host(computer).time_synchronised() is True


def test_network_disk_is_detected(computer, tmp_path):
    computer.write("proc/mounts", f"/dev/sda1 / ext4 rw 0 0\nnas:/x {tmp_path}/with\\040space nfs4 rw 0 0\n")
    (tmp_path / "with space").mkdir()
    assert host(computer).disk(tmp_path / "with space" / "not" / "yet").network
    assert not host(computer).disk(tmp_path / "other").network
    assert host(computer).disk(tmp_path).free_bytes > 0


def test_this_computer_can_be_examined():
    here = Computer()
    for node in [*here.serial_ports(), *here.i2c_buses(), *here.cameras()]:
        assert node.path.startswith("/dev/")
    assert here.user.gids
