"""A folder of photographs in COIL layout, ``obj{N}__{A}.png`` or ``.jpg``, as objects on the platter.

N is the number of the object, A the table's angle in degrees, with optional decimals. The camera sees the photograph
nearest to the table's angle.
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np

from rig.core.errors import UsageError
from sim.objects.projection import HEIGHT, WIDTH, Floats, Image

_LAYOUT = re.compile(r"obj(\d+)__(\d+(?:\.\d+)?)\.(?:png|jpe?g)", re.IGNORECASE)
_KEPT = 96  # decoded photographs, 0.9 MB each


@dataclass(frozen=True)
class PhotographsOnTable:
    """One object of a folder.

    Attributes
    ----------
    azimuth_deg : float64 (n,)
        Angles of its photographs, ascending, in [0, 360).
    files
        The photographs, in that order.
    """

    name: str
    azimuth_deg: Floats = field(repr=False)
    files: tuple[Path, ...] = field(repr=False)
    symmetry_deg: float = 360.0

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        """Fill ``image`` with the photograph nearest to ``azimuth_deg``; ``offset_mm`` cannot move a photograph."""
        del offset_mm
        image[:] = _framed(self.files[self.nearest(azimuth_deg)])

    def nearest(self, azimuth_deg: float) -> int:
        """Return the index of the photograph nearest to an angle around the circle; of two, the first."""
        apart = np.abs((self.azimuth_deg - azimuth_deg + 180) % 360 - 180)
        return int(apart.argmin())


def photographs(folder: str | Path) -> Mapping[str, PhotographsOnTable]:
    """Return the objects of a folder by name, ``obj2`` before ``obj10``; photographs are read when they are drawn.

    Raises `UsageError` if the folder does not exist, contains no photograph in this layout, or contains two photographs
    of an object at one angle.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(
            f"The folder {folder} does not exist.",
            next_step="Give a folder with photographs named obj1__0.png, obj1__5.png, ...",
        )
    views: dict[int, dict[float, Path]] = defaultdict(dict)
    for path in sorted(folder.iterdir()):
        if match := _LAYOUT.fullmatch(path.name):
            number, azimuth = int(match[1]), float(match[2]) % 360
            if azimuth in views[number]:
                raise UsageError(
                    f"{views[number][azimuth]} and {path.name} show the same angle.", next_step="Remove one of them."
                )
            views[number][azimuth] = path
    if not views:
        raise UsageError(
            f"No photograph in {folder} is named like obj1__0.png.",
            next_step="Name them by object number and angle in degrees.",
        )
    return MappingProxyType({f"obj{number}": _object(f"obj{number}", views[number]) for number in sorted(views)})


def _object(name: str, views: Mapping[float, Path]) -> PhotographsOnTable:
    azimuths = sorted(views)
    return PhotographsOnTable(name, np.array(azimuths), tuple(views[a] for a in azimuths))


@lru_cache(maxsize=_KEPT)
def _framed(path: Path) -> Image:
    """Return a photograph scaled to the frame's height, centred on the colour of its border."""
    photo = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if photo is None:
        raise UsageError(f"{path} cannot be read as an image.", next_step="Replace or remove the file.")
    border = np.concatenate([photo[0], photo[-1], photo[:, 0], photo[:, -1]])
    frame = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    frame[:] = np.median(border, axis=0).round()
    scale = min(HEIGHT / photo.shape[0], WIDTH / photo.shape[1])
    size = (round(photo.shape[1] * scale), round(photo.shape[0] * scale))
    photo = cv2.resize(photo, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    x, y = (WIDTH - size[0]) // 2, (HEIGHT - size[1]) // 2
    frame[y : y + size[1], x : x + size[0]] = photo
    frame.flags.writeable = False
    return frame
