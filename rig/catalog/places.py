"""Places of files in the folder of a catalog. Nothing outside of it is read, written or removed.

A catalog may come from an untrusted sender: its records and its folder can contain paths and links that lead out.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Final

from rig.catalog.columns import FIX
from rig.config.catalog_place import DATABASE_NAME
from rig.core.errors import CatalogDamaged
from rig.core.files import make_folder
from rig.views.image_files import IMAGE_FOLDER

_OWN: Final = (DATABASE_NAME, IMAGE_FOLDER)
_BESIDE: Final = tuple(f"{DATABASE_NAME}-{suffix}" for suffix in ("wal", "shm", "journal"))
"""Files that SQLite itself writes beside the database."""


def check_folder(root: Path) -> None:
    """Check the folder of a catalog before SQLite opens a file in it.

    Raises `CatalogDamaged`: something of the catalog in the folder ``root`` is a link; a file that belongs to SQLite
    has a second name or is a pipe or a device; or there is a rollback journal, which this program does not use.
    """
    for name in _OWN:
        if (root / name).is_symlink():
            raise _leads_out(root / name)
    for name in _BESIDE:
        with suppress(FileNotFoundError):
            found = (root / name).lstat()
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                raise _leads_out(root / name)
            # SQLite plays a rollback journal back before this program can look at anything. One with a super-journal
            # record names any other file, and SQLite then deletes that file. This program leaves no such journal after
            # a kill: it writes with a write-ahead log only. The log itself (-wal) and its index (-shm) name no file;
            # the pages of the log are checked like the database.
            if found.st_size and name.endswith("-journal"):
                raise CatalogDamaged(
                    f"{os.fspath(root / name)!r} is a journal of another program. SQLite would change the catalog by "
                    "it, and delete the file that it may name. Nothing was opened or changed.",
                    next_step=FIX,
                    evidence={"bytes": found.st_size},
                )


def image_file(root: Path, path: str) -> Path:
    """Return the file of an image at a path within ``images/`` of the catalog in the folder ``root``.

    Raises `CatalogDamaged`: a link leads out of the images of the catalog, or the file is a pipe or a device.
    """
    for part in (*reversed(PurePosixPath(path).parents), PurePosixPath(path)):
        with suppress(FileNotFoundError):
            kind = stat.S_IFMT((root / part).stat(follow_symlinks=part == PurePosixPath()).st_mode)
            if kind not in (stat.S_IFREG, stat.S_IFDIR):
                raise _leads_out(root / part)
    return root / path


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


def make_folder_within(root: Path, folder: Path, *, settled: bool = True) -> None:
    """Create ``folder`` of the catalog in ``root``; who may read its files may also enter it.

    Its name is on the disk on return if it is ``settled``.
    """
    mode = file_mode(root)
    mode |= (mode & 0o444) >> 2
    if settled:
        make_folder(folder, within=root, mode=mode)
        return
    for one in reversed([folder, *folder.parents]):
        if one.is_relative_to(root):
            one.mkdir(mode=mode, exist_ok=True)


def _leads_out(path: Path) -> CatalogDamaged:
    return CatalogDamaged(
        f"{os.fspath(path)!r} of the catalog leads to another place; nothing was changed.", next_step=FIX
    )
