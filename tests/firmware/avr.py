"""The rig head's binary in an emulated ATmega328P (libsimavr), in the place of the core that the simulator compiles.

`avr.c` has the interface of ``firmware/boards/host/board.h``, so the same tests run on the core and on the binary.
"""

import shutil
from pathlib import Path

from sim.head import build
from sim.head.board import SimHead
from sim.world import World

SOURCE = Path(__file__).with_name("avr.c")
HEADERS = (Path("/usr/include/simavr"), Path("/usr/local/include/simavr"))


def missing() -> str:
    """Return what an emulated head lacks, and how to install it; empty if nothing is missing."""
    if lacking := build.missing():
        return lacking
    if not shutil.which("avr-gcc"):
        return "the AVR compiler is not installed: apt-get install gcc-avr avr-libc"
    if not any(path.is_dir() for path in HEADERS):
        return "the AVR emulator is not installed: apt-get install simavr libsimavr-dev"
    return ""


def folder() -> Path:
    """Return the folder with what `make` has built for an ATmega328P: ``head.elf`` and ``head.bin``."""
    return build.made("head.bin").parent


def image() -> bytes:
    """Return the flash of an ATmega328P: the bytes that `make flash` writes."""
    return (folder() / "head.bin").read_bytes()


def emulated_head(world: World, *, clock_error: float = 0.0, serial: int = 1, flash: bytes | None = None) -> SimHead:
    """Return a head whose microcontroller runs ``flash``, or the built binary."""
    program = image() if flash is None else flash
    return SimHead(world, clock_error=clock_error, serial=serial, library=_library(), flash=program)


def _library() -> Path:
    headers = next(path for path in HEADERS if path.is_dir())
    host, core = build.FIRMWARE / "boards" / "host", build.FIRMWARE / "core"

    def compile_to(folder: Path) -> list[str]:
        warnings = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-O2", "-fPIC", "-shared"]
        places = ["-isystem", str(headers), "-I", str(host), "-I", str(core)]
        out = str(folder / "libavrhead.so")
        return [build.compiler(), *warnings, *places, "-o", out, str(SOURCE), "-lsimavr"]

    return build.compiled([SOURCE, host / "board.h"], "", "libavrhead.so", compile_to)
