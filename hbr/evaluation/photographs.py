"""Data sets: photographs of objects from known angles."""

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from hbr.core.arrays import FloatArray, ImageArray

_SUFFIXES: Final = {".png", ".jpg", ".jpeg"}
_COIL_NAME: Final = re.compile(r"obj(?P<number>\d+)__(?P<angle>\d+(?:\.\d+)?)")
#: Largest level of COIL's black background, with sensor noise and glow.
_DARK: Final = 45
#: Largest distance of a regular step from a multiple of the median step, in median steps; encoders err by less.
_REGULAR: Final = 0.25
#: Share of other steps in a regular data set, such as those beside missing views.
_IRREGULAR_SHARE: Final = 0.1
#: The last bytes of a complete file. OpenCV does not reject a file that was cut off.
_ENDS: Final = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}


class DatasetError(ValueError):
    """A data set that cannot be evaluated; the message names the file or folder."""


@dataclass(frozen=True)
class Photograph:
    """A file, the azimuth of the camera, and the part that is described: x, y, width, height in pixels; None: all."""

    path: Path
    azimuth_deg: float
    region: tuple[int, int, int, int] | None = None

    def read(self, size: tuple[int, int] | None = None) -> ImageArray:
        """Return the described part; parameter and errors as for `read_photograph`."""
        image = read_photograph(self.path, size)
        if self.region is None:
            return image
        x, y, width, height = self.region
        return image[y : y + height, x : x + width]


@dataclass(frozen=True)
class PhotographedObject:
    """An object and its photographs, sorted by azimuth in [0, 360)."""

    name: str
    photographs: tuple[Photograph, ...]

    @property
    def azimuth_deg(self) -> FloatArray:
        return np.array([photograph.azimuth_deg for photograph in self.photographs])


@dataclass(frozen=True)
class Dataset:
    """Objects to enroll and to identify."""

    name: str
    """Name in reports."""
    objects: tuple[PhotographedObject, ...]
    """At least two objects with different names."""
    ignored: int = 0
    """Number of image files in the folder whose names are not those of views."""

    def __post_init__(self) -> None:
        if len(self.objects) < 2:
            raise DatasetError(f"{self.name}: {len(self.objects)} object; at least two are needed")
        for item in self.objects:
            azimuth_deg = item.azimuth_deg
            for i in np.flatnonzero(np.diff(azimuth_deg) <= 0):
                first, second = item.photographs[i].path, item.photographs[i + 1].path
                raise DatasetError(
                    f"{first} and {second} are the same view of {item.name} ({azimuth_deg[i]:g}°); remove one of them"
                )

    @property
    def views(self) -> int:
        return sum(len(item.photographs) for item in self.objects)

    @property
    def _steps_deg(self) -> FloatArray:
        return np.concatenate([np.diff(item.azimuth_deg, append=item.azimuth_deg[0] + 360) for item in self.objects])

    @property
    def spacing_deg(self) -> float:
        """The median step between neighbouring views of all objects."""
        return float(np.median(self._steps_deg))

    @property
    def missing(self) -> int | None:
        """The number of views that are missing from complete revolutions at that step; None if steps are irregular."""
        steps = self._steps_deg / self.spacing_deg
        if np.mean(np.abs(steps - np.rint(steps)) > _REGULAR) > _IRREGULAR_SHARE:
            return None
        whole = round(360 / self.spacing_deg)
        return sum(max(0, whole - len(item.photographs)) for item in self.objects)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the first photograph, which all must have."""
        height, width = read_photograph(self.objects[0].photographs[0].path).shape[:2]
        return width, height

    def image(self, j: int, i: int) -> ImageArray:
        """Return the described part of photograph `i` of object `j`, uint8 (H, W, 3), BGR.

        Raises
        ------
        DatasetError
            The photograph cannot be used, or has another size than the first one.
        """
        return self.objects[j].photographs[i].read(self.size)

    def every(self, step: int) -> "Dataset":
        """Return the data set with every ``step``-th photograph of each object."""
        objects = tuple(replace(item, photographs=item.photographs[::step]) for item in self.objects)
        return replace(self, objects=objects)

    def subset(self, first: int, last: int) -> "Dataset":
        """Return the data set with the objects at positions `first` to `last`, counted from 1, both included."""
        if not 1 <= first <= last <= len(self.objects):
            raise DatasetError(
                f"objects {first}-{last} were requested, but {self.name} has {len(self.objects)}; the first is 1"
            )
        return replace(self, objects=self.objects[first - 1 : last])


def load_coil(folder: Path) -> Dataset:
    """Find the views of a folder in the layout of COIL-100: ``obj{number}__{angle}.png`` or ``.jpg``.

    Angles are degrees, with or without a fraction, and are used as azimuths. If they are table angles, left and right
    are exchanged. Objects are sorted by number.

    Raises
    ------
    DatasetError
        The folder is missing or contains no such file, or two files show the same view.
    """
    if not folder.is_dir():
        raise DatasetError(
            f"{folder} is not a folder; name the one with the images, obj1__0.png and so on "
            "(COIL-100 is at https://cave.cs.columbia.edu/repository/COIL-100)"
        )
    found: dict[int, list[Photograph]] = {}
    ignored = 0
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES):
        name = _COIL_NAME.fullmatch(path.stem)
        if name is None:
            ignored += 1
            continue
        found.setdefault(int(name["number"]), []).append(Photograph(path, wrap360(float(name["angle"]))))
    if not found:
        raise DatasetError(
            f"{folder} contains no view; name the files obj1__0.png, obj1__5.png, obj2__0.jpg, and so on"
        )
    objects = tuple(
        PhotographedObject(f"obj{number}", tuple(sorted(found[number], key=lambda view: view.azimuth_deg)))
        for number in sorted(found)
    )
    return Dataset(folder.name or str(folder), objects, ignored)


def read_photograph(path: Path, size: tuple[int, int] | None = None) -> ImageArray:
    """Read a PNG or JPEG file, uint8 (H, W, 3), BGR; ``size`` is the required width and height.

    Raises
    ------
    DatasetError
        The file is missing, cut off, not an image, or of another size.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error
    # padding after the end is valid
    if _ENDS.get(path.suffix.lower(), b"") not in data[-4096:]:
        raise DatasetError(f"{path} is cut off or not an image; copy it again")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DatasetError(f"OpenCV cannot read the image {path}; copy it again")
    height, width = image.shape[:2]
    if size is not None and (width, height) != size:
        raise DatasetError(
            f"{path} has {width} x {height} pixels, the first image {size[0]} x {size[1]}; "
            "views of one data set must have one size"
        )
    return image.astype(np.uint8, copy=False)


def object_mask(image_bgr: ImageArray) -> NDArray[np.bool_]:
    """Return the pixels of the object, (H, W): all except the dark region that is connected with the image's border."""
    dark = (image_bgr.max(axis=2) <= _DARK).astype(np.uint8)
    # a frame of dark pixels joins all regions that touch the border
    labels = cv2.connectedComponents(cv2.copyMakeBorder(dark, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1))[1]
    outside: NDArray[np.bool_] = labels[1:-1, 1:-1] == labels[0, 0]
    return ~outside


def without_specks(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask without small regions."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = stats[1:, cv2.CC_STAT_AREA]
    whole: NDArray[np.bool_] = np.isin(labels, 1 + np.flatnonzero(area >= 0.05 * area.max(initial=0)))
    return whole
