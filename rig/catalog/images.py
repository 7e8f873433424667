"""Stores of the images of a catalog: a folder, or a store that fsspec supports, such as S3.

An image has the SHA-256 of its bytes as its name. So a changed byte is found by the name, an image is stored only once,
and it can be copied again without harm. An image is complete under its name or is not there.
"""

import os
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from math import inf
from pathlib import Path, PurePosixPath
from secrets import token_hex
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.catalog.columns import FIX
from rig.config.catalog_place import DATABASE_NAME, CatalogPlace
from rig.core.errors import CatalogDamaged, CatalogError, CatalogUnavailable, ConfigError, ExtraMissing
from rig.core.files import make_folder, sync, sync_file, sync_folder
from rig.core.files import read as read_local
from rig.core.files import write as write_local
from rig.core.next_steps import Do
from rig.views import image_files as files

FOLDER: Final = files.IMAGE_FOLDER
MARK: Final = "catalog-id"
"""Beside ``images/`` of a catalog on a server: the id of the catalog that the images belong to."""

CACHE: Final = "image-cache"
"""Folder of images that were fetched from a store for programs that read files."""


def name_of(content: bytes) -> str:
    """Return the name of an image: the SHA-256 of its bytes, and the suffix of its format."""
    return f"{files.digest(content)}{files.suffix(content)}"


def path_of(name: str) -> str:
    """Return the path of an image in a store or an export, such as ``images/3f/3f79….png``."""
    return f"{FOLDER}/{name[:2]}/{name}"


