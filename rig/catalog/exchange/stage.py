"""Images on their way into a catalog: checked, copied aside and described, by several processes."""

import os
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

from rig.catalog.describing import known_descriptor
from rig.catalog.exchange.package import ImageSource
from rig.catalog.exchange.plan import Plan
from rig.catalog.records import Region
from rig.catalog.schema import DESCRIPTOR
from rig.config import ViewConfig
from rig.core.errors import UsageError
from rig.views import image_files as images
from rig.views.description import ViewDescriber


class Item(NamedTuple):
    """An image to be staged; ``image`` is its name in the package."""

    image: str
    source: ImageSource
    sha256: str | None
    folder: str
    stem: str
    descriptors: tuple[str, ...] = ()
    region: Region | None = None


class Staged(NamedTuple):
    """An image that is staged as ``file``, or the reason why not; ``packed`` are its levels by each descriptor."""

    file: str
    sha256: str = ""
    size: int = 0
    packed: tuple[tuple[str, bytes], ...] = ()
    segmentation: dict[str, Any] | None = None
    reason: str = ""


def items_of(plan: Plan, further: tuple[str, ...] = ()) -> Iterator[Item]:
    """Yield every image that a plan takes; those of one enrollment go into one folder.

    Views that come without descriptors are described by the paper's and the ``further`` ones.
    """
    wanted = tuple(dict.fromkeys((DESCRIPTOR, *further)))
    sources = plan.package.sources
    for i, item in enumerate(plan.wanted):
        for j, enrollment in enumerate(item.enrollments):
            folder = f"{i}-{j}"
            for view in enrollment.views:
                yield Item(
                    view.image,
                    sources[view.image],
                    view.image_sha256,
                    folder,
                    f"{view.index:03d}",
                    () if view.descriptors else wanted,
                    plan.package.regions.get(view.image),
                )
            for k, sitting in enumerate(enrollment.sittings):
                image, sha256 = sitting.reference_image, sitting.reference_image_sha256
                if image is not None:
                    yield Item(image, sources[image], sha256, folder, f"empty-{k:03d}")


def stage(root: Path | None, portion: tuple[Item, ...]) -> list[Staged]:
    """Check images, and copy them into ``root`` and describe them unless it is None; the work of a process."""
    return [_stage_one(root, item) for item in portion]


def _stage_one(root: Path | None, item: Item) -> Staged:
    try:
        content = _read(item.source)
        image = images.decode(content)
    except images.BadImage as error:
        return Staged("", reason=str(error))
    except (OSError, BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, zlib.error) as error:
        return Staged("", reason=f"cannot be read: {error}")
    sha256 = images.digest(content)
    if item.sha256 is not None and sha256 != item.sha256:
        return Staged("", reason="is not the image that was stored")
    if root is None:
        return Staged("", sha256, len(content))
    packed, segmentation = [], None
    if item.descriptors:
        try:
            described = ViewDescriber(ViewConfig(roi=item.region), item.descriptors)(image)
        except UsageError as error:
            return Staged("", reason=error.what)
        except ValueError as error:
            return Staged("", reason=str(error))
        packed = [(name, known_descriptor(name).pack(levels)) for name, levels in described.levels.items()]
        segmentation = described.segmentation
    file = f"{item.folder}/{item.stem}{images.suffix(content)}"
    try:
        (root / file).write_bytes(content)
    except FileNotFoundError:
        (root / item.folder).mkdir(exist_ok=True)
        (root / file).write_bytes(content)
    return Staged(file, sha256, len(content), tuple(packed), segmentation)


def _read(source: ImageSource) -> bytes:
    if source.member is None:
        with Path(source.file).open("rb") as file:
            # a limit far above the size would have as much memory set aside
            return file.read(min(os.fstat(file.fileno()).st_size, images.MAX_FILE_BYTES) + 1)
    with _archive(source.file).open(source.member) as member:
        return member.read(images.MAX_FILE_BYTES + 1)


@cache
def _archive(file: str) -> ZipFile:
    return ZipFile(file)
