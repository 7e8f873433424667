"""Stores of the images of a catalog: a folder, or a store that fsspec supports, such as S3.

Names are paths relative to the catalog, within ``images/``; files that were moved away are within ``lost+found/``. An
image is complete under its name or is not there. Names that are in use are not written again, except to repair them.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.catalog.places import LOST, file_mode, files_within, image_file, lost_file, make_folder_within
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError, CatalogUnavailable, ConfigError, ExtraMissing
from rig.core.files import read as read_local
from rig.core.files import write as write_local
from rig.views import image_files as images

MARK: Final = "catalog-id"
"""Beside ``images/`` of a catalog on a server: the id of the catalog that the images belong to."""

CACHE: Final = "image-cache"
"""Folder of images that were fetched from a store for programs that read files."""


class ImageStore(ABC):
    """The images of a catalog. It can be sent to other processes.

    Every method raises an `OSError` with the reason if it fails, and `CatalogUnavailable` if a store does not answer.
    """

    moves = False
    """Whether a folder beside the images can be moved in among them (`rig.catalog.staging`)."""

    @abstractmethod
    def where(self, name: str) -> str:
        """Return the place of an image for messages."""

    @abstractmethod
    def check(self, name: str) -> None:
        """Raise `CatalogDamaged` if a name leads out of the images."""

    @abstractmethod
    def read(self, name: str) -> bytes:
        """Return the bytes of an image."""

    def pixels(self, name: str, sha256: str) -> NDArray[np.uint8]:
        """Return the pixels of a stored image, uint8 (H, W, 3) BGR; errors as `rig.views.image_files.checked`."""
        return images.checked(lambda: self.read(name), self.where(name), sha256)

    @abstractmethod
    def file(self, name: str) -> Path:
        """Return a file on this computer with the bytes of an image."""

    @abstractmethod
    def write(self, name: str, content: bytes) -> None:
        """Store an image completely or not at all; on return it is durable."""

    @abstractmethod
    def make_folder(self, name: str) -> None:
        """Create the folder of an enrollment, if the store has folders."""

    def names(self) -> set[str]:
        """Return the names of all files within ``images/``."""
        return self._names(images.IMAGE_FOLDER)

    def lost(self) -> set[str]:
        """Return the names of all files within ``lost+found/``."""
        return self._names(LOST)

    @abstractmethod
    def _names(self, top: str) -> set[str]: ...

    @abstractmethod
    def size(self, name: str) -> int:
        """Return the size of a file in bytes; 0 if there is none."""

    @abstractmethod
    def remove(self, names: Iterable[str]) -> None:
        """Remove files, and the folders that are empty then. A missing file is no error."""

    @abstractmethod
    def set_aside(self, name: str) -> str:
        """Move a file to ``lost+found/`` and return its name there."""

    @abstractmethod
    def free_bytes(self) -> int | None:
        """Return the free space; None if the store reports no limit."""

    @abstractmethod
    def mark(self) -> str | None:
        """Return the id of the catalog that the images belong to."""

    def is_empty(self) -> bool:
        """Return whether there is nothing at all, as in a network share that is not mounted."""
        return False

    @abstractmethod
    def set_mark(self, catalog_id: str) -> None:
        """Store the id of the catalog that the images belong to."""

    def copy_in(self, folder: Path, target: str) -> None:
        """Store all files of a folder of this computer under the name ``target``."""
        for path in sorted(folder.iterdir()):
            self.write(f"{target}/{path.name}", read_local(path, max_bytes=images.MAX_FILE_BYTES))


class FolderImages(ImageStore):
    """The images in a folder of this computer, or in a shared folder."""

    def __init__(self, root: Path, *, moves: bool = True) -> None:
        self.root = root
        self.moves = moves

    def where(self, name: str) -> str:
        return str(self.root / name)

    def check(self, name: str) -> None:
        image_file(self.root, name)

    def _path(self, name: str) -> Path:
        inner = name.removeprefix(f"{LOST}/")
        return image_file(self.root, name) if inner == name else lost_file(self.root, inner)

    def read(self, name: str) -> bytes:
        return images.read_file(self._path(name))

    def file(self, name: str) -> Path:
        return self._path(name)

    def write(self, name: str, content: bytes) -> None:
        path = self._path(name)
        if not path.parent.is_dir():
            make_folder_within(self.root, path.parent)
        write_local(path, content, mode=file_mode(self.root))

    def make_folder(self, name: str) -> None:
        make_folder_within(self.root, image_file(self.root, name))

    def _names(self, top: str) -> set[str]:
        return {path.relative_to(self.root).as_posix() for path in files_within(self.root / top)}

    def size(self, name: str) -> int:
        with suppress(FileNotFoundError):
            return (self.root / name).lstat().st_size
        return 0

    def remove(self, names: Iterable[str]) -> None:
        folders: set[Path] = set()
        for name in names:
            path = self.root / name
            if name.partition("/")[0] not in (images.IMAGE_FOLDER, LOST):
                continue
            path.unlink(missing_ok=True)
            folders.update(
                parent for parent in path.parents if parent != self.root and parent.is_relative_to(self.root)
            )
        for folder in sorted(folders, key=lambda path: len(path.parts), reverse=True):
            with suppress(OSError):  # it is not empty
                folder.rmdir()

    def set_aside(self, name: str) -> str:
        target = lost_file(self.root, name)
        make_folder_within(self.root, target.parent)
        number = 1
        while os.path.lexists(target):
            target = target.with_name(f"{Path(name).stem}-{number}{Path(name).suffix}")
            number += 1
        (self.root / name).rename(target)
        return target.relative_to(self.root).as_posix()

    def free_bytes(self) -> int | None:
        disk = os.statvfs(self.root)
        return disk.f_bavail * disk.f_frsize

    def mark(self) -> str | None:
        with suppress(FileNotFoundError):
            return read_local(self.root / MARK, max_bytes=100).decode()
        return None

    def is_empty(self) -> bool:
        return not self.root.is_dir() or not any(self.root.iterdir())

    def set_mark(self, catalog_id: str) -> None:
        self.root.mkdir(parents=True, exist_ok=True)
        write_local(self.root / MARK, catalog_id.encode(), mode=file_mode(self.root))


class FsspecImages(ImageStore):
    """The images in a store that fsspec supports. A store writes an image as a whole."""

    def __init__(self, url: str, cache: Path) -> None:
        self.url = url.rstrip("/")
        self._cache = cache
        self._opened: tuple[Any, str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}  # a connection belongs to its process

    def where(self, name: str) -> str:
        return f"{self.url}/{name}"

    def check(self, name: str) -> None:
        image_file(self._cache, name)

    def read(self, name: str) -> bytes:
        if self._size(name) > images.MAX_FILE_BYTES:
            raise OSError(None, f"it is larger than {images.MAX_FILE_BYTES} bytes", name)
        with self._store() as (files, root):
            return bytes(files.cat_file(f"{root}/{name}"))

    def file(self, name: str) -> Path:
        path = image_file(self._cache, name)
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_local(path, self.read(name), mode=0o600)
        return path

    def write(self, name: str, content: bytes) -> None:
        try:
            with self._store() as (files, root):
                files.pipe_file(f"{root}/{name}", content)
        except FileNotFoundError as error:
            raise CatalogError(
                f"The store {self.url} does not exist.",
                next_step="Create its bucket, or correct catalog.images.",
                evidence={"error": str(error)},
            ) from error

    def make_folder(self, name: str) -> None:
        """Do nothing: a store has no folders."""

    def _names(self, top: str) -> set[str]:
        with self._store() as (files, root):
            found = files.find(f"{root}/{top}")
        return {str(path)[len(root) :].lstrip("/") for path in found}

    def size(self, name: str) -> int:
        with suppress(FileNotFoundError):
            return self._size(name)
        return 0

    def _size(self, name: str) -> int:
        with self._store() as (files, root):
            return int(files.info(f"{root}/{name}")["size"])

    def remove(self, names: Iterable[str]) -> None:
        with self._store() as (files, root):
            for name in names:
                with suppress(FileNotFoundError):
                    files.rm_file(f"{root}/{name}")
                (self._cache / name).unlink(missing_ok=True)

    def set_aside(self, name: str) -> str:
        pure = PurePosixPath(name)
        target, number = f"{LOST}/{name}", 0
        with self._store() as (files, root):
            while files.exists(f"{root}/{target}"):
                number += 1
                target = f"{LOST}/{pure.with_name(f'{pure.stem}-{number}{pure.suffix}')}"
            files.cp_file(f"{root}/{name}", f"{root}/{target}")
            files.rm_file(f"{root}/{name}")
        return target

    def free_bytes(self) -> int | None:
        return None

    def mark(self) -> str | None:
        with suppress(FileNotFoundError), self._store() as (files, root):
            return bytes(files.cat_file(f"{root}/{MARK}")).decode()
        return None

    def set_mark(self, catalog_id: str) -> None:
        self.write(MARK, catalog_id.encode())

    @contextmanager
    def _store(self) -> Iterator[tuple[Any, str]]:
        """Yield the file system and the path of the store; its errors become `OSError` or `CatalogUnavailable`."""
        if self._opened is None:
            self._opened = _connect(self.url)
        files, root = self._opened
        try:
            files.invalidate_cache()
            yield files, root
        except FileNotFoundError:
            raise
        except Exception as error:  # each store has its own errors for a connection that fails
            raise CatalogUnavailable(
                f"The images of the catalog in {self.url} cannot be reached.",
                next_step="Check the network and the access to the store, then try again.",
                evidence={"error": f"{type(error).__name__}: {error}"},
            ) from error


def open_store(place: CatalogPlace) -> ImageStore:
    """Return the store of the images of a catalog; nothing is read yet.

    Raises
    ------
    ExtraMissing
        The packages for this kind of store are not installed.
    """
    if place.images is None:
        return FolderImages(place.path)
    if place.images.startswith("file://"):
        return FolderImages(Path(place.images.removeprefix("file://")), moves=False)
    if "://" not in place.images:
        return FolderImages(Path(place.images).expanduser().absolute(), moves=False)
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
    files, root = fsspec.core.url_to_fs(url, **options)
    return files, str(root).rstrip("/")
