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


@contextmanager
def new_document(target: Path, name: str, pictures: str) -> Iterator[tuple[IO[bytes], Path, str]]:
    """Yield a file to write, a folder for its pictures, and the path of that folder from the file.

    ``target`` is the file, if it has the suffix of ``name``: the folder is then beside it. Otherwise it is a folder for
    both. Errors are those of `new_folder`.
    """
    if target.suffix.lower() == Path(name).suffix:
        beside = target.with_name(f"{target.stem}-{pictures}")
        with new_file(target) as file, new_folder(beside) as made:
            yield file, made, beside.name
    else:
        with new_folder(target) as made, (made / name).open("wb") as file:
            (made / pictures).mkdir()
            yield file, made / pictures, pictures


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
