"""Exports for training detectors: images with boxes and masks, as COCO or YOLO, split into parts.

The folder of an export is a catalog with the annotations beside it, so an import restores everything.

Decision: docs/decisions/0011.
"""

import json
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.segmentation import BoxMethod
from rig.catalog.catalog import Catalog
from rig.catalog.describing import described, silhouette
from rig.catalog.exchange.new_files import new_folder
from rig.catalog.facts import Session, View
from rig.catalog.images import Images, path_of
from rig.catalog.jobs import JobProgress, processes
from rig.catalog.records import this_software
from rig.catalog.transfer import CatalogSource, TransferItem, transfer
from rig.config.catalog_place import DATABASE_NAME
from rig.core.errors import ExportFailed
from rig.core.next_steps import Do
from rig.core.processes import map_in_processes
from rig.views.description import within
from rig.views.image_files import IMAGE_FOLDER

PARTS: Final = ("train", "val", "test")
_PART_OF: Final = {4: "val", 9: "test"}
"""By the last digit of the index of a view: neighbouring views are similar, so the parts are spread over the object."""


class Annotations(StrEnum):
    """Format of the annotations."""

    COCO = "coco"
    YOLO = "yolo"


@dataclass(frozen=True, slots=True)
class TrainingExport:
    """Number of objects, of views in each part, and of views in which no object was found."""

    objects: int
    views: dict[str, int]
    without_mask: int


class _Picture(NamedTuple):
    """A view of the object of this number, both numbered from 0, with its stored segmentation as JSON."""

    id: int
    number: int
    view: View
    session: Session
    segmentation: str


class _Mask(NamedTuple):
    """The object in a view. ``box`` is x, y, width, height in pixels of the frame; None if no object was found."""

    width: int
    height: int
    method: str
    box: tuple[int, int, int, int] | None
    counts: list[int]
    polygon: list[list[float]]


_Annotated = tuple[_Picture, _Mask]
_Parts = Mapping[str, Sequence[_Annotated]]


def write_training(
    folder: Path,
    source: CatalogSource,
    form: Annotations,
    *,
    jobs: int | None = None,
) -> Generator[JobProgress, None, TrainingExport]:
    """Write the views that searches use as a training set into a new folder, all or nothing.

    Masks are the silhouettes of the descriptors. An image that several views share is annotated once. Of ten views of
    an object in a row, one is for validation and one for the test.

    Raises `ExportFailed`: the folder is not empty or cannot be written, or there are no views.
    """
    items = list(source.items())
    if not items:
        raise ExportFailed("There are no complete enrollments to export.", next_step=Do.ENROLL())
    with new_folder(folder) as made:
        # Copy the objects. The images get the permissions of the database: who may enter the folder may read them.
        with Catalog.open(made, clock=source.catalog.clock) as copy:
            (made / DATABASE_NAME).chmod(0o644)
            yield from transfer(source, copy, jobs=jobs)
        # Describe the views that are not described yet. Of several views with the same image the first is used.
        pictures: dict[str, _Picture] = {}
        for number, item in enumerate(items):
            yield JobProgress(number, len(items))
            enrollment = item.enrollment
            evidence = described(source.catalog.database, enrollment, item.name).segmentation
            for view, found in zip(enrollment.views, evidence, strict=True):
                own = (number, view, enrollment.sessions[view.session], json.dumps(found))
                pictures.setdefault(view.image, _Picture(len(pictures), *own))
        # Find the objects in the images, in processes.
        masks: dict[int, _Mask] = {}
        work = partial(_mask, Images(made))
        for picture, mask in map_in_processes(work, pictures.values(), processes(jobs, len(pictures))):
            masks[picture.id] = mask
            yield JobProgress(len(masks), len(pictures))
        # Write the annotations, in the order of the catalog.
        parts: dict[str, list[_Annotated]] = {part: [] for part in PARTS}
        for picture in pictures.values():
            parts[_PART_OF.get(picture.view.index % 10, "train")].append((picture, masks[picture.id]))
        if form is Annotations.COCO:
            _write_coco(made, items, parts)
        else:
            _write_yolo(made, items, parts)
    without = sum(mask.box is None for mask in masks.values())
    return TrainingExport(len(items), {part: len(own) for part, own in parts.items()}, without)


# Masks


