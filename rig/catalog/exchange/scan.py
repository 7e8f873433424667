"""Scans for reconstruction programs: images of one object with the pose of the camera, masks, and EXIF.

The pose of a view follows from its azimuth, and from the calibrations of the camera and of the table's axis that were
in force when it was taken. The frame of a scan is fixed to the object: millimetres, z up along the table's axis, and
seen from azimuth 0° x to the right and y away from the camera. Its origin is the middle of the platter.
"""

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from math import cos, radians, sin
from pathlib import Path
from typing import Any, Final, NamedTuple
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rig.calibrations import CalibrationResult
from rig.calibrations.store import CALIBRATIONS
from rig.catalog.describing import described, silhouette
from rig.catalog.exchange.new_files import new_folder
from rig.catalog.facts import Session, View
from rig.catalog.transfer import CatalogSource
from rig.core.errors import ExportFailed
from rig.core.next_steps import Do
from rig.views.description import within

MASKS, IMAGES = "masks", "images"
_OWN: Final = 0x8769
"""Tag that points to the directory of EXIF."""
_TO_OPENGL: Final = np.diag([1.0, -1.0, -1.0, 1.0])
"""Nerfstudio's camera has y up and looks along -z."""
_FILM_MM: Final = 36.0
"""Width of the film for which EXIF states the focal length: the true size of the sensor is not known."""


class ScanFormat(StrEnum):
    """Format of the poses."""

    COLMAP = "colmap"
    NERFSTUDIO = "nerfstudio"


class _Posed(NamedTuple):
    """A view, its file, the size of the frame, the lens as in `_Camera`, and the pose (4, 4): object to camera."""

    name: str
    size: tuple[int, int]
    lens: tuple[float, ...]
    pose: NDArray[np.float64]


def write_scan(folder: Path, source: CatalogSource, form: ScanFormat, results: Iterable[CalibrationResult]) -> int:
    """Write the views of one object with their poses into a new folder, all or nothing, and return the number of views.

    ``results`` are the stored calibrations of the bench.

    Raises `ExportFailed`: it is not one object, its views have no calibration of the camera or of the axis, or the
    folder is not empty or cannot be written.
    """
    items = list(source.items())
    if len(items) != 1:
        raise ExportFailed(
            f"A scan has one object, but {len(items)} were chosen.", next_step="Name one object after the folder."
        )
    (item,) = items
    images = source.catalog.database.images
    known = {result.id: result for result in results}
    evidence = described(source.catalog.database, item.enrollment, item.name).segmentation
    posed = []
    with new_folder(folder) as made:
        (made / IMAGES).mkdir()
        (made / MASKS).mkdir()
        for view, found in zip(item.enrollment.views, evidence, strict=True):
            session = item.enrollment.sessions[view.session]
            camera = _camera(session, known, item.name)
            mask, _ = silhouette(images, view, session, found)
            if not mask.any():  # no object was found: the whole region may show it
                within(mask, view.region)[:] = True
            if camera.size != mask.shape[::-1]:
                raise ExportFailed(
                    f"View {view.index} has {mask.shape[1]} × {mask.shape[0]} pixels, but the camera was calibrated "
                    f"with {camera.size[0]} × {camera.size[1]}.",
                    next_step=(Do.CALIBRATE(name="camera"), Do.ENROLL_AGAIN()),
                )
            one = _Posed(f"{view.index:03}.png", camera.size, camera.lens, camera.pose(view.azimuth_deg))
            exif = exif_of(item.name, view, session, camera)
            (made / IMAGES / one.name).write_bytes(with_exif(_png(images.content(view.image), view.image), exif))
            (made / MASKS / f"{one.name}.png").write_bytes(_encoded(mask.astype(np.uint8) * np.uint8(255)))
            posed.append(one)
        if form is ScanFormat.COLMAP:
            _write_colmap(made / "sparse" / "0", posed)
        else:
            (made / "transforms.json").write_text(json.dumps(_transforms(posed), indent=1), encoding="utf-8")
    return len(posed)


@dataclass(frozen=True, slots=True)
class _Camera:
    """The calibrated camera, and the table's axis in its frame: the middle of the platter and the direction up.

    ``lens`` are fx, fy, cx, cy, k1, k2, p1, p2 as they were fitted together with the axis. Pixel (0, 0) is the middle
    of the first pixel.
    """

    size: tuple[int, int]
    lens: tuple[float, ...]
    platter_mm: NDArray[np.float64]
    up: NDArray[np.float64]

    def pose(self, azimuth_deg: float) -> NDArray[np.float64]:
        """Return the pose (4, 4) of the object in the camera's frame; the table has the angle −``azimuth_deg``."""
        right = np.cross([0.0, 0.0, 1.0], self.up)
        right /= np.linalg.norm(right)
        c, s = cos(radians(-azimuth_deg)), sin(radians(-azimuth_deg))
        about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([right, np.cross(self.up, right), self.up]) @ about
        pose[:3, 3] = self.platter_mm
        return pose


