"""Files and folders of an export. They get their names when all of them is written."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import IO

from rig.core.errors import ExportFailed
from rig.core.files import open_new, sync_file, sync_folder, sync_tree


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file to write. It becomes ``path`` at the end; after an exception it is deleted.

    Raises
    ------
    ExportFailed
        ``path`` exists already or cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    with _write_errors(path):
        if path.exists():
            raise _exists(path)
        try:
            with open_new(part) as file:
                yield file
            sync_file(part)
            part.replace(path)
            sync_folder(path.parent)
        finally:
            with suppress(OSError):
                part.unlink()


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to fill. It becomes ``path`` at the end; after an exception it is deleted with its contents.

    Raises
    ------
    ExportFailed
        ``path`` exists already and is not an empty folder, or cannot be written.
    """
    with _write_errors(path):
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise _exists(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        made = Path(mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            yield made
            made.chmod(0o755)
            sync_tree(made)
            made.rename(path)
            sync_folder(path.parent)
        finally:
            shutil.rmtree(made, ignore_errors=True)


def _exists(path: Path) -> ExportFailed:
    return ExportFailed(f"{path} exists already.", next_step="Give another name, or remove it.")


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ExportFailed(
            f"{path} cannot be written: {error.strerror or error}.",
            next_step="Give a path with write permission, on a disk with free space.",
        ) from error
