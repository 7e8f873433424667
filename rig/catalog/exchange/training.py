"""Exports for training detectors: images with boxes and masks, as COCO or YOLO, split into parts.

The folder of an export is an unpacked bundle with the annotations beside it, so an import restores everything.

Decision: docs/decisions/0038.
"""

import json
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.segmentation import Method
from rig.catalog.exchange.batch import Enrollment, ExportedObject, Object, Session, View, region_of_view
from rig.catalog.exchange.bundle import MANIFEST, OBJECTS, images_of, index_of, read_stored
from rig.catalog.exchange.new_folder import new_folder
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.records import EnrollmentStatus, Region, this_software
from rig.config import ViewConfig
from rig.core.errors import ExportFailed, UsageError
from rig.core.next_steps import Do
from rig.core.processes import Jobs, map_in_processes
from rig.views import image_files as images
from rig.views.description import BENCH_DESCRIPTOR, ViewDescriber, within

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


class _Item(NamedTuple):
    """A view to be annotated: its image and its empty-table image as files, with their SHA-256."""

    image: str
    file: str
    sha256: str
    region: Region | None
    empty_table: tuple[str, str] | None
    segmentation: str


class _Mask(NamedTuple):
    """The object in a view. ``box`` is x, y, width, height in pixels of the frame; None if no object was found."""

    width: int
    height: int
    method: str
    box: tuple[int, int, int, int] | None
    area: int
    counts: list[int]
    polygon: list[list[float]]


def write_training(
    folder: Path,
    objects: Sequence[ExportedObject],
    form: Annotations,
    *,
    split: Split | None = None,
    fractions: Sequence[float] = (0.8, 0.1, 0.1),
    seed: int = 0,
    intrinsics: Intrinsics = lambda _: None,
    jobs: Jobs | None = None,
) -> Generator[JobProgress, None, TrainingExport]:
    """Write the views that searches use as a training set into a new folder, all or nothing.

    Masks are those of the descriptors: the stored silhouettes, or computed from the stored images.

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
        The folder is not empty or cannot be written, there are no views, or an image is not the stored one.
    """
    _check_fractions(fractions)
    complete = [(_complete(item), files) for item, files in objects]
    complete = [(item, files) for item, files in complete if item.enrollments]
    if not complete:
        raise ExportFailed("There are no complete enrollments to export.", next_step=Do.ENROLL())
    kept = [item for item, _ in complete]
    items = [one for item, files in complete for one in _items(item, files)]
    part_of = _divided(kept, split, fractions, seed)
    parts = list(PARTS[: len(fractions)] if split else PARTS[:1])
    with new_folder(folder) as made:
        # Copy the images and find the objects, in processes.
        found: dict[str, _Mask] = {}
        yield JobProgress(0, len(items))
        work = partial(_annotate, made)
        for portion, masks_of in map_in_processes(work, portions(items), processes(jobs, len(items))):
            found.update(zip((item.image for item in portion), masks_of, strict=True))
            yield JobProgress(len(found), len(items))
        masks = {item.image: found[item.image] for item in items}  # in the order of the catalog
        for item, files in complete:
            for name, sha256 in images_of(item).items():
                if name not in masks:
                    (made / name).write_bytes(read_stored(files[name], sha256))
        # Write the annotations, and the files for an import.
        write = _write_coco if form is Annotations.COCO else _write_yolo
        names_of = {part: [name for name in masks if part_of[name] == part] for part in parts}
        write(made, kept, masks, names_of, intrinsics)
        text, manifest = index_of(kept)
        (made / OBJECTS).write_bytes(text)
        (made / MANIFEST).write_bytes(manifest)
    used = list(part_of.values())
    without = sum(mask.box is None for mask in masks.values())
    return TrainingExport(len(kept), {part: used.count(part) for part in parts}, without)


def _check_fractions(fractions: Sequence[float]) -> None:
    if not 1 <= len(fractions) <= len(PARTS) or not all(0 <= one <= 1 for one in fractions):
        problem = "are not one to three numbers from 0 to 1"
    elif abs(sum(fractions) - 1) > 1e-6:
        problem = f"have the sum {sum(fractions):g}, not 1"
    else:
        return
    shown = ",".join(f"{one:g}" for one in fractions)
    raise UsageError(f"The fractions {shown} {problem}.", next_step="Give the shares of train, val, test: 0.8,0.1,0.1.")


def _complete(item: Object) -> Object:
    used = tuple(one for one in item.enrollments if one.status == EnrollmentStatus.COMPLETE)
    return item.model_copy(update={"enrollments": used})


def _views(item: Object) -> list[tuple[Enrollment, View]]:
    return [(enrollment, view) for enrollment in item.enrollments for view in enrollment.views]


def _items(item: Object, files: Mapping[str, Path]) -> list[_Item]:
    found = []
    for enrollment, view in _views(item):
        session = enrollment.sessions[view.session]
        table, sha256 = session.empty_table_image, session.empty_table_image_sha256
        empty_table = None if table is None or sha256 is None else (str(files[table]), sha256)
        assert view.image_sha256 is not None  # read from a catalog
        evidence = json.dumps(view.segmentation)
        file = str(files[view.image])
        found.append(_Item(view.image, file, view.image_sha256, region_of_view(view), empty_table, evidence))
    return found


def _divided(items: Sequence[Object], split: Split | None, fractions: Sequence[float], seed: int) -> dict[str, str]:
    """Return the part of each image."""
    by_object = [[view.image for _, view in _views(item)] for item in items]
    if split is None:
        return {name: PARTS[0] for names in by_object for name in names}
    rng = np.random.default_rng(seed)
    if split is Split.OBJECT:
        parts = _drawn(len(by_object), fractions, rng)
        return {name: part for names, part in zip(by_object, parts, strict=True) for name in names}
    return {
        name: part for names in by_object for name, part in zip(names, _drawn(len(names), fractions, rng), strict=True)
    }


