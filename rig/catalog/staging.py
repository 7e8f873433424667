"""Staging folders: an import stores its files there, on the disk of the catalog, until all are in the catalog."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp

from rig.catalog.places import INCOMING


@contextmanager
def staging(root: Path) -> Iterator[Path]:
    """Yield a new folder, and delete it with its contents at the end. After a kill, `abandoned` finds it."""
    parent = root / INCOMING
    parent.mkdir(mode=0o700, exist_ok=True)
    folder = Path(mkdtemp(dir=parent))
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the system releases it when the process ends
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)
        with suppress(OSError):  # another import is running
            parent.rmdir()


def abandoned(root: Path) -> Iterator[Path]:
    """Yield the folders of imports whose process no longer runs."""
    parent = root / INCOMING
    for folder in sorted(parent.iterdir()) if parent.is_dir() else ():
        if folder.is_symlink() or not folder.is_dir():
            continue
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        finally:
            os.close(lock)
        yield folder
