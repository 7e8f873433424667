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
    """Have a folder to fill that becomes ``path`` at the end, or goes with everything in it after an exception.

    Raises
    ------
    ExportFailed
        ``path`` is there already and not an empty folder, or cannot be written.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ExportFailed(f"{path} is there already", next_step="give another name, or remove it")
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
            f"{path} cannot be written: {error.strerror or error}",
            next_step="give a path that you may write to, with space on its disk",
        ) from error
