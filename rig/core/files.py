"""Writes files that survive a power cut: completely or not at all, with their name in the folder."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

MAX_SINGLE_SYNCS: Final = 100
"""Up to this number, files are synchronised one by one, without waiting for other programs' data."""


def write(path: Path, content: bytes) -> None:
    """Write a file completely or not at all; on return it is on the disk."""
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
    """Return when a file's content is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Return when everything in a folder is on the disk."""
    paths = [folder, *folder.rglob("*")]
    if len(paths) > MAX_SINGLE_SYNCS:
        os.sync()  # one by one, thousands of small files take minutes on some disks
        return
    for path in paths:
        sync_file(path)


def make_folder(path: Path, *, within: Path) -> None:
    """Create ``path`` and the folders between it and ``within``, and return when their names are on the disk."""
    path.mkdir(parents=True, exist_ok=True)
    for above in path.parents:
        sync_folder(above)
        if above == within:
            return
