"""Where an import keeps its files until all of it is in the catalog: a folder of its own on the catalog's disk."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import Final

INCOMING: Final = "incoming"


@contextmanager
def staging(root: Path) -> Iterator[Path]:
    """Have a new folder that goes with everything in it, however the import ends; a killed one's is `abandoned`."""
    above = root / INCOMING
    above.mkdir(exist_ok=True)
    folder = Path(mkdtemp(dir=above))
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the system lets go of it with the process
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)
        with suppress(OSError):  # another import is under way
            above.rmdir()


def abandoned(root: Path) -> Iterator[Path]:
    """Yield the folders of imports whose process is gone."""
    above = root / INCOMING
    for folder in sorted(above.iterdir()) if above.is_dir() else ():
        lock = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        finally:
            os.close(lock)
        yield folder
