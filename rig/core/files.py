"""Reads files of limited size, and writes files that survive a power cut: completely or not at all."""

import json
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Final

MAX_SINGLE_SYNCS: Final = 100
"""Up to this number, files are synchronised one by one, without waiting for other programs' data."""


def read(path: Path, *, max_bytes: int) -> bytes:
    """Return the content of a regular file; a pipe or a device is never waited for.

    Raises `OSError`: the file is missing, cannot be read, is not a regular file, or is larger than ``max_bytes``.
    """
    with open_regular(path) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(None, f"it is larger than {max_bytes} bytes", str(path))
    return content


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; a pipe or a device is never waited for. Raises as `read`."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    file = open(descriptor, "rb")  # noqa: PTH123, SIM115 - a path cannot be opened without waiting for a pipe
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        file.close()
        raise OSError(None, "it is a folder" if stat.S_ISDIR(mode) else "it is not a regular file", str(path))
    return file


def json_values(content: bytes | str) -> Any:
    """Return the values of a JSON document.

    Raises `ValueError`: it is not JSON, is nested too deeply, or has a number that is not finite.
    """
    try:
        return json.loads(content, parse_constant=_reject_constant)
    except RecursionError as error:
        raise ValueError("the JSON is nested too deeply") from error


def _reject_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number in JSON")


def write(path: Path, content: bytes, *, mode: int = 0o666, part: str = ".part", settled: bool = True) -> None:
    """Write a file completely or not at all; on return it is on the disk if it is ``settled``.

    The umask limits its ``mode``. Until it is complete, its name ends in ``part``.
    """
    temporary = path.with_name(f"{path.name}{part}")
    try:
        with open_new(temporary, mode=mode) as file:
            file.write(content)
            file.flush()
            if settled:
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if settled:
        sync_folder(path.parent)


def open_new(path: Path, *, mode: int = 0o666) -> BinaryIO:
    """Open a file of the program's own for writing, empty.

    If something else has its name, such as a link, a second name of a file, or a pipe, it is removed first.
    """
    with suppress(FileNotFoundError):
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
            path.unlink()
    return open(path, "wb", opener=partial(no_follow, mode=mode))


def no_follow(path: str, flags: int, *, mode: int = 0o666) -> int:
    """Open a file without following links: an ``opener`` for `open`."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, mode)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    sync_file(path)


def sync_file(path: Path) -> None:
    """Wait until a file's content is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Wait until everything in a folder is on the disk."""
    sync([folder, *folder.rglob("*")])


def sync(paths: Sequence[Path]) -> None:
    """Wait until several files and folders are on the disk."""
    if len(paths) > MAX_SINGLE_SYNCS:
        os.sync()  # one by one, thousands of small files take minutes on some disks
        return
    for path in paths:
        sync_file(path)


def make_folder(path: Path, *, within: Path, mode: int = 0o777) -> None:
    """Create ``path`` and the folders between it and ``within``, and return when their names are on the disk."""
    for folder in reversed([path, *path.parents]):
        if folder.is_relative_to(within):
            folder.mkdir(mode=mode, exist_ok=True)
    for above in path.parents:
        sync_folder(above)
        if above == within:
            return
