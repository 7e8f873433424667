"""Builds the firmware for simulation into the user's cache, once for each version of its sources."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import platformdirs

from rig.config.values import APP
from rig.core.errors import ConfigError

HERE = Path(__file__).resolve().parent
FIRMWARE = HERE.parent.parent / "firmware"
EMULATOR_HEADERS = (Path("/usr/include/simavr"), Path("/usr/local/include/simavr"))

COMPILE_S = 120  # a slow computer compiles for seconds; only a compiler that hangs takes longer


def missing(kind: str) -> str:
    """Return what a build of a ``memory`` or ``avr`` head lacks, and how to install it; empty if nothing is missing."""
    if not (FIRMWARE / "Makefile").is_file():
        return "the firmware's sources are not installed: use a clone of the repository"
    if not (shutil.which("make") and compiler()):
        return "a C compiler and make are not installed: apt-get install gcc make"
    if kind == "avr":
        if not shutil.which("avr-gcc"):
            return "the AVR compiler is not installed: apt-get install gcc-avr avr-libc"
        if not any(path.is_dir() for path in EMULATOR_HEADERS):
            return "the AVR emulator is not installed: apt-get install simavr libsimavr-dev"
    return ""


def host_library(flags: str = "") -> Path:
    """Return the portable core as a shared library (``boards/host``), compiled with further ``flags``."""
    return _built("memory", "libhead.so", flags)


def pty_program() -> Path:
    """Return the program that simulates a head on a pseudo-terminal."""
    return _built("memory", "head-pty")


def avr_image() -> bytes:
    """Return the flash of an ATmega328P: the bytes that `make flash` writes."""
    return (avr_folder() / "head.bin").read_bytes()


def avr_folder() -> Path:
    """Return the folder with what `make` has built for an ATmega328P: ``head.elf`` and ``head.bin``."""
    return _built("avr", "head.bin").parent


def avr_library() -> Path:
    """Return the emulated microcontroller, with the interface of ``boards/host/board.h``."""
    _require("avr")
    source = HERE / "avr.c"
    key = _key([source, FIRMWARE / "boards" / "host" / "board.h"], "")
    headers = next(path for path in EMULATOR_HEADERS if path.is_dir())

    def compile_to(folder: Path) -> list[str]:
        out = folder / "libavrhead.so"
        warnings = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-O2", "-fPIC", "-shared"]
        places = ["-isystem", str(headers), "-I", str(FIRMWARE / "boards" / "host"), "-I", str(FIRMWARE / "core")]
        return [compiler(), *warnings, *places, "-o", str(out), str(source), "-lsimavr"]

    return _cached(key, "libavrhead.so", compile_to)


def _built(kind: str, product: str, flags: str = "") -> Path:
    _require(kind)
    sources = [p for p in sorted(FIRMWARE.rglob("*")) if p.suffix in (".c", ".h") or p.name == "Makefile"]

    def make(folder: Path) -> list[str]:
        return ["make", "-s", "-C", str(FIRMWARE), f"OUT={folder}", f"HOST_FLAGS={flags}", str(folder / product)]

    return _cached(_key(sources, f"{product} {flags}"), product, make)


def _require(kind: str) -> None:
    if lacking := missing(kind):
        raise ConfigError(
            f"The simulated rig head cannot be built: {lacking.partition(':')[0]}.",
            next_step=f"{lacking.partition(': ')[2][:1].upper()}{lacking.partition(': ')[2][1:]}; or leave the head "
            "out: imu.connection=i2c.",
        )


def compiler() -> str:
    """Return the C compiler of this computer; empty if it has none."""
    return os.environ.get("CC") or next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), "")


def _key(sources: list[Path], how: str) -> str:
    digest = sha256(f"{compiler()} {how}".encode())
    for source in sources:
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]


def _cached(key: str, product: str, command_for: Callable[[Path], list[str]]) -> Path:
    """Return a product from the cache, built first if needed; several programs may do so at the same time."""
    root = Path(platformdirs.user_cache_dir(APP)) / "head"
    done = root / key / product
    if done.is_file():
        return done
    root.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=root))
    try:
        run = subprocess.run(command_for(folder), capture_output=True, text=True, timeout=COMPILE_S, check=False)
        if run.returncode:
            raise ConfigError(
                "The firmware does not compile.",
                next_step="Correct the error below, or restore the sources.",
                evidence={"compiler": (run.stderr or run.stdout)[-2000:]},
            )
        try:
            folder.rename(root / key)
        except OSError:  # another program was faster
            shutil.rmtree(folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return done
