"""Bundles: a catalog in one file, ``.rigcat.zip``: its database, and its images as ``images/xx/<sha256>.png``.

A reader trusts nothing in a bundle. It checks names against paths outside, and sizes against limits. Only the database
is unpacked, into a private folder, and it is opened as one of an untrusted sender. Each image is compared with its
name. Nothing that can be computed is taken from a bundle.

Decision: docs/decisions/0011.
"""

import shutil
import stat
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Final
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from sqlalchemy import func, select

from rig.catalog.catalog import Catalog
from rig.catalog.exchange.new_files import new_file
from rig.catalog.facts import Enrollment
from rig.catalog.images import Images, name_of, path_of
from rig.catalog.jobs import finished
from rig.catalog.transfer import CatalogSource, TransferItem, transfer
from rig.catalog.upkeep import NAMED_IMAGES
from rig.config.catalog_place import DATABASE_NAME
from rig.core.clock import Clock
from rig.core.errors import ExportFailed, ImportRejected, RigError
from rig.core.files import open_new
from rig.core.next_steps import Do
from rig.views import image_files as images

# more than a shared catalog has images; a bundle is from others, and must not fill memory or disk
MAX_MEMBERS: Final = 2_000_000
MAX_DATABASE_BYTES: Final = 2_000_000_000
MAX_RATIO: Final = 250
"""Largest ratio of the sizes unpacked and packed. A database of such records reaches 40."""

_IMAGE: Final = NAMED_IMAGES.c
_DATE: Final = (1980, 1, 1, 0, 0, 0)  # ZIP's earliest: the same objects give the same bytes


def write_bundle(path: Path, source: CatalogSource) -> int:
    """Write objects into a new file, all or nothing, and return their number.

    Raises `ExportFailed`: the file exists already or cannot be written.
    """
    with new_file(path) as file, ZipFile(file, "w") as archive, TemporaryDirectory(prefix="rig-export-") as folder:
        with Catalog.open(folder, clock=source.catalog.clock) as made:
            made.database.images = _ArchivedImages(archive)
            done = finished(transfer(source, made, jobs=1))
        # Nothing is compressed: the images are, and a reader rejects what grows much, as a long text would.
        made_file = Path(folder, DATABASE_NAME)
        info = _member(DATABASE_NAME)
        info.file_size = made_file.stat().st_size
        with archive.open(info, "w") as stored, made_file.open("rb") as database:
            shutil.copyfileobj(database, stored)
        # A bundle is for others, who must be able to read it: this program tries it first.
        archive.close()
        try:
            with read_bundle(Path(file.name), source.catalog.clock):
                pass
        except ImportRejected as error:
            raise ExportFailed(
                f"{path} was not written, because no import would accept it: {error.what}",
                next_step=(Do.VERIFY_CATALOG(), "Or export fewer objects into each bundle."),
            ) from error
    return done.objects


class _ArchivedImages(Images):
    """The images of a bundle that is being written."""

    def __init__(self, archive: ZipFile) -> None:
        super().__init__(Path(str(archive.filename)))
        self._archive = archive
        self._names: set[str] = set()

    def put(self, content: bytes, *, settled: bool = True) -> str:  # noqa: ARG002
        name = name_of(content)
        if name not in self._names:
            self._archive.writestr(_member(path_of(name)), content)
            self._names.add(name)
        return name

    def settle(self, names: Iterable[str]) -> None:
        """Do nothing: the file of the bundle is made durable as a whole."""

    def missing(self, names: Collection[str]) -> set[str]:
        return set(names) - self._names


@contextmanager
def read_bundle(path: Path, clock: Clock) -> Iterator[CatalogSource]:
    """Yield the objects of a bundle as the source of a transfer, which reads the images.

    Raises `ImportRejected`: the file is not a bundle, is damaged, of another version, or contains invalid data.
    """
    with TemporaryDirectory(prefix="rig-import-") as folder:
        try:
            with ZipFile(path) as archive:
                members = _members(path, archive)
                with archive.open(DATABASE_NAME) as packed, open_new(Path(folder, DATABASE_NAME), mode=0o600) as file:
                    shutil.copyfileobj(packed, file)  # not more than the size that was checked
        except (BadZipFile, OSError, EOFError, NotImplementedError, ValueError, RuntimeError, zlib.error) as error:
            raise _rejected(path, f"it cannot be read: {error}") from error
        with _rejecting(path, folder):
            catalog = Catalog.open(folder, clock=clock, create=False, read_only=True)
        with catalog:
            with _rejecting(path, folder):
                _check_content(path, catalog, {name: info.file_size for name, info in members.items()})
            yield _Bundled(path, folder, catalog)


