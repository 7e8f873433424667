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

COMPILE_S = 120  # a slow computer compiles for seconds; only a compiler that hangs takes longer


def missing() -> str:
    """Return what a build of a head lacks, and how to install it; empty if nothing is missing."""
    if not (FIRMWARE / "Makefile").is_file():
        return "the firmware's sources are not installed: use a clone of the repository"
    if not (shutil.which("make") and compiler()):
        return "a C compiler and make are not installed: apt-get install gcc make"
    return ""


def made(product: str = "libhead.so", flags: str = "") -> Path:
    """Return a product of the firmware's Makefile: by default the core for this computer, compiled with ``flags``.

    Raises `ConfigError` if this computer lacks a compiler, or the sources are wrong.
    """
    if lacking := missing():
        what, _, how = lacking.partition(": ")
        raise ConfigError(
            f"The simulated rig head cannot be built: {what}.",
            next_step=f"{how[:1].upper()}{how[1:]}; or leave the head out: imu.connection=i2c.",
        )
    sources = [p for p in sorted(FIRMWARE.rglob("*")) if p.suffix in (".c", ".h") or p.name == "Makefile"]

    def make(folder: Path) -> list[str]:
        return ["make", "-s", "-C", str(FIRMWARE), f"OUT={folder}", f"HOST_FLAGS={flags}", str(folder / product)]

    return compiled(sources, f"{product} {flags}", product, make)


def compiler() -> str:
    """Return the C compiler of this computer; empty if it has none."""
    return os.environ.get("CC") or next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), "")


def compiled(sources: list[Path], how: str, product: str, command_for: Callable[[Path], list[str]]) -> Path:
    """Return a product from the cache; if its ``sources``, the compiler or ``how`` changed, build it first.

    Several programs may do so at the same time. Raises `ConfigError` if the sources do not compile.
    """
    digest = sha256(f"{compiler()} {how}".encode())
    for source in sources:
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    key = digest.hexdigest()[:16]
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
