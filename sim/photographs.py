"""The bench of photographs: a simulated bench whose camera shows photographs of real objects from known angles."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import BaseModel, Field

from rig.bench import BenchKind
from rig.catalog.exchange.photographs import DEFAULT_PATTERN, Photographs, read_photographs
from rig.config import RigConfig
from rig.config.values import validate
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, ImportRejected, UsageError
from rig.core.next_steps import Do
from rig.core.phrases import counted
from rig.views.image_files import BadImage, decode, header, read_file
from sim.bench import ShelfOperator, SimBenchKind, SimOptions
from sim.objects.projection import Floats, Image
from sim.world import SimObject, World

NAME = "photographs"
_SECTION = f"bench.{NAME}"
_SIDE_PX = (80, 8000)  # of `rig.config.schema.CameraConfig`
_VIEWS = (4, 720)  # of `rig.config.schema.EnrollConfig`
_SHOWN = 3
_KEPT = 16  # decoded photographs: a move goes from one to the next, and large ones take 30 MB each


@dataclass(frozen=True)
class PhotographsOnTable:
    """An object.

    ``azimuth_deg``, float64 (n,), are the azimuths of the camera in its photographs, ascending, in [0, 360), and
    ``files`` the photographs in that order.
    """

    name: str
    azimuth_deg: Floats = field(repr=False)
    files: tuple[Path, ...] = field(repr=False)
    symmetry_deg: float = 360.0

    @classmethod
    def of(cls, name: str, views: Sequence[tuple[float, Path]]) -> Self:
        """Return the object with these photographs: azimuth and file, by ascending azimuth."""
        return cls(name, np.array([azimuth_deg for azimuth_deg, _ in views]), tuple(path for _, path in views))

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        """Fill ``image`` with the nearest photograph; ``offset_mm`` cannot move an object in a photograph.

        The object's counter-clockwise rotation ``azimuth_deg`` moves the camera clockwise around it.
        """
        del offset_mm
        image[:] = photograph(self.files[self.nearest(-azimuth_deg)])

    def nearest(self, azimuth_deg: float) -> int:
        """Return the index of the photograph nearest to an azimuth around the circle; of two, the first."""
        apart = np.abs((self.azimuth_deg - azimuth_deg + 180) % 360 - 180)
        return int(apart.argmin())


@lru_cache(maxsize=_KEPT)
def photograph(path: Path) -> Image:
    """Return a photograph, uint8 (height, width, 3), BGR.

    Raises `UsageError`: the file cannot be read, or is no image.
    """
    try:
        image = decode(read_file(path))
    except (OSError, BadImage) as error:
        raise UsageError(
            f"The photograph {path} cannot be used: {error}.", next_step="Replace or remove the file."
        ) from error
    image.flags.writeable = False
    return image


class PhotographOptions(SimOptions):
    """The section ``[bench.photographs]``."""

    source: Path | None = Field(
        None, description="folder of photographs, or table (.csv), as for rig import; needed to open the bench"
    )
    pattern: str = Field(
        DEFAULT_PATTERN, description="names of the photographs in the folder, with {object} and {angle}"
    )
    table_angles: bool = Field(
        False, description="whether the angles in the names are table angles, which run against azimuths"
    )
    every: int = Field(
        1,
        ge=1,
        le=360,
        description="one of this many photographs of an object is shown to enroll it, the others to identify it; "
        "1: all for both",
    )
    empty_table: Path | None = Field(
        None,
        description="image of the empty table, or a folder of them, named by angle (90.png); none: the table cannot "
        "be shown empty",
    )


@dataclass(frozen=True)
class PhotographedObjects:
    """What the camera of the bench can show."""

    enrolled: Mapping[str, PhotographsOnTable]
    identified: Mapping[str, PhotographsOnTable]
    """The objects by name, with the photographs that are shown to enroll and to identify them."""
    empty_table: PhotographsOnTable | None
    """The empty table; None if there is no image of it."""
    first: Path
    """A photograph, whose size the others must have."""
    size: tuple[int, int]
    """Its width and height."""
    region: tuple[int, int, int, int] | None
    """The part of the frames that is described, if a table gives one for all its photographs; None: the whole frame."""
    findings: tuple[str, ...]
    """Notes about files that cannot be used."""

    @classmethod
    def read(cls, options: PhotographOptions) -> "PhotographedObjects":
        """Find the photographs; only the first one is read.

        Raises `ConfigError`: there is no photograph, or the first one cannot be used. `ImportRejected`: the empty-table
        images do not fit.
        """
        if options.source is None:
            raise ConfigError(
                "The bench of photographs has no photographs.",
                next_step=("Name their folder.", Do.SET_KEY(key=f"{_SECTION}.source", value="FOLDER")),
            )
        pattern = None if options.pattern == DEFAULT_PATTERN else options.pattern
        try:
            found = read_photographs(
                options.source, pattern=pattern, table_angles=options.table_angles, now=SystemClock().utc()
            )
        except (ImportRejected, UsageError) as error:
            raise ConfigError(
                error.what, next_step=f"Check {_SECTION}.source and {_SECTION}.pattern.", evidence=error.evidence
            ) from error
        views: dict[str, list[tuple[float, Path]]] = defaultdict(list)
        regions = set()
        for name, azimuth_deg, view in found.views():
            views[name].append((azimuth_deg, Path(view.image).absolute()))
            regions.add(view.region)
        if not views:
            raise ConfigError(
                f"{options.source} has no photograph that can be used.",
                next_step="Correct the listed files.",
                evidence={"rejected": [str(file) for file in found.rejected[:_SHOWN]]},
            )
        enrolled, identified = {}, {}
        for name, one in views.items():
            one.sort()
            enrolled[name] = PhotographsOnTable.of(name, one[:: options.every])
            others = one if options.every == 1 else [view for n, view in enumerate(one) if n % options.every]
            identified[name] = PhotographsOnTable.of(name, others)
        first = next(iter(enrolled.values())).files[0]
        table = None if options.empty_table is None else _empty_table(found, options)
        region = regions.pop() if len(regions) == 1 else None
        return cls(enrolled, identified, table, first, _size(first), region, _rejected(found))

    def fitted(self, config: RigConfig) -> RigConfig:
        """Return a configuration with the camera of the photographs; region and number of views follow them, too.

        Raises `ConfigError`: no camera has the size of the photographs, or a region of the configuration is not within
        them.
        """
        values = config.model_dump(exclude_unset=True)
        width, height = self.size
        if not _SIDE_PX[0] <= min(self.size) <= max(self.size) <= _SIDE_PX[1]:
            raise ConfigError(
                f"{self.first} has {width} x {height} pixels; a camera has from {_SIDE_PX[0]} to {_SIDE_PX[1]} along "
                "each side.",
                next_step="Scale the photographs.",
            )
        values["camera"] = values.get("camera", {}) | {"width": width, "height": height}
        values["view"] = {"roi": self.region} | values.get("view", {})
        most = max(len(one.files) for one in self.enrolled.values())
        values["enroll"] = {"views": min(max(most, _VIEWS[0]), _VIEWS[1])} | values.get("enroll", {})
        return validate(RigConfig, values, where=f"the configuration for photographs of {width} x {height} pixels")

    def backdrop(self) -> Image:
        """Return what the camera sees before something is on the table: the empty table, or only its ground's colour.

        Raises `UsageError`: an image cannot be used.
        """
        if self.empty_table is not None:
            return photograph(self.empty_table.files[0])
        image = photograph(self.first)
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        return np.broadcast_to(np.median(border, axis=0).round().astype(np.uint8), image.shape).copy()


class PhotographOperator(ShelfOperator):
    """The simulated operator of this bench. Boards are not at hand, because the camera cannot see them."""

    def __init__(self, world: World, photographed: PhotographedObjects) -> None:
        super().__init__(world, photographed.identified)
        self._photographed = photographed
        self.targets = {}
        self.findings = photographed.findings
        self.backdrop = photographed.backdrop()
        self.clear()

    def thing(self, name: str, *, to_identify: bool) -> SimObject:
        """Return the object called ``name``, with the photographs that are shown to enroll or to identify it.

        Raises `ObjectNotFound`: there are no photographs of that name. `UsageError`: there are too few, or they differ
        in size.
        """
        super().thing(name, to_identify=to_identify)
        photographed = self._photographed
        thing = (photographed.identified if to_identify else photographed.enrolled)[name]
        if len(thing.files) < 2:
            raise UsageError(
                f"{name} has {counted(len(thing.files), 'photograph')} to {'identify' if to_identify else 'enroll'} "
                "it with; two are needed at least.",
                next_step=f"Add photographs from other angles, or reduce {_SECTION}.every.",
            )
        for path in thing.files:
            size, first = _size(path), photographed.size
            if size != first:
                raise UsageError(
                    f"{path} has {size[0]} x {size[1]} pixels, but {photographed.first} has {first[0]} x {first[1]}.",
                    next_step="Crop or scale the photographs to one size: a bench has one camera.",
                )
        return thing

    def clear(self) -> bool:
        """Clear the table and return whether that is possible: a photograph always shows its own table."""
        if self._photographed.empty_table is None:
            return False
        self.world.put(self._photographed.empty_table)
        return True


class PhotographsKind(SimBenchKind):
    """The kind of bench ``photographs``."""

    name = NAME
    options: type[BaseModel] = PhotographOptions

    def fitted(self, config: RigConfig, options: Any) -> RigConfig:
        """Return the configuration for the photographs. Raises as `PhotographedObjects`."""
        return PhotographedObjects.read(options).fitted(config)

    def prepare(self, config: RigConfig, options: Any, world: World) -> tuple[RigConfig, ShelfOperator]:
        """Return the configuration for the photographs, and who shows them. Raises as `PhotographedObjects`."""
        photographed = PhotographedObjects.read(options)
        return photographed.fitted(config), PhotographOperator(world, photographed)


def _size(path: Path) -> tuple[int, int]:
    """Return width and height of an image, without decoding it."""
    try:
        found = header(read_file(path))
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read: {error.strerror}.", next_step="Replace or remove the file."
        ) from error
    if found is None:
        raise UsageError(f"{path} is not a PNG or JPEG image.", next_step="Replace or remove the file.")
    return found.width, found.height


def _empty_table(found: Photographs, options: PhotographOptions) -> PhotographsOnTable:
    """Return the empty table at each azimuth for which there is an image."""
    assert options.empty_table is not None
    found.use_empty_tables(options.empty_table, table_angles=options.table_angles)
    images: dict[float, str] = {}
    for name, azimuth_deg, _ in found.views():
        image = found.empty_table(name, azimuth_deg)
        assert image is not None  # each photograph has one
        if images.setdefault(azimuth_deg, image) != image:
            raise ConfigError(
                f"{options.empty_table} has an empty-table image for each object, but a bench has one table.",
                next_step="Give one image, or name the images by angle (90.png).",
            )
    return PhotographsOnTable.of(
        "the empty table", [(angle, Path(image).absolute()) for angle, image in sorted(images.items())]
    )


def _rejected(found: Photographs) -> tuple[str, ...]:
    if not found.rejected:
        return ()
    shown = [str(file) for file in found.rejected[:_SHOWN]]
    more = len(found.rejected) - _SHOWN
    shown += [f"and {more} others"] if more > 0 else []
    return (f"camera: {counted(len(found.rejected), 'file')} of {found.origin} not used: {'; '.join(shown)}",)


PHOTOGRAPHS: BenchKind = PhotographsKind()
