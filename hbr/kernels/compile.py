"""Compile the kernels, if there is a C compiler: ``python hbr/kernels/compile.py``. Only the standard library is used.

A library that was compiled from the present sources is not compiled again.

The build of the wheel calls it (`hatch_build.py`), and so does ``make``. Without a compiler NumPy does the work.
"""

import os
import shutil
import subprocess
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

FOLDER: Final = Path(__file__).resolve().parent
LIBRARY: Final = FOLDER / "_kernels.so"
#: No contraction of a product and a sum: the results have the same bits as those of NumPy.
FLAGS: Final = (
    "-std=gnu11 -O3 -fPIC -shared -s -fvisibility=hidden -ffp-contract=off -fno-math-errno -fno-trapping-math "
    "-Wall -Wextra"
)


def sources(folder: Path = FOLDER) -> list[Path]:
    """Return the C files of the kernels."""
    return sorted([*folder.glob("*.c"), *folder.glob("*.h")])


def sources_digest(folder: Path = FOLDER) -> str:
    """Return the SHA-256 of the C files and the compiler's options."""
    found = sha256(FLAGS.encode())
    for path in sources(folder):
        found.update(path.name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()


def compiler() -> list[str] | None:
    """Return the command of the C compiler, the one in ``CC`` first; None if there is none."""
    given = os.environ.get("CC", "").split()
    candidates = [given] if given else [["cc"], ["gcc"], ["clang"]]
    return next((words for words in candidates if shutil.which(words[0])), None)


def target(command: list[str]) -> str:
    """Return the machine that a compiler compiles for, such as x86_64-linux-gnu."""
    return subprocess.run([*command, "-dumpmachine"], capture_output=True, text=True, check=False).stdout.strip()


def compile_kernels(output: Path = LIBRARY) -> str | None:
    """Compile the library and return what machine it is for; None if there is no compiler, or it fails."""
    command = compiler()
    if command is None:
        return None
    parts = [path for path in sources() if path.suffix == ".c"]
    new = output.with_suffix(f".{os.getpid()}")
    compiling = [*command, *FLAGS.split(), f'-DHBR_SOURCES="{sources_digest()}"']
    try:
        with TemporaryDirectory() as folder:
            # Each file in a process of its own, so that all cores work.
            made = {str(path): str(Path(folder, f"{path.stem}.o")) for path in parts}
            running = [subprocess.Popen([*compiling, "-c", part, "-o", to]) for part, to in made.items()]
            if any([one.wait() for one in running]):  # noqa: C419 - all of them end before their folder goes
                return None
            if subprocess.run([*compiling, *made.values(), "-o", str(new)], check=False).returncode:
                return None
        new.replace(output)  # a running program continues with the old library
        return target(command)
    except OSError:
        return None
    finally:
        new.unlink(missing_ok=True)


def is_current(library: Path = LIBRARY) -> bool:
    """Return whether a library was compiled from the present sources beside it."""
    return library.exists() and sources_digest(library.parent).encode() in library.read_bytes()


if __name__ == "__main__" and not is_current():
    machine = compile_kernels()
    print("No C compiler works: NumPy does the work of the kernels." if machine is None else f"Compiled for {machine}.")