class _Bundled(CatalogSource):
    """The objects of a bundle."""

    def __init__(self, path: Path, folder: str, catalog: Catalog) -> None:
        super().__init__(catalog, own=False)
        self.origin = str(path)
        found = path.stat()
        self.content = partial(_read_member, str(path), found.st_ino, found.st_mtime_ns)
        self._path, self._folder = path, folder

    def items(self) -> Iterator[TransferItem]:
        with _rejecting(self._path, self._folder):
            yield from super().items()


def _read_member(path: str, inode: int, changed_ns: int, name: str) -> bytes:
    with _archive(path, inode, changed_ns).open(path_of(name)) as member:
        return member.read(images.MAX_FILE_BYTES + 1)


@lru_cache(maxsize=1)
def _archive(path: str, inode: int, changed_ns: int) -> ZipFile:  # noqa: ARG001 - another file may get the same name
    return ZipFile(path)


def _rejected(path: Path, why: str) -> ImportRejected:
    return ImportRejected(
        f"{path} was not imported: {why}.",
        next_step="Ask for another export of the bundle. Do not unpack it by hand if you do not know its origin.",
    )


@contextmanager
def _rejecting(path: Path, folder: str) -> Iterator[None]:
    """Raise an error of the unpacked catalog as one of the bundle."""
    try:
        yield
    except ImportRejected:
        raise
    except RigError as error:
        why = error.what.replace(folder, str(path)).rstrip(".")
        raise _rejected(path, why[0].lower() + why[1:]) from error


def _member(name: str) -> ZipInfo:
    info = ZipInfo(name, _DATE)
    info.external_attr = (stat.S_IFREG | 0o644) << 16
    info.create_system = 3  # Unix, on every computer: external_attr is a Unix mode
    return info


def _members(path: Path, archive: ZipFile) -> dict[str, ZipInfo]:
    """Return the members of a bundle after a check of their names, sizes and kinds."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise _rejected(path, f"it contains {len(infos)} files")
    if sum(info.compress_size for info in infos) > path.stat().st_size:
        raise _rejected(path, "its files overlap")
    members: dict[str, ZipInfo] = {}
    for info in infos:
        if info.is_dir() and not info.file_size:
            continue
        if why := _suspicious(info):
            raise _rejected(path, f"its file {info.filename!r} {why}")
        if info.filename in members:
            raise _rejected(path, f"it contains {info.filename!r} twice")
        members[info.filename] = info
    if DATABASE_NAME not in members:
        raise _rejected(path, f"it does not contain {DATABASE_NAME}")
    return members


def _suspicious(info: ZipInfo) -> str:
    name = info.filename
    pure = PurePosixPath(name)
    mode = info.external_attr >> 16
    if (
        pure.is_absolute()
        or ".." in pure.parts
        or "\\" in info.orig_filename
        or ":" in name
        or "\0" in info.orig_filename
    ):
        return "has a path outside the catalog"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        return "is a link or a device"
    if info.flag_bits & 0x1:
        return "is encrypted"
    if info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        return "is compressed by an unknown method"
    limit = MAX_DATABASE_BYTES if name == DATABASE_NAME else images.MAX_FILE_BYTES
    if info.file_size > limit:
        return f"has {info.file_size} bytes, more than {limit}"
    if info.file_size > MAX_RATIO * max(info.compress_size, 100):
        return f"grows from {info.compress_size} to {info.file_size} bytes"
    if name != DATABASE_NAME and name != path_of(pure.name):
        return "does not belong to a bundle"
    return ""


def _check_content(path: Path, catalog: Catalog, sizes: Mapping[str, int]) -> None:
    """Check that every enrollment is in use, and that exactly its images are in the bundle, with their stored sizes."""
    with catalog.reading() as state:
        if state.transaction.scalar(select(func.count(Enrollment.id))) != len(state.used()):
            raise _rejected(path, "it contains an enrollment that is not complete or not in use")
        of_enrollments = select(_IMAGE.image, _IMAGE.image_bytes).where(_IMAGE.enrollment_id.is_not(None))
        named = {str(name): size for name, size in state.transaction.execute(of_enrollments)}
    for name, size in named.items():
        if path_of(name) not in sizes:
            raise _rejected(path, f"the image {path_of(name)!r} is missing")
        if sizes[path_of(name)] != size:
            raise _rejected(path, f"{path_of(name)!r} has another size than when it was stored")
    if unused := sorted(sizes.keys() - set(map(path_of, named)) - {DATABASE_NAME}):
        raise _rejected(path, f"its file {unused[0]!r} belongs to no view")