def _drawn(count: int, fractions: Sequence[float], rng: np.random.Generator) -> list[str]:
    """Return a part for each of several things, as close to the fractions as whole numbers can be."""
    ends = np.rint(np.cumsum(fractions) * count).astype(int)
    parts = np.searchsorted(ends, np.arange(count), side="right").clip(max=len(fractions) - 1)
    return [PARTS[part] for part in rng.permutation(parts).tolist()]


def _annotate(folder: Path, portion: tuple[_Item, ...]) -> list[_Mask]:
    """Copy images into a folder, and return where the objects are in them. Runs in a worker process."""
    found = []
    for item in portion:
        content = read_stored(Path(item.file), item.sha256)
        (folder / item.image).parent.mkdir(parents=True, exist_ok=True)
        (folder / item.image).write_bytes(content)
        found.append(_mask(item, images.decode(content)))
    return found


def _mask(item: _Item, image: NDArray[np.uint8]) -> _Mask:
    found = _describer(item.region, item.empty_table).segment(image, json.loads(item.segmentation))
    height, width = image.shape[:2]
    x0, y0, w, h = item.region or (0, 0, width, height)
    whole = np.zeros((height, width), np.bool_)
    part = within(whole, item.region)  # type: ignore[arg-type] # a view of it
    part[:] = found.frame_mask(w, h)
    if found.box is None or not part.any():
        part[:] = True
        return _Mask(width, height, Method.NONE.value, None, int(whole.sum()), _counts(whole), [])
    x, y, box_width, box_height = found.box
    box = (x + x0, y + y0, box_width, box_height)
    polygon = [[px / width, py / height] for px, py in _outline(whole)]
    return _Mask(width, height, found.method.value, box, int(whole.sum()), _counts(whole), polygon)


@lru_cache(maxsize=4)
def _describer(region: Region | None, empty_table: tuple[str, str] | None) -> ViewDescriber:
    table = None if empty_table is None else images.decode(read_stored(Path(empty_table[0]), empty_table[1]))
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
    folder: Path,
    items: Sequence[Object],
    masks: Mapping[str, _Mask],
    parts: Mapping[str, Sequence[str]],
    intrinsics: Intrinsics,
) -> None:
    categories = [
        {"id": number, "name": item.name, "supercategory": item.label or "object"}
        for number, item in enumerate(items, 1)
    ]
    pictures: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
    for number, item in enumerate(items, 1):
        for enrollment, view in _views(item):
            session = enrollment.sessions[view.session]
            mask, image_id = masks[view.image], len(pictures) + 1
            time = view.captured_utc
            picture = {
                "id": image_id,
                "file_name": view.image,
                "width": mask.width,
                "height": mask.height,
                "date_captured": None if time is None else time.isoformat(),
                "azimuth_deg": view.azimuth_deg,
                "intrinsics": intrinsics(session),
            }
            x, y, w, h = mask.box or region_of_view(view) or (0, 0, mask.width, mask.height)
            annotation = {
                "id": image_id,
                "image_id": image_id,
                "category_id": number,
                "bbox": [x, y, w, h],
                "area": mask.area,
                "segmentation": {"size": [mask.height, mask.width], "counts": mask.counts},
                "iscrowd": int(mask.box is None),  # a region that trainers and evaluators ignore
                "azimuth_deg": view.azimuth_deg,
                "method": mask.method,
            }
            pictures[view.image] = picture, annotation
    (folder / "annotations").mkdir()
    info = {
        "description": "Views of objects on a turntable. The masks were computed from the images. If no object was "
        "found, the whole region is a crowd.",
        "version": this_software(),
    }
    for part, names in parts.items():
        content = {
            "info": info,
            "licenses": [],
            "images": [pictures[name][0] for name in names],
            "annotations": [pictures[name][1] for name in names],
            "categories": categories,
        }
        text = json.dumps(content, ensure_ascii=False, allow_nan=False)
        (folder / "annotations" / f"instances_{part}.json").write_text(text, encoding="utf-8")


def _write_yolo(
    folder: Path,
    items: Sequence[Object],
    masks: Mapping[str, _Mask],
    parts: Mapping[str, Sequence[str]],
    intrinsics: Intrinsics,  # noqa: ARG001
) -> None:
    classes = {view.image: number for number, item in enumerate(items) for _, view in _views(item)}
    for name, mask in masks.items():
        if mask.box is None:
            continue  # without a label the object would count as background
        file = (folder / "labels" / Path(name).relative_to(images.IMAGE_FOLDER)).with_suffix(".txt")
        file.parent.mkdir(parents=True, exist_ok=True)
        corners = " ".join(f"{part:.6f}" for corner in mask.polygon for part in corner)
        file.write_text(f"{classes[name]} {corners}\n", encoding="utf-8")
    # YAML reads JSON strings; names can contain any character.
    lines = [f"{part}: {part}.txt" for part in parts]
    lines += ["val: train.txt"] if "val" not in parts else []  # trainers need one
    lines += ["names:", *(f"  {number}: {json.dumps(item.name)}" for number, item in enumerate(items))]
    (folder / "data.yaml").write_text("\n".join([*lines, ""]), encoding="utf-8")
    for part, names in parts.items():
        text = "".join(f"./{name}\n" for name in names if masks[name].box is not None)
        (folder / f"{part}.txt").write_text(text, encoding="utf-8")