def _camera(session: Session, known: dict[str, CalibrationResult], name: str) -> _Camera:
    """Return the camera as it was calibrated when the session began."""
    in_force = {str(one).partition("@")[0]: str(one) for one in session.provenance.conditions.get(CALIBRATIONS) or ()}
    lens, axis = (known.get(in_force.get(kind, "")) for kind in ("camera.intrinsics", "table.axis"))
    if lens is None or axis is None:
        missing = "camera" if lens is None else "table"
        raise ExportFailed(
            f"{name!r} was enrolled without the calibration {missing!r}, or its result is not stored here. So the "
            "poses of its views are not known.",
            next_step=(Do.CALIBRATE(name=missing), Do.ENROLL_AGAIN()),
            evidence={"calibrations of the enrollment": list(in_force.values())},
        )
    value = {one: estimate.value for one, estimate in axis.estimates.items()}
    up = np.array([value["ux"], value["uy"], value["uz"]])
    up /= np.linalg.norm(up)
    width, height = lens.evidence["size"]
    platter = np.array([value["x"], value["y"], value["z"]]) - up * axis.evidence["room"]["board_mm"]
    return _Camera((width, height), tuple(axis.evidence["lens"]), platter, up)


# Poses


def _colmap_lens(one: _Posed) -> list[float]:
    """Return the lens as COLMAP and Nerfstudio count: the middle of the first pixel is (0.5, 0.5)."""
    fx, fy, cx, cy, *distortion = one.lens
    return [fx, fy, cx + 0.5, cy + 0.5, *distortion]


def _write_colmap(folder: Path, posed: list[_Posed]) -> None:
    folder.mkdir(parents=True)
    cameras: dict[tuple[Any, ...], int] = {}
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points, of which there are none"]
    for number, one in enumerate(posed, 1):
        x, y, z, w = Rotation.from_matrix(one.pose[:3, :3]).as_quat()
        camera = cameras.setdefault((*one.size, *_colmap_lens(one)), len(cameras) + 1)
        pose = " ".join(f"{value:.12g}" for value in (w, x, y, z, *one.pose[:3, 3]))
        images += [f"{number} {pose} {camera} {one.name}", ""]
    known = [f"{camera} OPENCV {' '.join(f'{v:.12g}' for v in values)}" for values, camera in cameras.items()]
    for name, lines in (("cameras", known), ("images", images), ("points3D", [])):
        (folder / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def _transforms(posed: list[_Posed]) -> dict[str, Any]:
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    frames = [
        {
            "file_path": f"{IMAGES}/{one.name}",
            "mask_path": f"{MASKS}/{one.name}.png",
            "w": one.size[0],
            "h": one.size[1],
            **dict(zip(names, _colmap_lens(one), strict=True)),
            "transform_matrix": (np.linalg.inv(one.pose) @ _TO_OPENGL).tolist(),
        }
        for one in posed
    ]
    return {"camera_model": "OPENCV", "frames": frames}


# Images


def _png(content: bytes, name: str) -> bytes:
    """Return an image as PNG, with the same pixels."""
    if name.endswith(".png"):
        return content
    return _encoded(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))


def _encoded(pixels: Any) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def with_exif(png: bytes, exif: bytes) -> bytes:
    """Return a PNG with these EXIF data, in front of its pixels (PNG 3, chunk eXIf)."""
    header = 8 + 25  # signature and IHDR
    chunk = b"eXIf" + exif
    return png[:header] + struct.pack(">I", len(exif)) + chunk + struct.pack(">I", crc32(chunk)) + png[header:]


def exif_of(name: str, view: View, session: Session, camera: _Camera) -> bytes:
    """Return EXIF 2.3: the camera, its focal length for film of 36 mm, the object, the azimuth and the time."""
    model = str(session.provenance.devices.get("camera", {}).get("name", "unknown"))
    focal_mm = camera.lens[0] * _FILM_MM / camera.size[0]
    taken = "" if view.captured_utc is None else f"{view.captured_utc:%Y:%m:%d %H:%M:%S}"
    about = f"{name}, azimuth {view.azimuth_deg:.3f} deg, region {view.region or 'whole image'}"
    main = {0x010E: about, 0x010F: model.split()[0], 0x0110: model, 0x0131: session.provenance.software, 0x0132: taken}
    own = {
        0x9003: taken,
        0x9286: b"ASCII\0\0\0" + json.dumps({"azimuth_deg": view.azimuth_deg}).encode(),
        0x920A: Fraction(round(focal_mm * 1000), 1000),
        0xA20E: Fraction(round(camera.size[0] * 10_000 / _FILM_MM), 1000),  # pixels per centimetre
        0xA20F: Fraction(round(camera.size[0] * 10_000 / _FILM_MM), 1000),
        0xA210: 3,
        0xA405: round(focal_mm),
    }
    first = 8 + len(_directory({**main, _OWN: 0}, 8))
    return b"MM\0*\0\0\0\x08" + _directory({**main, _OWN: first}, 8) + _directory(own, first)


def _directory(fields: dict[int, Any], at: int) -> bytes:
    """Return a TIFF directory that begins ``at`` this offset, with the values after it."""
    entries, values = b"", b""
    begin = at + 2 + 12 * len(fields) + 4
    for tag, value in sorted(fields.items()):
        kind, count, content = _field(tag, value)
        if len(content) > 4:
            place = struct.pack(">I", begin + len(values))
            values += content + b"\0" * (len(content) % 2)
        else:
            place = content.ljust(4, b"\0")
        entries += struct.pack(">HHI", tag, kind, count) + place
    return struct.pack(">H", len(fields)) + entries + bytes(4) + values


def _field(tag: int, value: Any) -> tuple[int, int, bytes]:
    match value:
        case str():
            text = value.encode("ascii", "replace") + b"\0"
            return 2, len(text), text
        case bytes():
            return 7, len(value), value
        case Fraction():
            return 5, 1, struct.pack(">II", value.numerator, value.denominator)
        case _ if tag == _OWN:
            return 4, 1, struct.pack(">I", value)
        case _:
            return 3, 1, struct.pack(">H", value)