class Images:
    """The images of a catalog, in a folder of this computer or in a shared one. It can be sent to other processes.

    Every method raises an `OSError` with the reason if it fails, and `CatalogUnavailable` if a store does not answer.
    """

    are_kept = True
    """Whether the catalog has its images, and not only the rows that name them."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def where(self, name: str) -> str:
        """Return the place of an image for messages; of all images for an empty name."""
        return str(self.root / (path_of(name) if name else FOLDER))

    def read(self, name: str) -> bytes:
        """Return the bytes under a name, unchecked."""
        return files.read_file(self.file(name))

    def content(self, name: str) -> bytes:
        """Return the bytes of an image.

        Raises `CatalogError`: it is missing, cannot be read, or is not the one that was stored.
        """
        fix = (Do.VERIFY_CATALOG(), "Then restore it from a backup, or", Do.ENROLL_AGAIN())
        try:
            content = self.read(name)
        except FileNotFoundError as error:
            raise CatalogError(f"The image {self.where(name)} is missing.", next_step=fix) from error
        except OSError as error:
            raise CatalogError(
                f"The image {self.where(name)} cannot be read: {error.strerror}.", next_step=fix
            ) from error
        if not name.startswith(files.digest(content)):
            raise CatalogError(f"The image {self.where(name)} is not the one that was stored.", next_step=fix)
        return content

    def pixels(self, name: str) -> NDArray[np.uint8]:
        """Return the pixels of an image, uint8 (H, W, 3) BGR; errors as `content`, or it is no valid image."""
        try:
            return files.decode(self.content(name))
        except files.BadImage as error:
            raise CatalogError(
                f"The image {self.where(name)} is not readable: {error}.", next_step=Do.VERIFY_CATALOG()
            ) from error

    def file(self, name: str) -> Path:
        """Return a file on this computer with the bytes of an image."""
        return image_file(self.root, path_of(name))

    def put(self, content: bytes, *, settled: bool = True) -> str:
        """Store an image completely or not at all, and return its name; nothing happens if it is there already.

        On return it is durable if it is ``settled``; otherwise `settle` makes it durable.
        """
        name = name_of(content)
        path = self.file(name)
        stored = b""
        with suppress(OSError):
            stored = files.read_file(path)
        if stored == content:
            with suppress(OSError):
                os.utime(path)  # `collect_garbage` spares new files: the row of this one is not stored yet
            if settled:
                sync_file(path)  # the process that wrote it may not have waited, or was killed before it did
                sync_folder(path.parent)
        else:
            mode = file_mode(self.root)
            if not path.parent.is_dir():  # who may read its files may also enter it
                make_folder(path.parent, within=self.root, mode=mode | (mode & 0o444) >> 2)
            # a name of its own: another process may write the same image now
            write_local(path, content, mode=mode, part=f".{token_hex(8)}.part", settled=settled)
        return name

    def settle(self, names: Iterable[str]) -> None:
        """Wait until these images are durable."""
        paths = [self.file(name) for name in set(names)]
        sync([*paths, *{path.parent for path in paths}, self.root / FOLDER, self.root])

    def names(self, *, before_s: float = inf) -> set[str]:
        """Return the names of the files that were written before this time, in seconds since 1970."""
        return {path.name for path in files_within(self.root / FOLDER) if path.lstat().st_mtime < before_s}

    def missing(self, names: Collection[str]) -> set[str]:
        """Return which of these images are not there. The caller has just stored them."""
        return {name for name in names if not os.path.lexists(self.root / path_of(name))}

    def size(self, name: str) -> int:
        """Return the size of an image in bytes; 0 if there is none."""
        with suppress(FileNotFoundError):
            return self.file(name).lstat().st_size
        return 0

    def remove(self, names: Iterable[str]) -> None:
        """Remove images. A missing one is no error."""
        for name in names:
            path = self.file(name)
            path.unlink(missing_ok=True)
            with suppress(OSError):  # its folder is not empty
                path.parent.rmdir()

    def mark(self) -> str | None:
        """Return the id of the catalog that the images belong to."""
        with suppress(FileNotFoundError):
            return read_local(self.root / MARK, max_bytes=100).decode()
        return None

    def set_mark(self, catalog_id: str) -> None:
        """Store the id of the catalog that the images belong to."""
        self.root.mkdir(parents=True, exist_ok=True)
        write_local(self.root / MARK, catalog_id.encode(), mode=file_mode(self.root))

    def is_empty(self) -> bool:
        """Return whether there is nothing at all, as in a network share that is not mounted."""
        return not self.root.is_dir() or not any(self.root.iterdir())


class FsspecImages(Images):
    """The images in a store that fsspec supports. A store writes an image as a whole, and durably.

    ``root`` is the folder of the images that were fetched for programs that read files.
    """

    def __init__(self, url: str, root: Path) -> None:
        super().__init__(root)
        self.url = url.rstrip("/")
        self._opened: tuple[Any, str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}  # a connection belongs to its process

    def where(self, name: str) -> str:
        return f"{self.url}/{path_of(name) if name else FOLDER}"

    def read(self, name: str) -> bytes:
        if self._size(name) > files.MAX_FILE_BYTES:
            raise OSError(None, f"it is larger than {files.MAX_FILE_BYTES} bytes", name)
        with self._store() as (store, root):
            return bytes(store.cat_file(f"{root}/{path_of(name)}"))

    def file(self, name: str) -> Path:
        path = super().file(name)
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_local(path, self.content(name), mode=0o600)
        return path

    def put(self, content: bytes, *, settled: bool = True) -> str:  # noqa: ARG002
        name = name_of(content)
        if self.size(name) != len(content):
            self._write(path_of(name), content)
        return name

    def _write(self, path: str, content: bytes) -> None:
        try:
            with self._store() as (store, root):
                store.pipe_file(f"{root}/{path}", content)
        except FileNotFoundError as error:
            raise CatalogError(
                f"The store {self.url} does not exist.",
                next_step="Create its bucket, or correct catalog.images.",
                evidence={"error": str(error)},
            ) from error

    def settle(self, names: Iterable[str]) -> None:
        pass

    def names(self, *, before_s: float = inf) -> set[str]:
        with self._store() as (store, root):
            found = store.find(f"{root}/{FOLDER}", detail=True)
        return {path.rpartition("/")[2] for path, info in found.items() if _written_s(info) < before_s}

    def missing(self, names: Collection[str]) -> set[str]:
        return set(names) - self.names()

    def is_empty(self) -> bool:
        return False

    def size(self, name: str) -> int:
        with suppress(FileNotFoundError):
            return self._size(name)
        return 0

    def _size(self, name: str) -> int:
        with self._store() as (store, root):
            return int(store.info(f"{root}/{path_of(name)}")["size"])

    def remove(self, names: Iterable[str]) -> None:
        with self._store() as (store, root):
            for name in names:
                with suppress(FileNotFoundError):
                    store.rm_file(f"{root}/{path_of(name)}")
                (self.root / path_of(name)).unlink(missing_ok=True)

    def mark(self) -> str | None:
        with suppress(FileNotFoundError), self._store() as (store, root):
            return bytes(store.cat_file(f"{root}/{MARK}")).decode()
        return None

    def set_mark(self, catalog_id: str) -> None:
        self._write(MARK, catalog_id.encode())

    @contextmanager
    def _store(self) -> Iterator[tuple[Any, str]]:
        """Yield the file system and the path of the store; its errors become `OSError` or `CatalogUnavailable`."""
        if self._opened is None:
            self._opened = _connect(self.url)
        store, root = self._opened
        try:
            store.invalidate_cache()
            yield store, root
        except FileNotFoundError:
            raise
        except Exception as error:  # each store has its own errors for a connection that fails
            raise CatalogUnavailable(
                f"The images of the catalog in {self.url} cannot be reached.",
                next_step="Check the network and the access to the store, then try again.",
                evidence={"error": f"{type(error).__name__}: {error}"},
            ) from error


def open_images(place: CatalogPlace) -> Images:
    """Return the store of the images of a catalog; nothing is read yet.

    Raises `ExtraMissing`: the packages for this kind of store are not installed.
    """
    if place.images is None:
        return Images(place.path)
    if "://" not in place.images or place.images.startswith("file://"):
        return Images(Path(place.images.removeprefix("file://")).expanduser().absolute())
    try:
        import fsspec

        fsspec.get_filesystem_class(place.images.partition("://")[0])
    except (ImportError, ValueError) as error:
        if isinstance(error, ValueError):
            raise ConfigError(
                f"catalog.images = {place.images!r}: no such kind of store.",
                next_step="Give a folder, or a URL such as s3://bucket/folder.",
            ) from error
        raise ExtraMissing.of("store", "images in an object store", error) from error
    return FsspecImages(place.images, place.path / CACHE)


def _connect(url: str) -> tuple[Any, str]:
    import fsspec

    options: dict[str, Any] = {}
    if url.startswith("s3://"):  # the address and the keys are in the environment, as for every program that uses S3
        limits = {"connect_timeout": 5, "read_timeout": 20, "retries": {"max_attempts": 2}}
        options = {"config_kwargs": limits, "use_listings_cache": False}
    store, root = fsspec.core.url_to_fs(url, **options)
    return store, str(root).rstrip("/")


def _written_s(info: Mapping[str, Any]) -> float:
    """Return when a file of a store was written, in seconds since 1970; 0 if the store does not say."""
    when = info.get("LastModified") or info.get("mtime") or 0.0
    return float(when.timestamp() if isinstance(when, datetime) else when)


# Files in the folder of a catalog. A catalog may come from an untrusted sender: its records and its folder can contain
# paths and links that lead out. Nothing outside of it is read, written or removed.


def image_file(root: Path, path: str) -> Path:
    """Return the file of an image at a path within ``images/`` of the catalog in the folder ``root``.

    Raises `CatalogDamaged`: a link leads out of the images of the catalog, or the file is a pipe or a device.
    """
    for part in (*reversed(PurePosixPath(path).parents), PurePosixPath(path)):
        with suppress(FileNotFoundError):
            kind = stat.S_IFMT((root / part).stat(follow_symlinks=part == PurePosixPath()).st_mode)
            if kind not in (stat.S_IFREG, stat.S_IFDIR):
                raise leads_out(root / part)
    return root / path


def files_within(folder: Path) -> Iterator[Path]:
    """Yield the files and links in a folder and its subfolders. No link is followed."""
    if folder.is_symlink():
        raise leads_out(folder)
    for path, folders, names in os.walk(folder):
        yield from (Path(path, name) for name in [*names, *(one for one in folders if Path(path, one).is_symlink())])


def file_mode(root: Path) -> int:
    """Return the permissions of new files: those of the database, so that a shared catalog is shared completely.

    Without a database in the folder they are those of the folder.
    """
    file = root / DATABASE_NAME
    return stat.S_IMODE((file if file.exists() else root).stat().st_mode) & 0o666


def leads_out(path: Path) -> CatalogDamaged:
    """Return the error for something in the folder of a catalog that leads out of it."""
    return CatalogDamaged(
        f"{os.fspath(path)!r} of the catalog leads to another place; nothing was changed.", next_step=FIX
    )
