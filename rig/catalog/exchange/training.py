"""Exports for training detectors: images with boxes and masks, as COCO or YOLO, split into parts.

The folder of an export is a catalog with the annotations beside it, so an import restores everything.

Decision: docs/decisions/0038.
"""

import json
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.segmentation import Method
from rig.catalog.catalog import Catalog
from rig.catalog.derived import described
from rig.catalog.exchange.new_files import new_folder
from rig.catalog.exchange.tables import Enrolled, enrolled
from rig.catalog.facts import Session, View
from rig.catalog.images import FolderImages, path_of
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.records import Region, this_software
from rig.catalog.transfer import CatalogSource, Item, transfer
from rig.config import ViewConfig
from rig.config.catalog_place import DATABASE_NAME
from rig.core.errors import ExportFailed, UsageError
from rig.core.next_steps import Do
from rig.core.processes import Jobs, map_in_processes
from rig.views.description import BENCH_DESCRIPTOR, ViewDescriber, within
from rig.views.image_files import IMAGE_FOLDER

PARTS: Final = ("train", "val", "test")
Intrinsics = Callable[[Session], Mapping[str, float] | None]
"""Returns the calibrated camera of a session: fx, fy, cx, cy in pixels, k1, k2, p1, p2; None if it is not known."""


class Split(StrEnum):
    """The unit that is divided among the parts: whole objects, or the views of each object."""

    OBJECT = "object"
    VIEW = "view"


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
    region: Region | None
    segmentation: str

    @property
    def file(self) -> str:
        return path_of(self.view.image)


class _Mask(NamedTuple):
    """The object in a view. ``box`` is x, y, width, height in pixels of the frame; None if no object was found."""

    width: int
    height: int
    method: str
    box: tuple[int, int, int, int] | None
    area: int
    counts: list[int]
    polygon: list[list[float]]


_Annotated = tuple[_Picture, _Mask]


def write_training(
    folder: Path,
    source: CatalogSource,
    form: Annotations,
    *,
    split: Split | None = None,
    fractions: Sequence[float] = (0.8, 0.1, 0.1),
    seed: int = 0,
    intrinsics: Intrinsics = lambda _: None,
    jobs: Jobs | None = None,
) -> Generator[JobProgress, None, TrainingExport]:
    """Write the views that searches use as a training set into a new folder, all or nothing.

    Masks are the silhouettes of the descriptors. An image that several views share is annotated once.

    Parameters
    ----------
    split
        None puts all views into the first part.
    fractions
        Share of each part, of at most three: train, val, test.
    seed
        The same seed gives the same parts.

    Raises
    ------
    UsageError
        The fractions are not valid.
    ExportFailed
        The folder is not empty or cannot be written, or there are no views.
    CatalogError
        An image is not the stored one.
    """
    _check_fractions(fractions)
    objects = list(enrolled(source))
    if not objects:
        raise ExportFailed("There are no complete enrollments to export.", next_step=Do.ENROLL())
    parts = list(PARTS[: len(fractions)] if split else PARTS[:1])
    with new_folder(folder) as made:
        # Copy the objects. The images get the permissions of the database: who may enter the folder may read them.
        with Catalog.open(made, clock=source.catalog.clock) as copy:
            (made / DATABASE_NAME).chmod(0o644)
            yield from transfer(CatalogSource(source.catalog, source.names, used_only=True), copy, jobs=jobs)
        # Find the objects in the images, in processes.
        pictures = yield from _pictures(source, objects)
        masks: dict[int, _Mask] = {}
        yield JobProgress(0, len(pictures))
        work = partial(_annotate, made)
        for portion, found in map_in_processes(work, portions(pictures), processes(jobs, len(pictures))):
            masks.update(zip((picture.id for picture in portion), found, strict=True))
            yield JobProgress(len(masks), len(pictures))
        # Write the annotations, in the order of the catalog.
        by_part = _divided([(picture, masks[picture.id]) for picture in pictures], parts, split, fractions, seed)
        items = [item for item, *_ in objects]
        if form is Annotations.COCO:
            _write_coco(made, items, by_part, intrinsics)
        else:
            _write_yolo(made, items, by_part)
    without = sum(mask.box is None for mask in masks.values())
    return TrainingExport(len(objects), {part: len(own) for part, own in by_part.items()}, without)


def _pictures(source: CatalogSource, objects: Sequence[Enrolled]) -> Generator[JobProgress, None, list[_Picture]]:
    """Return the views of objects, with progress in objects. Of several views with the same image it is the first."""
    pictures: dict[str, _Picture] = {}
    for number, (item, enrollment, regions) in enumerate(objects):
        yield JobProgress(number, len(objects))
        evidence = described(source.catalog, enrollment, item.name).segmentation
        for view, region, found in zip(enrollment.views, regions, evidence, strict=True):
            session = enrollment.sessions[view.session]
            picture = _Picture(len(pictures), number, view, session, region, json.dumps(found))
            pictures.setdefault(view.image, picture)
    return list(pictures.values())


def _check_fractions(fractions: Sequence[float]) -> None:
    if not 1 <= len(fractions) <= len(PARTS) or not all(0 <= one <= 1 for one in fractions):
        problem = "are not one to three numbers from 0 to 1"
    elif abs(sum(fractions) - 1) > 1e-6:
        problem = f"have the sum {sum(fractions):g}, not 1"
    else:
        return
    shown = ",".join(f"{one:g}" for one in fractions)
    raise UsageError(f"The fractions {shown} {problem}.", next_step="Give the shares of train, val, test: 0.8,0.1,0.1.")


