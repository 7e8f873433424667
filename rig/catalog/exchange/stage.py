"""Stage images for an import: check, copy and describe them, in several processes."""

import json
import os
import zlib
from collections.abc import Iterator
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from hbr.descriptors import descriptor
from rig.catalog.describing import is_current, matches, pack, region_of
from rig.catalog.exchange.batch import ImageSource, ImportProblem, Reason, Session
from rig.catalog.exchange.plan import Plan
from rig.catalog.places import file_mode, folder_mode
from rig.catalog.records import PackedDescriptor, Region
from rig.config import ViewConfig
from rig.core.errors import CatalogError, UsageError
from rig.core.files import open_new
from rig.views import image_files as images
from rig.views.description import PAPER_DESCRIPTOR, ViewDescriber

_READ_ERRORS = (OSError, BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, zlib.error)


class Item(NamedTuple):
    """An image to be staged; ``image`` is its name in the batch."""

    image: str
    source: ImageSource
    sha256: str | None
    folder: str
    stem: str
    descriptors: tuple[str, ...] = ()
    region: Region | None = None
    given: tuple[PackedDescriptor, ...] = ()
    """Descriptors that came with the image, to be compared with those of the image."""
    empty_table: tuple[ImageSource, str | None] | None = None
    segmentation: str = "null"
    """The evidence that came with the image, as JSON."""


class StagedImage(NamedTuple):
    """An image that is staged as ``file`` with its descriptors, or the reason for its rejection."""

    file: str
    sha256: str = ""
    size: int = 0
    packed: tuple[PackedDescriptor, ...] = ()
    segmentation: dict[str, Any] | None = None
    reason: Reason | None = None


def items_of(plan: Plan, descriptors: tuple[str, ...] = ()) -> Iterator[Item]:
    """Yield every image of a plan. Those of one enrollment go into one folder.

    Views without descriptors are described by the paper's descriptor and by ``descriptors``.
    """
    wanted = tuple(dict.fromkeys((PAPER_DESCRIPTOR, *descriptors)))
    batch = plan.batch
    for i, item in enumerate(plan.wanted):
        for j, enrollment in enumerate(item.enrollments):
            folder = f"{i}-{j}"
            for view in enrollment.views:
                yield Item(
                    view.image,
                    batch.sources[view.image],
                    view.image_sha256,
                    folder,
                    f"{view.index:03d}",
                    () if view.descriptors else wanted,
                    batch.regions.get(view.image),
                    tuple(one.as_packed() for one in view.descriptors if is_current(one.name, one.version)),
                    _empty_table(plan, enrollment.sessions[view.session]),
                    json.dumps(view.segmentation),
                )
            for k, session in enumerate(enrollment.sessions):
                image, sha256 = session.empty_table_image, session.empty_table_image_sha256
                if image is not None:
                    yield Item(image, batch.sources[image], sha256, folder, f"empty-{k:03d}")


def _empty_table(plan: Plan, session: Session) -> tuple[ImageSource, str | None] | None:
    image = session.empty_table_image
    return None if image is None else (plan.batch.sources[image], session.empty_table_image_sha256)


def stage(root: Path | None, portion: tuple[Item, ...]) -> list[StagedImage]:
    """Check images; if ``root`` is not None, copy them there and describe them. Runs in a worker process."""
    mode = 0 if root is None else file_mode(root.parent.parent)  # of the catalog that the images will belong to
    return [_stage_one(root, item, mode) for item in portion]


def _stage_one(root: Path | None, item: Item, mode: int) -> StagedImage:
    try:
        content = _read(item.source)
        image = images.decode(content)
    except images.BadImage as error:
        return _rejected(ImportProblem.INVALID_IMAGE, error=str(error))
    except _READ_ERRORS as error:
        return _rejected(ImportProblem.UNREADABLE, error=str(error))
    sha256 = images.digest(content)
    if item.sha256 is not None and sha256 != item.sha256:
        return _rejected(ImportProblem.OTHER_IMAGE)
    for given in item.given:
        if wrong := _check_descriptor(given, image, item):
            return wrong
    if root is None:
        return StagedImage("", sha256, len(content))
    packed: list[PackedDescriptor] = []
    segmentation = None
    if item.descriptors:
        try:
            described = ViewDescriber(ViewConfig(roi=item.region), item.descriptors)(image)
        except (UsageError, ValueError) as error:
            return _rejected(ImportProblem.NOT_DESCRIBED, error=str(error))
        packed = pack(described.levels, item.region)
        segmentation = described.segmentation
    file = f"{item.folder}/{item.stem}{images.suffix(content)}"
    (root / item.folder).mkdir(mode=folder_mode(mode), exist_ok=True)
    with open_new(root / file, mode=mode) as staged:
        staged.write(content)
    return StagedImage(file, sha256, len(content), tuple(packed), segmentation)


def _rejected(code: ImportProblem, **values: Any) -> StagedImage:
    return StagedImage("", reason=Reason(code, values))


def _check_descriptor(given: PackedDescriptor, image: NDArray[np.uint8], item: Item) -> StagedImage | None:
    """Return a rejected image if the descriptor is not that of the image, or if that cannot be checked."""
    kind = descriptor(given.name)
    try:
        table = None if item.empty_table is None or kind.whole_image else _table(*item.empty_table)
        config = ViewConfig(roi=region_of(given.settings))
        levels = ViewDescriber(config, (given.name,), table)(image, json.loads(item.segmentation)).levels[given.name]
    except (CatalogError, UsageError, ValueError, *_READ_ERRORS) as error:
        return _rejected(ImportProblem.DESCRIPTOR_NOT_CHECKED, name=given.name, error=str(error))
    return None if matches(kind, given.packed, levels) else _rejected(ImportProblem.OTHER_DESCRIPTOR, name=given.name)


@lru_cache(maxsize=4)
def _table(source: ImageSource, sha256: str | None) -> NDArray[np.uint8]:
    content = _read(source)
    if images.digest(content) != sha256:
        raise ValueError("the empty-table image is not the stored one")
    return images.decode(content)


def _read(source: ImageSource) -> bytes:
    if source.member is None:
        with Path(source.file).open("rb") as file:
            # read() allocates its limit at once, so the limit is the size of the file
            return file.read(min(os.fstat(file.fileno()).st_size, images.MAX_FILE_BYTES) + 1)
    with _archive(source.file).open(source.member) as member:
        return member.read(images.MAX_FILE_BYTES + 1)


@cache
def _archive(file: str) -> ZipFile:
    return ZipFile(file)
