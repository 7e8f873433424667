"""Bundles: a catalog in one file, ``.rigcat.zip``, with the stored image files and JSON Lines.

The same objects give the same bytes: one order, and no dates but those of the objects. A reader trusts nothing in a
bundle: it checks names against paths outside, sizes against limits, and every image against its SHA-256.

Decision: docs/decisions/0015.
"""

import hashlib
import json
import stat
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, Final
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from pydantic import ValidationError

from rig.catalog.exchange.batch import ExportedObject, ImageSource, ImportBatch, Object
from rig.catalog.places import files_within
from rig.core.errors import CatalogDamaged, ExportFailed, ImportRejected, RigError
from rig.core.files import no_follow, open_new, sync_file, sync_folder
from rig.core.next_steps import Do
from rig.views import image_files as images

FORMAT: Final = "rigcat"
VERSION: Final = 1
MANIFEST: Final = "rigcat.json"
OBJECTS: Final = "objects.jsonl"

MAX_MEMBERS: Final = 2_000_000
MAX_OBJECTS_BYTES: Final = 1_000_000_000
MAX_LINE_BYTES: Final = 64_000_000
MAX_RATIO: Final = 250
"""Largest ratio of the sizes unpacked and packed. The text of such records reaches 40."""

_DATE: Final = (1980, 1, 1, 0, 0, 0)


def write_bundle(path: Path, objects: Iterable[ExportedObject]) -> int:
    """Write objects with their files (`read_objects`) into a new file, all or nothing, and return their number.

    Raises
    ------
    ExportFailed
        The file exists already or cannot be written, or an image is not the stored one.
    """
    items = []
    with new_file(path) as file, ZipFile(file, "w") as archive:
        for item, files in objects:
            for name, sha256 in images_of(item).items():
                archive.writestr(_member(name), read_stored(files[name], sha256), ZIP_STORED)
            items.append(item)
        text, manifest = index_of(items)
        compressible = len(text) > MAX_RATIO // 2 * len(zlib.compress(text))  # a reader would reject a higher ratio
        archive.writestr(_member(OBJECTS), text, ZIP_STORED if compressible else ZIP_DEFLATED)
        archive.writestr(_member(MANIFEST), manifest, ZIP_STORED)
        archive.close()
        _check_readable(path, Path(file.name))
    return len(items)


def images_of(item: Object) -> dict[str, str | None]:
    """Return the paths of all images of an object, with their SHA-256."""
    return {
        name: sha256
        for enrollment in item.enrollments
        for name, sha256 in (
            *((view.image, view.image_sha256) for view in enrollment.views),
            *((session.empty_table_image, session.empty_table_image_sha256) for session in enrollment.sessions),
        )
        if name is not None
    }


def index_of(items: Sequence[Object]) -> tuple[bytes, bytes]:
    """Return the content of `OBJECTS` and of `MANIFEST`."""
    text = "".join(item.model_dump_json() + "\n" for item in items).encode()
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "objects": len(items),
        "views": sum(len(enrollment.views) for item in items for enrollment in item.enrollments),
        "objects_sha256": hashlib.sha256(text).hexdigest(),
    }
    return text, (json.dumps(manifest, indent=1) + "\n").encode()


