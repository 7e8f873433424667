"""Files that survive a power cut: written whole or not at all, under a name that is known to the disk."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

FEW: Final = 100
"""So many files are waited for one by one: the rest of the computer's traffic is none of theirs."""


def write(path: Path, content: bytes) -> None:
    """Write a file so that under its name there is all of it or nothing, and all of it once this returns."""
    temporary = path.with_name(f"{path.name}.part")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Return when the names in a folder are on the disk."""
    sync_file(path)


def sync_file(path: Path) -> None:
    """Return when what was written to a file is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Return when everything in a folder is on the disk."""
    paths = [folder, *folder.rglob("*")]
    if len(paths) > FEW:
        os.sync()  # of thousands of small files all at once; one by one takes minutes on some disks
        return
    for path in paths:
        sync_file(path)


def make_folder(path: Path, *, within: Path) -> None:
    """Create ``path`` and the folders between it and ``within``, each durably known to the one above it."""
    path.mkdir(parents=True, exist_ok=True)
    for above in path.parents:
        sync_folder(above)
        if above == within:
            return