def _mask(images: Images, picture: _Picture) -> _Mask:
    """Return where the object is in a picture. Runs in a worker process."""
    whole, found = silhouette(images, picture.view, picture.session, json.loads(picture.segmentation))
    height, width = whole.shape
    x0, y0, *_ = picture.view.region or (0, 0)
    if found.box is None or not whole.any():
        within(whole, picture.view.region)[:] = True
        return _Mask(width, height, BoxMethod.NONE.value, None, _counts(whole), [])
    x, y, box_width, box_height = found.box
    polygon = [[px / width, py / height] for px, py in _outline(whole)]
    box = (x + x0, y + y0, box_width, box_height)
    return _Mask(width, height, found.method.value, box, _counts(whole), polygon)


def _counts(mask: NDArray[np.bool_]) -> list[int]:
    """Return the run lengths of a mask by columns, beginning with those outside the object: COCO's RLE."""
    flat = mask.ravel(order="F")
    ends = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff([0, *ends.tolist(), flat.size]).tolist()
    return [0, *counts] if flat[0] else counts


def _outline(mask: NDArray[np.bool_]) -> list[list[int]]:
    """Return the corners of the largest part of a mask, in pixels, at least three."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    largest = max(contours, key=cv2.contourArea)
    corners: list[list[int]] = largest[:, 0].tolist()
    return corners if len(corners) > 2 else cv2.boxPoints(cv2.minAreaRect(largest)).tolist()


# Files


def _write_coco(folder: Path, items: Sequence[TransferItem], parts: _Parts) -> None:
    about = {
        "info": {
            "description": "Views of objects on a turntable. The masks were computed from the images. If no object was "
            "found, the whole region is a crowd.",
            "version": this_software(),
        },
        "licenses": [],
        "categories": [
            {"id": number, "name": item.name, "supercategory": item.label or "object"}
            for number, item in enumerate(items, 1)
        ],
    }
    (folder / "annotations").mkdir()
    for part, own in parts.items():
        images = [
            {
                "id": picture.id + 1,
                "file_name": path_of(picture.view.image),
                "width": mask.width,
                "height": mask.height,
                "date_captured": picture.view.captured_utc and picture.view.captured_utc.isoformat(),
                "azimuth_deg": picture.view.azimuth_deg,
            }
            for picture, mask in own
        ]
        annotations = [
            {
                "id": picture.id + 1,
                "image_id": picture.id + 1,
                "category_id": picture.number + 1,
                "bbox": list(mask.box or picture.view.region or (0, 0, mask.width, mask.height)),
                "area": sum(mask.counts[1::2]),
                "segmentation": {"size": [mask.height, mask.width], "counts": mask.counts},
                "iscrowd": int(mask.box is None),  # a region that trainers and evaluators ignore
                "azimuth_deg": picture.view.azimuth_deg,
                "method": mask.method,
            }
            for picture, mask in own
        ]
        content = {**about, "images": images, "annotations": annotations}
        text = json.dumps(content, ensure_ascii=False, allow_nan=False)
        (folder / "annotations" / f"instances_{part}.json").write_text(text, encoding="utf-8")


def _write_yolo(folder: Path, items: Sequence[TransferItem], parts: _Parts) -> None:
    for part, own in parts.items():
        listed = ""
        for picture, mask in own:
            if mask.box is None:
                continue  # without a label it would count as background
            image = path_of(picture.view.image)
            file = (folder / "labels" / Path(image).relative_to(IMAGE_FOLDER)).with_suffix(".txt")
            file.parent.mkdir(parents=True, exist_ok=True)
            corners = " ".join(f"{number:.6f}" for corner in mask.polygon for number in corner)
            file.write_text(f"{picture.number} {corners}\n", encoding="utf-8")
            listed += f"./{image}\n"
        (folder / f"{part}.txt").write_text(listed, encoding="utf-8")
    # YAML reads JSON strings; names can contain any character.
    used = [part for part, own in parts.items() if own or part == "val"]  # trainers need a file of this name with views
    lines = [f"{part}: {part if parts[part] else 'train'}.txt" for part in used]
    lines += ["names:", *(f"  {number}: {json.dumps(item.name)}" for number, item in enumerate(items))]
    (folder / "data.yaml").write_text("\n".join([*lines, ""]), encoding="utf-8")
