"""A folder that gets its name when all of it is written."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp

from rig.core.errors import ExportFailed
from rig.core.files import sync_folder, sync_tree


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to fill. It becomes ``path`` at the end; after an exception it is deleted with its contents.

    Raises
    ------
    ExportFailed
        ``path`` exists already and is not an empty folder, or cannot be written.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ExportFailed(f"{path} exists already.", next_step="Give another name, or remove it.")
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
    except OSError as error:
        raise ExportFailed(
            f"{path} cannot be written: {error.strerror or error}.",
            next_step="Give a path with write permission, on a disk with free space.",
        ) from error
