"""The serial number of a rig head: stored by its own protocol after flashing, never by the boot loader."""

import json
import subprocess

import pytest

from rig.core.errors import DeviceFault, DeviceNotFound, RequestRejected
from rig.devices.head.link import HeadLink
from rig.devices.head.protocol import SERIAL_UNSET, Done, Reset, Shutdown
from sim.head import build
from sim.head.board import SimHead
from sim.head.serial_port import HeadSerial
from sim.world import World
from tests.contract.heads import head_of, needs


def greeted(head: SimHead) -> HeadLink:
    link = HeadLink(HeadSerial(head), head.clock, lambda _: None, "head")
    link.greet()
    return link


def stored(head: SimHead, serial: int) -> int:
    """Store a serial number; return the one that the head reports then."""
    link = greeted(head)
    link.store_serial(serial)
    return link.identity.serial


@pytest.fixture(params=["memory", "avr"])
def head(request):
    head = head_of(request.param, World(), serial=SERIAL_UNSET)
    yield head
    head.close()


def test_number_is_stored_read_back_and_kept_over_a_reset(head):
    """On the AVR binary this is the sequence after flashing: the program runs, then stores its number."""
    assert greeted(head).identity.serial == SERIAL_UNSET
    assert stored(head, 17) == 17
    head.reset(Reset.EXTERNAL)
    head.clock.sleep(0.5)
    assert greeted(head).identity.serial == 17  # and the first page of the flash still runs
    assert stored(head, 2**32 - 2) == 2**32 - 2


def test_number_is_not_stored_while_a_program_uses_the_head(head):
    stored(head, 5)
    user = greeted(head)
    user.heartbeat(2000)
    with pytest.raises(RequestRejected):
        stored(head, 6)
    user.request(Shutdown(), Done)
    assert greeted(head).identity.serial == 5


def test_worn_out_memory_and_missing_head_are_reported(monkeypatch):
    needs("memory")
    head = SimHead(World(), serial=9)
    monkeypatch.setattr("rig.devices.head.link.SetSerial", lambda _: Shutdown())
    with pytest.raises(DeviceFault, match="did not store"):
        stored(head, 17)
    head.filters.append(lambda _to_head, _byte: None)
    with pytest.raises(DeviceNotFound):
        greeted(head)
    head.close()


def test_command_shows_and_stores_the_number(rig):
    needs("memory")
    on_head = ("--set", "imu.connection=head", "--json")
    assert json.loads(rig("head", "info", *on_head).stdout)["serial"] == 1
    done = json.loads(rig("head", "set-serial", "17", *on_head).stdout)
    assert (done["serial"], done["board"], done["firmware"]) == (17, "host", "1.1.0")
    assert rig("head", "set-serial", str(2**32 - 1), *on_head).exit_code == 2


@pytest.mark.parametrize(
    ("answers", "options", "bauds", "code"),
    [
        ("115200", ("SERIAL=17",), ["115200"], 0),
        ("57600", ("SERIAL=17",), ["115200", "57600"], 0),
        ("none", ("SERIAL=17",), ["115200", "57600"], 2),
        ("115200", (), ["115200"], 0),
        ("usbasp", ("PROGRAMMER=-c usbasp", "SERIAL=17"), ["usbasp"], 0),
    ],
)
def test_flash_tries_both_boot_loaders_and_writes_no_eeprom(tmp_path, answers, options, bauds, code):
    log = tmp_path / "log"
    for name, script in {
        "avrdude": f'echo "avrdude $@" >> {log}; case "$*" in *{answers}*) exit 0;; esac; exit 1',
        "rig": f'echo "rig $@" >> {log}',
    }.items():
        tool = tmp_path / name
        tool.write_text(f"#!/bin/sh\n{script}\n")
        tool.chmod(0o755)
    command = ["make", "-s", "-C", str(build.FIRMWARE), "flash", "PORT=/dev/ttyUSB9", f"OUT={tmp_path}/out", *options]
    (tmp_path / "out").mkdir()
    for product in ("head.elf", "head.hex", "head.bin"):  # nothing to compile
        (tmp_path / "out" / product).touch()
    done = subprocess.run(
        command, env={"PATH": f"{tmp_path}:/usr/bin:/bin"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    calls = log.read_text().splitlines()
    flashed = [call for call in calls if call.startswith("avrdude")]
    assert len(flashed) == len(bauds)
    assert all(baud in call for baud, call in zip(bauds, flashed, strict=True))
    assert not any("eeprom" in call for call in flashed)
    stored = ["rig head set-serial 17 --set imu.connection=head --set head.port=/dev/ttyUSB9"]
    assert calls[len(bauds) :] == (stored if "SERIAL=17" in options and not code else [])