def _check_readable(path: Path, part: Path) -> None:
    """Raise `ExportFailed` if an import would reject what was written."""
    try:
        read_bundle(part)
    except ImportRejected as error:
        raise ExportFailed(
            f"{path} was not written, because no import would accept it: {error.what}",
            next_step=(Do.VERIFY_CATALOG(), "Or export fewer objects into each bundle."),
        ) from error


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file to write. It gets its name when all of it is on the disk.

    Raises
    ------
    ExportFailed
        It exists already or cannot be written.
    """
    if path.exists():
        raise ExportFailed(f"{path} exists already.", next_step="Give another name, or remove it.")
    part = path.with_name(f"{path.name}.part")
    try:
        with open_new(part) as file:
            yield file
        sync_file(part)
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise ExportFailed(
            f"{path} cannot be written: {error.strerror or error}.",
            next_step="Give a path with write permission, on a disk with free space.",
        ) from error
    finally:
        with suppress(OSError):
            part.unlink()


def read_stored(path: Path, sha256: str | None) -> bytes:
    """Return the bytes of an image of the catalog. `ExportFailed` if it is not the stored one."""
    fix = Do.REPAIR_CATALOG()
    try:
        content = images.read_file(path)
    except OSError as error:
        raise ExportFailed(f"The image {path} cannot be read: {error.strerror}.", next_step=fix) from error
    if images.digest(content) != sha256:
        raise ExportFailed(f"The image {path} is not the stored one.", next_step=fix)
    return content


def read_bundle(path: Path) -> ImportBatch:
    """Read the objects of a bundle, and check that their images are in it. `import_objects` reads the images.

    Raises
    ------
    ImportRejected
        The file is not a bundle, is damaged, of a newer version, or contains invalid data. Nothing was unpacked.
    """
    try:
        with ZipFile(path) as archive:
            members = _members(path, archive)
            with archive.open(MANIFEST) as manifest, archive.open(OBJECTS) as lines:
                sizes = {name: info.file_size for name, info in members.items()}
                objects, names = _objects(path, manifest, lines, sizes)
        if unused := sorted(members.keys() - names - {MANIFEST, OBJECTS}):
            raise rejected(path, f"its file {unused[0]!r} belongs to no view")
    except (BadZipFile, OSError, EOFError, NotImplementedError, ValueError, RuntimeError, zlib.error) as error:
        raise rejected(path, f"it cannot be read: {error}") from error
    return ImportBatch(
        str(path),
        objects,
        {name: ImageSource(str(path), name) for name in members if name not in (MANIFEST, OBJECTS)},
        strict=True,
    )


def read_unpacked(folder: Path) -> ImportBatch:
    """Read the objects of a folder with the files of a bundle, such as an export for training; errors as `read_bundle`.

    Other files in the folder are ignored. No link is followed.
    """
    try:
        files = [*files_within(folder / images.IMAGE_FOLDER), folder / MANIFEST, folder / OBJECTS]
        sizes = {
            file.relative_to(folder).as_posix(): found.st_size
            for file in files
            if stat.S_ISREG((found := file.lstat()).st_mode) and found.st_size <= MAX_OBJECTS_BYTES
        }
        if missing := {MANIFEST, OBJECTS} - sizes.keys():
            raise rejected(folder, f"its file {min(missing)} is missing or cannot be read")
        with _open(folder / MANIFEST) as manifest, _open(folder / OBJECTS) as lines:
            objects, names = _objects(folder, manifest, lines, sizes)
    except (OSError, ValueError, RecursionError, CatalogDamaged) as error:
        raise rejected(folder, f"it cannot be read: {error}") from error
    return ImportBatch(str(folder), objects, {name: ImageSource(str(folder / name)) for name in names}, strict=True)


def _open(path: Path) -> IO[bytes]:
    return open(path, "rb", opener=no_follow)


def rejected(path: Path, why: str) -> ImportRejected:
    """Return the error for a bundle that is not imported."""
    return ImportRejected(
        f"{path} was not imported: {why}.",
        next_step="Ask for another export of the bundle. Do not unpack it by hand if you do not know its origin.",
    )


def _member(name: str) -> ZipInfo:
    info = ZipInfo(name, _DATE)
    info.external_attr = (stat.S_IFREG | 0o644) << 16
    info.create_system = 3  # Unix, on every computer: external_attr is a Unix mode
    return info


def _members(path: Path, archive: ZipFile) -> dict[str, ZipInfo]:
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise rejected(path, f"it contains {len(infos)} files")
    packed = sum(info.compress_size for info in infos)
    if packed > path.stat().st_size:
        raise rejected(path, "its files overlap")
    members: dict[str, ZipInfo] = {}
    for info in infos:
        name = info.filename
        if info.is_dir() and not info.file_size:
            continue
        if why := _suspicious(info):
            raise rejected(path, f"its file {name!r} {why}")
        if name in members:
            raise rejected(path, f"it contains {name!r} twice")
        members[name] = info
    for name in (MANIFEST, OBJECTS):
        if name not in members:
            raise rejected(path, f"it does not contain {name}")
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
    limit = MAX_OBJECTS_BYTES if name in (MANIFEST, OBJECTS) else images.MAX_FILE_BYTES
    if info.file_size > limit:
        return f"has {info.file_size} bytes, more than {limit}"
    if info.file_size > MAX_RATIO * max(info.compress_size, 100):
        return f"grows from {info.compress_size} to {info.file_size} bytes"
    if name not in (MANIFEST, OBJECTS) and pure.parts[0] != images.IMAGE_FOLDER:
        return "does not belong to a bundle"
    return ""


def _objects(
    path: Path, manifest_file: IO[bytes], lines: IO[bytes], sizes: Mapping[str, int]
) -> tuple[tuple[Object, ...], set[str]]:
    """Return the objects and the names of their images, which have these sizes."""
    manifest = json.loads(manifest_file.read(100_000))
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise rejected(path, f"its {MANIFEST} is not the manifest of a bundle")
    version = manifest.get("version")
    if type(version) is not int or version < 1:
        raise rejected(path, f"its format has version {version!r:.40}")
    if version != VERSION:
        raise ImportRejected(
            f"{path} was written by another version of the program: its format has version {version}, "
            f"this program knows {VERSION}.",
            next_step="Export the objects again, with the version of hbr-rig on this computer.",
        )
    found: list[Object] = []
    names: set[str] = set()
    digest = hashlib.sha256()
    number = 0
    while line := lines.readline(MAX_LINE_BYTES + 1):
        number += 1
        digest.update(line)
        if len(line) > MAX_LINE_BYTES:
            raise rejected(path, f"line {number} of {OBJECTS} is longer than {MAX_LINE_BYTES} bytes")
        found.append(_object(path, number, line))
        names |= _images_of(path, number, found[-1], sizes)
    if digest.hexdigest() != manifest.get("objects_sha256"):
        raise rejected(path, f"its {OBJECTS} was changed after it was written")
    if len({item.name for item in found}) < len(found):
        raise rejected(path, "two objects have the same name")
    return tuple(found), names


def _object(path: Path, number: int, line: bytes) -> Object:
    try:
        return Object.model_validate_json(line)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise rejected(path, f"line {number} of {OBJECTS}, {where or 'the object'}: {first['msg']}") from error
    except RigError as error:
        raise rejected(path, f"line {number} of {OBJECTS}: {error.what.rstrip('.')}") from error


def _images_of(path: Path, number: int, item: Object, sizes: Mapping[str, int]) -> set[str]:
    names: set[str] = set()
    for enrollment in item.enrollments:
        for name, size, sha256 in (
            *((view.image, view.image_bytes, view.image_sha256) for view in enrollment.views),
            *(
                (session.empty_table_image, session.empty_table_image_bytes, session.empty_table_image_sha256)
                for session in enrollment.sessions
                if session.empty_table_image is not None
            ),
        ):
            if name in names:
                raise rejected(path, f"line {number} of {OBJECTS}: {name!r} is the image of two views")
            if name not in sizes or name in (MANIFEST, OBJECTS):
                raise rejected(path, f"line {number} of {OBJECTS}: the image {name!r} is missing")
            if sha256 is None or size != sizes[name]:
                raise rejected(path, f"line {number} of {OBJECTS}: {name!r} has another size than when it was stored")
            names.add(name)
    return names
