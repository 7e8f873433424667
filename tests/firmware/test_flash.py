"""`make flash` with the real avrdude, against the boot loaders of both kinds of Nano on a pseudo-terminal."""

import json
import shutil
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import pytest

from sim.head import build
from sim.realtime.pace import RealTime
from sim.realtime.port import PtyPort
from sim.world import World
from tests.firmware import avr
from tests.firmware.bootloader import ATMEGABOOT, OPTIBOOT, PAGE_BYTES, Arduino, Kind

SPEEDS = {getattr(termios, f"B{baud}"): baud for baud in (57_600, 115_200)} | {termios.B38400: 0}
"""Baud rates by their number in the settings of a terminal, which has 38,400 baud before a program opens it."""
OTHER = 1


@contextmanager
def connected(kind: Kind) -> Iterator[tuple[Arduino, str, RealTime]]:
    """Connect a board to a pseudo-terminal; yield it, the port and its time."""
    if shutil.which("avrdude") is None:
        pytest.skip("avrdude is not installed (apt-get install avrdude)")
    if lacking := avr.missing():
        pytest.skip(lacking)
    world = World()
    ports: list[PtyPort] = []
    board = Arduino(world, kind, lambda: SPEEDS.get(termios.tcgetattr(ports[0].near)[4], OTHER) if ports else 0)
    ports.append(PtyPort(lambda: board))
    time = RealTime(world.clock, ports)
    thread = Thread(target=time.run)
    thread.start()
    try:
        yield board, ports[0].path, time
    finally:
        time.over = True
        thread.join()
        ports[0].close()


def make(folder: Path, port: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run `make flash` with what is built already."""
    built = avr.folder()
    folder.mkdir()
    for name in ("head.elf", "head.bin"):
        shutil.copyfile(built / name, folder / name)
    command = ["make", "-s", "-C", str(build.FIRMWARE), "flash", f"PORT={port}", f"OUT={folder}", *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def check_flash(board: Arduino) -> bytes:
    image = avr.image()
    assert board.flash[: len(image)] == image
    assert set(board.flash[len(image) :]) == {0xFF}
    assert set(board.eeprom) == {0xFF}
    return image


def test_flash_holds_the_program_and_a_serial_number_by_the_boot_loader_would_overwrite_it(tmp_path: Path) -> None:
    with connected(OPTIBOOT) as (board, port, time):
        done = make(tmp_path / "out", port)
        assert done.returncode == 0, done.stderr
        image = check_flash(board)
        with time.present():
            pass  # the board sees that the port was closed
        number = ["-U", "eeprom:w:17,0,0,0:m"]
        command = ["avrdude", "-p", "m328p", "-c", "arduino", "-b", "115200", "-P", port, "-V", *number]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert set(board.eeprom) == {0xFF}
        assert board.flash[:4] == bytes((17, 0, 0, 0))  # the reset vector is gone
        assert board.flash[PAGE_BYTES : len(image)] == image[PAGE_BYTES:]


@pytest.mark.nightly
@pytest.mark.parametrize("kind", [OPTIBOOT, ATMEGABOOT], ids=lambda kind: kind.name)
def test_serial_number_is_stored_by_the_program_that_was_flashed(kind: Kind, tmp_path: Path) -> None:
    rig = str(Path(sys.executable).with_name("rig"))
    with connected(kind) as (board, port, _):
        done = make(tmp_path / "out", port, "SERIAL=17", f"RIG={rig}")
        assert done.returncode == 0, done.stderr
        check_flash(board)
        assert "serial number 17" in done.stdout
        words = ["head", "info", "--json", "--set", "imu.connection=head", "--set", f"head.port={port}"]
        shown = subprocess.run([rig, *words], capture_output=True, text=True, check=True)
        assert json.loads(shown.stdout)["serial"] == 17