def _divided(
    annotated: Sequence[_Annotated], parts: Sequence[str], split: Split | None, fractions: Sequence[float], seed: int
) -> dict[str, list[_Annotated]]:
    """Return the views of each part, in their order."""
    divided: dict[str, list[_Annotated]] = {part: [] for part in parts}
    rng = np.random.default_rng(seed)
    of_objects = [list(own) for _, own in groupby(annotated, lambda one: one[0].number)]
    drawn = _drawn(len(of_objects), fractions, rng) if split is Split.OBJECT else [0] * len(of_objects)
    for part, own in zip(drawn, of_objects, strict=True):
        part_of = _drawn(len(own), fractions, rng) if split is Split.VIEW else [part] * len(own)
        for one, number in zip(own, part_of, strict=True):
            divided[parts[number]].append(one)
    return divided


def _drawn(count: int, fractions: Sequence[float], rng: np.random.Generator) -> list[int]:
    """Return the number of a part for each of several things, as close to the fractions as whole numbers can be."""
    ends = np.rint(np.cumsum(fractions) * count).astype(int)
    parts = np.searchsorted(ends, np.arange(count), side="right").clip(max=len(fractions) - 1)
    drawn: list[int] = rng.permutation(parts).tolist()
    return drawn


def _annotate(folder: Path, portion: tuple[_Picture, ...]) -> list[_Mask]:
    """Return where the objects are in images of the catalog in a folder. Runs in a worker process."""
    return [_mask(folder, picture) for picture in portion]


def _mask(folder: Path, picture: _Picture) -> _Mask:
    image = FolderImages(folder).pixels(picture.view.image)
    describer = _describer(folder, picture.region, picture.session.empty_table)
    found = describer.segment(image, json.loads(picture.segmentation))
    height, width = image.shape[:2]
    x0, y0, w, h = picture.region or (0, 0, width, height)
    whole = np.zeros((height, width), np.bool_)
    part = within(whole, picture.region)  # type: ignore[arg-type] # a view of it
    part[:] = found.frame_mask(w, h)
    if found.box is None or not part.any():
        part[:] = True
        return _Mask(width, height, Method.NONE.value, None, int(whole.sum()), _counts(whole), [])
    x, y, box_width, box_height = found.box
    box = (x + x0, y + y0, box_width, box_height)
    polygon = [[px / width, py / height] for px, py in _outline(whole)]
    return _Mask(width, height, found.method.value, box, int(whole.sum()), _counts(whole), polygon)


@lru_cache(maxsize=4)
def _describer(folder: Path, region: Region | None, empty_table: str | None) -> ViewDescriber:
    table = None if empty_table is None else FolderImages(folder).pixels(empty_table)
    return ViewDescriber(ViewConfig(roi=region), (BENCH_DESCRIPTOR,), table)


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


def _write_coco(
    folder: Path, items: Sequence[Item], parts: Mapping[str, Sequence[_Annotated]], intrinsics: Intrinsics
) -> None:
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
        content = {
            **about,
            "images": [_coco_image(picture, mask, intrinsics) for picture, mask in own],
            "annotations": [_coco_annotation(picture, mask) for picture, mask in own],
        }
        text = json.dumps(content, ensure_ascii=False, allow_nan=False)
        (folder / "annotations" / f"instances_{part}.json").write_text(text, encoding="utf-8")


def _coco_image(picture: _Picture, mask: _Mask, intrinsics: Intrinsics) -> dict[str, Any]:
    time = picture.view.captured_utc
    return {
        "id": picture.id + 1,
        "file_name": picture.file,
        "width": mask.width,
        "height": mask.height,
        "date_captured": None if time is None else time.isoformat(),
        "azimuth_deg": picture.view.azimuth_deg,
        "intrinsics": intrinsics(picture.session),
    }


def _coco_annotation(picture: _Picture, mask: _Mask) -> dict[str, Any]:
    return {
        "id": picture.id + 1,
        "image_id": picture.id + 1,
        "category_id": picture.number + 1,
        "bbox": list(mask.box or picture.region or (0, 0, mask.width, mask.height)),
        "area": mask.area,
        "segmentation": {"size": [mask.height, mask.width], "counts": mask.counts},
        "iscrowd": int(mask.box is None),  # a region that trainers and evaluators ignore
        "azimuth_deg": picture.view.azimuth_deg,
        "method": mask.method,
    }


def _write_yolo(folder: Path, items: Sequence[Item], parts: Mapping[str, Sequence[_Annotated]]) -> None:
    for part, own in parts.items():
        labelled = [one for one in own if one[1].box is not None]  # without a label it would count as background
        for picture, mask in labelled:
            file = (folder / "labels" / Path(picture.file).relative_to(IMAGE_FOLDER)).with_suffix(".txt")
            file.parent.mkdir(parents=True, exist_ok=True)
            corners = " ".join(f"{number:.6f}" for corner in mask.polygon for number in corner)
            file.write_text(f"{picture.number} {corners}\n", encoding="utf-8")
        listed = "".join(f"./{picture.file}\n" for picture, _ in labelled)
        (folder / f"{part}.txt").write_text(listed, encoding="utf-8")
    # YAML reads JSON strings; names can contain any character.
    lines = [f"{part}: {part}.txt" for part in parts]
    lines += ["val: train.txt"] if "val" not in parts else []  # trainers need one
    lines += ["names:", *(f"  {number}: {json.dumps(item.name)}" for number, item in enumerate(items))]
    (folder / "data.yaml").write_text("\n".join([*lines, ""]), encoding="utf-8")
