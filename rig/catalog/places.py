"""Places of files in the folder of a catalog. Nothing outside of it is read, written or removed.

A catalog may come from an untrusted sender: its records and its folder can contain paths and links that lead out.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from rig.catalog.columns import FIX, image_path
from rig.config.catalog_place import DATABASE_NAME
from rig.core.errors import CatalogDamaged
from rig.core.files import make_folder
from rig.views.image_files import IMAGE_FOLDER

LOST: Final = "lost+found"
"""Folder for files that `verify` moves away."""

INCOMING: Final = "incoming"
"""Folder of running imports."""

PREPARED: Final = "prepared"
"""Folder of the prepared views (`rig.catalog.prepared`)."""

_OWN: Final = (
    *(f"{DATABASE_NAME}{suffix}" for suffix in ("", "-wal", "-shm", "-journal")),
    *(IMAGE_FOLDER, LOST, INCOMING, PREPARED),
)


def check_folder(root: Path) -> None:
    """Raise `CatalogDamaged` if something of the catalog in the folder ``root`` is a link."""
    for name in _OWN:
        if (root / name).is_symlink():
            raise _leads_out(root / name)


def image_file(root: Path, name: str) -> Path:
    """Return the file of an image, from its path relative to the catalog in the folder ``root``.

    Raises
    ------
    CatalogDamaged
        The path or a link in it leads out of the images of the catalog.
    """
    try:
        return _inside(root, IMAGE_FOLDER, image_path(name))
    except ValueError as error:
        raise _leads_out(root / name) from error


def lost_file(root: Path, name: str) -> Path:
    """Return the file in lost+found for a file of the catalog; errors as for `image_file`."""
    return _inside(root, LOST, f"{LOST}/{name}")


def files_within(folder: Path) -> Iterator[Path]:
    """Yield the files and links in a folder and its subfolders. No link is followed."""
    if folder.is_symlink():
        raise _leads_out(folder)
    for path, folders, files in os.walk(folder):
        yield from (Path(path, name) for name in [*files, *(one for one in folders if Path(path, one).is_symlink())])


def file_mode(root: Path) -> int:
    """Return the permissions of new files: those of the database, so that a shared catalog is shared completely.

    Without a database in the folder they are those of the folder.
    """
    file = root / DATABASE_NAME
    return stat.S_IMODE((file if file.exists() else root).stat().st_mode) & 0o666


def make_folder_within(root: Path, folder: Path) -> None:
    """Create ``folder`` of the catalog in ``root`` with the permissions of its files."""
    make_folder(folder, within=root, mode=folder_mode(file_mode(root)))


def folder_mode(mode: int) -> int:
    """Return the permissions of a folder for files with these permissions."""
    return mode | (mode & 0o444) >> 2


def _inside(root: Path, top: str, name: str) -> Path:
    path = root / name
    real = os.path.realpath(root)
    if not os.path.realpath(path).startswith(f"{real}{os.sep}{top}{os.sep}"):
        raise _leads_out(path)
    with suppress(FileNotFoundError):
        if stat.S_IFMT(path.stat().st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
            raise _leads_out(path)  # a pipe or a device
    return path


def _leads_out(path: Path) -> CatalogDamaged:
    return CatalogDamaged(
        f"{os.fspath(path)!r} of the catalog leads to another place; nothing was changed.", next_step=FIX
    )
