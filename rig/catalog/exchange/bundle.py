"""A catalog in one file, ``.rigcat.zip``: images as they are, and JSON Lines beside them.

The same objects give the same bytes: no dates but those of the objects, and one order. Nothing of what a bundle says is
believed: names stay within it, sizes within limits, and every image has to hash to what its object says.
"""

import hashlib
import json
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, Final
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from pydantic import ValidationError

from rig.catalog.exchange.package import ImageSource, Object, Package
from rig.core.errors import ExportFailed, ImportRejected, RigError
from rig.core.files import sync_file, sync_folder
from rig.views import image_files as images

SUFFIX: Final = ".rigcat.zip"
FORMAT: Final = "rigcat"
VERSION: Final = 1
MANIFEST: Final = "rigcat.json"
OBJECTS: Final = "objects.jsonl"

MAX_MEMBERS: Final = 2_000_000
MAX_OBJECTS_BYTES: Final = 1_000_000_000
MAX_LINE_BYTES: Final = 64_000_000
MAX_RATIO: Final = 250
"""Of sizes unpacked and packed; text of records like these reaches 40."""

_DATE: Final = (1980, 1, 1, 0, 0, 0)


def write_bundle(path: Path, objects: Iterable[tuple[Object, dict[str, Path]]]) -> int:
    """Write objects with their files (`collect`) into a new file, whole or not at all, and return how many there are.

    Raises
    ------
    ExportFailed
        The file is there already or cannot be written, or an image is not the one that was stored.
    """
    count = views = 0
    lines = []
    with new_file(path) as file, ZipFile(file, "w") as archive:
        for item, files in objects:
            wanted = {
                name: sha256
                for enrollment in item.enrollments
                for name, sha256 in (
                    *((view.image, view.image_sha256) for view in enrollment.views),
                    *((sitting.reference_image, sitting.reference_image_sha256) for sitting in enrollment.sittings),
                )
                if name is not None
            }
            for name, sha256 in wanted.items():
                archive.writestr(_member(name), checked(files[name], sha256), ZIP_STORED)
            lines.append(item.model_dump_json() + "\n")
            count += 1
            views += sum(len(enrollment.views) for enrollment in item.enrollments)
        text = "".join(lines).encode()
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "objects": count,
            "views": views,
            "objects_sha256": hashlib.sha256(text).hexdigest(),
        }
        archive.writestr(_member(OBJECTS), text, ZIP_DEFLATED)
        archive.writestr(_member(MANIFEST), json.dumps(manifest, indent=1) + "\n", ZIP_STORED)
    return count


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """Have a file to write that gets its name when all of it is on the disk.

    Raises
    ------
    ExportFailed
        It is there already or cannot be written.
    """
    if path.exists():
        raise ExportFailed(f"{path} is there already", next_step="give another name, or remove it")
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            yield file
        sync_file(part)
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise ExportFailed(
            f"{path} cannot be written: {error.strerror or error}",
            next_step="give a path that you may write to, with space on its disk",
        ) from error
    finally:
        with suppress(OSError):
            part.unlink()


def checked(path: Path, sha256: str | None) -> bytes:
    """Return the bytes of an image of the catalog, if it is the one that was stored; else raise `ExportFailed`."""
    mend = "look at the catalog: rig catalog verify --repair"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ExportFailed(f"the image {path} cannot be read: {error.strerror}", next_step=mend) from error
    if images.digest(content) != sha256:
        raise ExportFailed(f"the image {path} is not the one that was stored", next_step=mend)
    return content


def open_bundle(path: Path) -> Package:
    """Read what a bundle says, and check that its images are there; they are read when they are brought in.

    Raises
    ------
    ImportRejected
        It is no bundle, is damaged, of a newer version, or says something that cannot be; nothing was unpacked.
    """
    try:
        with ZipFile(path) as archive:
            members = _members(path, archive)
            objects = _objects(path, archive, members)
    except (BadZipFile, OSError, EOFError, NotImplementedError, ValueError, RuntimeError, zlib.error) as error:
        raise refuse(path, f"it cannot be read: {error}") from error
    return Package(
        str(path),
        objects,
        {name: ImageSource(str(path), name) for name in members if name not in (MANIFEST, OBJECTS)},
        strict=True,
    )


def refuse(path: Path, why: str) -> ImportRejected:
    """Return the error that a bundle is not taken."""
    return ImportRejected(
        f"{path} is not taken: {why}",
        next_step="export the bundle anew where it comes from; do not unpack it by hand if you do not know its origin",
    )


