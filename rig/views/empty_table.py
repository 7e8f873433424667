"""The bench without an object: a picture that its operator takes once a day, and what it is good for today."""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from hbr.segmentation import MIN_AGREEMENT
from rig.bench import Bench
from rig.core.errors import StateNotStored
from rig.devices.camera import CameraIdentity, CameraLocks
from rig.views import image_files as images

COMMAND: Final = "rig empty-table"
HOLDS_H: Final = 12.0
"""A working day: the light of another one is another."""
IN_A_ROW: Final = 3
"""So many frames that look like another bench are not an arm that reached into the picture."""

_FACTS: Final = "empty-table.json"
_VERSION: Final = 1


@dataclass(frozen=True, slots=True, eq=False)
class EmptyTable:
    """A picture of the empty table, and how it was taken.

    Attributes
    ----------
    image_bgr : uint8 array (H, W, 3)
        A whole frame.
    taken_utc
        When.
    camera, locks
        By which camera, with which settings.
    evidence
        What it was judged by.
    doubt
        What was seen since that speaks against it; empty where nothing was.
    """

    image_bgr: NDArray[np.uint8]
    taken_utc: datetime
    camera: CameraIdentity
    locks: CameraLocks
    evidence: Mapping[str, Any]
    doubt: str = ""

    def useless_on(self, bench: Bench) -> str:
        """Return why the picture says nothing of this bench's frames; empty where it does."""
        now = bench.camera.identity
        if (now.width, now.height) != (self.image_bgr.shape[1], self.image_bgr.shape[0]):
            return (
                f"it has {self.image_bgr.shape[1]} x {self.image_bgr.shape[0]} pixels, "
                f"the camera's frames have {now.width} x {now.height}"
            )
        if now.name != self.camera.name:
            return f"it was taken by another camera, {self.camera.name}; this is {now.name}"
        return ""

    def doubts_on(self, bench: Bench) -> tuple[str, ...]:
        """Return why the picture should be taken anew, though it is better than none."""
        hours = (bench.clock.utc() - self.taken_utc).total_seconds() / 3600
        found = [f"it is {_age_words(hours)} old"] if hours > HOLDS_H else []
        found += ["it is dated in the future: see to the computer's clock"] if hours < -1 else []
        before, now = asdict(self.locks), asdict(bench.camera.read_locks())
        found += [
            f"{name} was {_setting(value)}, is {_setting(now[name])}"
            for name, value in before.items()
            if value is not None and now[name] is not None and value != now[name]
        ]
        return (*found, *([self.doubt] if self.doubt else []))


@dataclass(frozen=True, slots=True)
class TableStanding:
    """The picture that a bench has, if it is of use, and what speaks against it, in words."""

    table: EmptyTable | None
    doubts: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Return how the bench stands with its picture, in a line."""
        if self.table is None:
            return "; ".join(self.doubts)
        taken = f"the picture of the empty table is of {self.table.taken_utc:%Y-%m-%d %H:%M} UTC"
        return "; ".join([taken, *self.doubts])


class EmptyTables:
    """The picture of the empty table that is kept beside a bench's state."""

    @staticmethod
    def standing(bench: Bench) -> TableStanding:
        """Return the bench's picture, and whether it should be taken anew: then ``doubts`` say why."""
        if bench.config.table.carries == "camera":
            return TableStanding(None, ("the camera goes around the object, and its background with it",))
        try:
            table = _read(bench)
        except _Damaged as error:
            return TableStanding(None, (f"the picture of the empty table is of no use: {error}",))
        if table is None:
            return TableStanding(None, ("no picture of the empty table was taken yet",))
        if useless := table.useless_on(bench):
            return TableStanding(None, (f"the picture of the empty table is of no use: {useless}",))
        return TableStanding(table, table.doubts_on(bench))

    @staticmethod
    def keep(bench: Bench, table: EmptyTable) -> None:
        """Keep a picture in the place of the one before, which stays until this one is whole on the disk.

        Raises
        ------
        StateNotStored
            The disk is full, or may not be written to.
        """
        png = images.encode(table.image_bgr)
        kept = _Kept.of(table, png)
        before = _facts(bench, quiet=True)
        bench.state.store_file(kept.image, png)
        bench.state.store_file(_FACTS, kept.model_dump_json(indent=1).encode())
        if before is not None and before.image != kept.image:
            bench.state.remove_file(before.image)

    @staticmethod
    def doubt(bench: Bench, why: str) -> None:
        """Remember what was seen that speaks against the bench's picture, so that the next program asks for another."""
        before = _facts(bench, quiet=True)
        if before is not None:
            with suppress(StateNotStored):  # it was told; a full disk will be told by what needs it more
                bench.state.store_file(
                    _FACTS, before.model_copy(update={"doubt": why}).model_dump_json(indent=1).encode()
                )


