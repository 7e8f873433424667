"""Files and folders of an export. They get their names when all of them is written."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from rig.core.errors import ExportFailed
from rig.core.files import sync_file, sync_folder, sync_tree


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file to write. It becomes ``path`` at the end; after an exception it is deleted.

    Raises `ExportFailed`: ``path`` exists already or cannot be written.
    """
    with _made(path) as made:
        with made.open("wb") as file:
            yield file
        sync_file(made)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to fill. It becomes ``path``, which may be an empty folder; otherwise as `new_file`."""
    with _made(path) as made:
        made.mkdir()
        yield made
        sync_tree(made)


@contextmanager
def _made(path: Path) -> Iterator[Path]:
    """Yield a path on the same disk, for what gets the name ``path`` at the end."""
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ExportFailed(f"{path} exists already.", next_step="Give another name, or remove it.")
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".rig-export-", dir=path.parent, ignore_cleanup_errors=True) as folder:
            yield Path(folder, path.name)
            Path(folder, path.name).rename(path)
            sync_folder(path.parent)
    except OSError as error:
        raise ExportFailed(
            f"{path} cannot be written: {error.strerror or error}.",
            next_step="Give a path with write permission, on a disk with free space.",
        ) from error