def _member(name: str) -> ZipInfo:
    info = ZipInfo(name, _DATE)
    info.external_attr = (stat.S_IFREG | 0o644) << 16
    info.create_system = 3  # the mode is one of Unix on every computer
    return info


def _members(path: Path, archive: ZipFile) -> dict[str, ZipInfo]:
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise refuse(path, f"{len(infos)} files are in it")
    packed = sum(info.compress_size for info in infos)
    if packed > path.stat().st_size:
        raise refuse(path, "its files overlap")
    members: dict[str, ZipInfo] = {}
    for info in infos:
        name = info.filename
        if info.is_dir() and not info.file_size:
            continue
        if why := _suspicious(info):
            raise refuse(path, f"{name!r} in it {why}")
        if name in members:
            raise refuse(path, f"{name!r} is in it twice")
        members[name] = info
    for name in (MANIFEST, OBJECTS):
        if name not in members:
            raise refuse(path, f"{name} is not in it")
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
        return "would leave the folder"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        return "is a link or a device"
    if info.flag_bits & 0x1:
        return "is encrypted"
    if info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        return "is packed in an unusual way"
    limit = MAX_OBJECTS_BYTES if name in (MANIFEST, OBJECTS) else images.MAX_FILE_BYTES
    if info.file_size > limit:
        return f"has {info.file_size} bytes, more than {limit}"
    if info.file_size > MAX_RATIO * max(info.compress_size, 100):
        return f"grows to {info.file_size} bytes from {info.compress_size}"
    if name not in (MANIFEST, OBJECTS) and pure.parts[0] != images.IMAGE_FOLDER:
        return "is no part of a bundle"
    return ""


def _objects(path: Path, archive: ZipFile, members: dict[str, ZipInfo]) -> tuple[Object, ...]:
    with archive.open(MANIFEST) as file:
        manifest = json.loads(file.read(100_000))
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise refuse(path, f"{MANIFEST} is not that of a bundle")
    version = manifest.get("version")
    if not isinstance(version, int) or version > VERSION:
        raise ImportRejected(
            f"{path} was written by a newer program: its format has version {version}, this program knows {VERSION}",
            next_step="update hbr-rig on this computer",
        )
    found: list[Object] = []
    images_of: set[str] = set()
    digest = hashlib.sha256()
    with archive.open(OBJECTS) as file:
        number = 0
        while line := file.readline(MAX_LINE_BYTES + 1):
            number += 1
            digest.update(line)
            if len(line) > MAX_LINE_BYTES:
                raise refuse(path, f"line {number} of {OBJECTS} is longer than {MAX_LINE_BYTES} bytes")
            found.append(_object(path, number, line))
            images_of |= _images_of(path, number, found[-1], members)
    if digest.hexdigest() != manifest.get("objects_sha256"):
        raise refuse(path, f"{OBJECTS} is not what the bundle was written with")
    if len({item.name for item in found}) < len(found):
        raise refuse(path, "two objects have the same name")
    if unused := sorted(members.keys() - images_of - {MANIFEST, OBJECTS}):
        raise refuse(path, f"{unused[0]!r} in it belongs to no view")
    return tuple(found)


def _object(path: Path, number: int, line: bytes) -> Object:
    try:
        return Object.model_validate_json(line)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise refuse(path, f"line {number} of {OBJECTS}, {where or 'the object'}: {first['msg']}") from error
    except RigError as error:
        raise refuse(path, f"line {number} of {OBJECTS}: {error.what}") from error


def _images_of(path: Path, number: int, item: Object, members: dict[str, ZipInfo]) -> set[str]:
    names: set[str] = set()
    for enrollment in item.enrollments:
        for name, size, sha256 in (
            *((view.image, view.image_bytes, view.image_sha256) for view in enrollment.views),
            *(
                (sitting.reference_image, sitting.reference_image_bytes, sitting.reference_image_sha256)
                for sitting in enrollment.sittings
                if sitting.reference_image is not None
            ),
        ):
            if name in names:
                raise refuse(path, f"line {number} of {OBJECTS}: {name!r} is the image of two views")
            if name not in members or name in (MANIFEST, OBJECTS):
                raise refuse(path, f"line {number} of {OBJECTS}: its image {name!r} is not in it")
            if sha256 is None or size != members[name].file_size:
                raise refuse(path, f"line {number} of {OBJECTS}: {name!r} is not of the size it was stored with")
            names.add(name)
    return names
