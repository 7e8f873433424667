"""The serial number of a rig head: stored by its own protocol after flashing, never by the boot loader."""

import json
import subprocess

import pytest

from rig.core.errors import DeviceFault, DeviceNotFound, RequestRejected
from rig.devices.head.connection import HeadConnection
from rig.devices.head.protocol import SERIAL_UNSET, Done, Reset, Shutdown
from rig.devices.head.serial_number import read_identity, store_serial
from sim.head import build
from sim.head.board import SimHead
from sim.head.serial_port import HeadSerial
from sim.world import World
from tests.contract.heads import needs


@pytest.fixture(params=["memory", "avr"])
def head(request):
    needs(request.param)
    head = SimHead(World(), request.param, serial=SERIAL_UNSET)
    yield head
    head.close()


def test_number_is_stored_read_back_and_kept_over_a_reset(head):
    """On the AVR binary this is the sequence after flashing: the program runs, then stores its number."""
    clock = head.clock
    assert read_identity(HeadSerial(head), clock, name="head").serial == SERIAL_UNSET
    assert store_serial(HeadSerial(head), clock, 17, name="head").serial == 17
    head.reset(Reset.EXTERNAL)
    clock.sleep(0.5)
    assert (
        read_identity(HeadSerial(head), clock, name="head").serial == 17
    )  # and the first page of the flash still runs
    assert store_serial(HeadSerial(head), clock, 2**32 - 2, name="head").serial == 2**32 - 2


def test_number_is_not_stored_while_a_program_uses_the_head(head):
    clock = head.clock
    store_serial(HeadSerial(head), clock, 5, name="head")
    user = HeadConnection(HeadSerial(head), clock, lambda _: None, deadman_ms=2000, name="head", reopen=None)
    user.greet()
    user.heartbeat()
    with pytest.raises(RequestRejected):
        store_serial(HeadSerial(head), clock, 6, name="head")
    user.link.request(Shutdown(), Done)
    assert read_identity(HeadSerial(head), clock, name="head").serial == 5


def test_worn_out_memory_and_missing_head_are_reported(monkeypatch):
    needs("memory")
    head = SimHead(World(), "memory", serial=9)
    monkeypatch.setattr("rig.devices.head.serial_number.SetSerial", lambda _: Shutdown())
    with pytest.raises(DeviceFault, match="did not store"):
        store_serial(HeadSerial(head), head.clock, 17, name="head")
    head.filters.append(lambda _to_head, _byte: None)
    with pytest.raises(DeviceNotFound):
        read_identity(HeadSerial(head), head.clock, name="head")
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