class Drift:
    """Notices when frames have ceased to look like the picture of the empty table.

    The front end leaves such a picture alone, frame by frame; that the table was changed, or the camera moved, is for
    the person at the bench to know.
    """

    def __init__(self) -> None:
        self._low: list[float] = []
        self._told = False

    def look(self, segmentation: Mapping[str, Any] | None) -> str:
        """Add the segmentation of the next frame; return a warning once, else an empty string."""
        agreement = None if segmentation is None else segmentation.get("agreement")
        if agreement is None:
            return ""
        self._low = [*self._low, agreement] if agreement < MIN_AGREEMENT else []
        if self._told or len(self._low) < IN_A_ROW:
            return ""
        self._told = True
        return (
            f"{IN_A_ROW} frames in a row look like the picture of the empty table over "
            f"{max(self._low):.0%} of their border at most: the table or its surroundings have changed, the camera was "
            "moved, or the object reaches to the border"
        )


class _Damaged(Exception):
    pass


class _Kept(BaseModel):
    """The file beside the picture."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int = _VERSION
    taken_utc: AwareDatetime
    camera: CameraIdentity
    locks: CameraLocks
    evidence: dict[str, Any]
    image: str = Field(pattern=r"^empty-table-[0-9TZ.]+\.png$")
    sha256: str
    doubt: str = ""

    @classmethod
    def of(cls, table: EmptyTable, png: bytes) -> Self:
        return cls(
            taken_utc=table.taken_utc,
            camera=table.camera,
            locks=table.locks,
            evidence=dict(table.evidence),
            image=f"empty-table-{table.taken_utc:%Y%m%dT%H%M%S.%fZ}.png",
            sha256=hashlib.sha256(png).hexdigest(),
            doubt=table.doubt,
        )


def _facts(bench: Bench, *, quiet: bool = False) -> _Kept | None:
    try:
        text = bench.state.read_file(_FACTS)
        kept = None if text is None else _Kept.model_validate_json(text)
    except StateNotStored as error:
        why = error.what
    except ValidationError as error:
        why = f"{_FACTS} is damaged ({error.errors(include_url=False)[0]['msg']})"
    else:
        if kept is None or kept.version == _VERSION:
            return kept
        why = f"{_FACTS} is of version {kept.version}, this program knows {_VERSION}"
    if quiet:
        return None
    raise _Damaged(why)


def _read(bench: Bench) -> EmptyTable | None:
    kept = _facts(bench)
    if kept is None:
        return None
    try:
        png = bench.state.read_file(kept.image)
    except StateNotStored as error:
        raise _Damaged(error.what) from error
    if png is None:
        raise _Damaged(f"{kept.image} is missing")
    if hashlib.sha256(png).hexdigest() != kept.sha256:
        raise _Damaged(f"{kept.image} is damaged")
    try:
        image = images.decode(png)
    except images.BadImage as error:
        raise _Damaged(f"{kept.image} cannot be read: {error}") from error
    return EmptyTable(image, kept.taken_utc, kept.camera, kept.locks, kept.evidence, kept.doubt)


def _age_words(hours: float) -> str:
    return f"{hours:.0f} hours" if hours < 48 else f"{hours / 24:.0f} days"


def _setting(value: float | bool) -> str:
    return ("on" if value else "off") if isinstance(value, bool) else f"{value:g}"
