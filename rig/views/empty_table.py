"""The empty-table image of a bench: stored beside the bench's state, and checked before it is used.

Decision: docs/decisions/0028.
"""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError, field_validator

from rig.bench import Bench
from rig.core.errors import StateNotStored
from rig.devices.camera import CameraIdentity, CameraLocks
from rig.views import image_files as images
from rig.views.table_problems import TableProblem, TableProblemCode

MAX_AGE_H: Final = 12.0
"""A working day. On another day the illumination is different."""

_FILE: Final = "empty-table.json"
_VERSION: Final = 1


@dataclass(frozen=True, slots=True, eq=False)
class EmptyTable:
    """An empty-table image, and how it was taken.

    Attributes
    ----------
    image_bgr : uint8 array (H, W, 3)
        A whole frame.
    taken_utc
        Date and time.
    camera, locks
        The camera and its settings.
    evidence
        The measurements that the image was accepted with.
    noticed
        A problem that a search or an enrollment has noticed since then.
    """

    image_bgr: NDArray[np.uint8]
    taken_utc: datetime
    camera: CameraIdentity
    locks: CameraLocks
    evidence: Mapping[str, Any]
    noticed: TableProblem | None = None


@dataclass(frozen=True, slots=True)
class EmptyTableStatus:
    """A bench's empty-table image if it is usable, and the reasons to take a new one."""

    table: EmptyTable | None
    problems: tuple[TableProblem, ...] = ()

    @property
    def text(self) -> str:
        """The date of the image and its problems, in one line."""
        problems = [problem.text for problem in self.problems]
        if self.table is None:
            return "; ".join(problems)
        return "; ".join([f"the empty-table image is of {self.table.taken_utc:%Y-%m-%d %H:%M} UTC", *problems])

    def as_json(self) -> dict[str, Any]:
        """Return the date of the image and its problems as JSON values."""
        taken = None if self.table is None else f"{self.table.taken_utc:%Y-%m-%dT%H:%M:%SZ}"
        return {"taken_utc": taken, "problems": [problem.as_json() for problem in self.problems]}


def empty_table_status(bench: Bench) -> EmptyTableStatus:
    """Return the bench's empty-table image and its problems."""
    if bench.config.table.carries == "camera":
        return EmptyTableStatus(None, (TableProblem(TableProblemCode.CAMERA_MOVES),))
    try:
        table = _read(bench)
    except _Unreadable as error:
        return EmptyTableStatus(None, (TableProblem(TableProblemCode.UNREADABLE, {"detail": str(error)}),))
    if table is None:
        return EmptyTableStatus(None, (TableProblem(TableProblemCode.MISSING),))
    if unusable := _unusable(table, bench):
        return EmptyTableStatus(None, (unusable,))
    return EmptyTableStatus(table, _reasons_for_new_image(table, bench))


def store_empty_table(bench: Bench, table: EmptyTable) -> None:
    """Store an image instead of the previous one, which stays until the new one is completely on the disk.

    Raises
    ------
    StateNotStored
        The disk is full or not writable.
    """
    png = images.encode(table.image_bgr)
    stored = _Stored.of(table, png)
    before = _metadata(bench, quiet=True)
    bench.state.store_file(stored.image, png)
    bench.state.store_file(_FILE, stored.model_dump_json(indent=1).encode())
    if before is not None and before.image != stored.image:
        bench.state.remove_file(before.image)


def store_table_problem(bench: Bench, problem: TableProblem) -> None:
    """Store a problem with the bench's image, so that the next command asks for a new image."""
    before = _metadata(bench, quiet=True)
    if before is not None:
        changed = before.model_copy(update={"noticed": problem.as_json()})
        with suppress(StateNotStored):  # the warning was shown; other writes report a full disk
            bench.state.store_file(_FILE, changed.model_dump_json(indent=1).encode())


def _unusable(table: EmptyTable, bench: Bench) -> TableProblem | None:
    now, before = bench.camera.identity, table.image_bgr.shape
    if (now.height, now.width) != before[:2]:
        sizes = {"image_px": (before[1], before[0]), "frame_px": (now.width, now.height)}
        return TableProblem(TableProblemCode.OTHER_SIZE, sizes)
    if not now.is_same_camera(table.camera):
        shown = [camera.device or camera.name for camera in (table.camera, now)]
        return TableProblem(TableProblemCode.OTHER_CAMERA, {"image_camera": shown[0], "camera": shown[1]})
    return None


def _reasons_for_new_image(table: EmptyTable, bench: Bench) -> tuple[TableProblem, ...]:
    hours = round((bench.clock.utc() - table.taken_utc).total_seconds() / 3600, 2)
    problems = [TableProblem(TableProblemCode.OLD, {"hours": hours})] if hours > MAX_AGE_H else []
    problems += [TableProblem(TableProblemCode.FUTURE, {"hours": -hours})] if hours < -1 else []
    now = asdict(bench.camera.read_locks())
    problems += [
        TableProblem(TableProblemCode.SETTING, {"name": name, "before": before, "now": now[name]})
        for name, before in asdict(table.locks).items()
        if before is not None and now[name] is not None and before != now[name]
    ]
    return (*problems, *([table.noticed] if table.noticed else []))


class _Unreadable(Exception):
    pass


class _Stored(BaseModel):
    """Content of the JSON file beside the image."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int = _VERSION
    taken_utc: AwareDatetime
    camera: CameraIdentity
    locks: CameraLocks
    evidence: dict[str, Any]
    image: str = Field(pattern=r"^empty-table-[0-9TZ.]+\.png$")
    sha256: str
    noticed: dict[str, Any] | None = None

    @classmethod
    def of(cls, table: EmptyTable, png: bytes) -> Self:
        return cls(
            taken_utc=table.taken_utc,
            camera=table.camera,
            locks=table.locks,
            evidence=dict(table.evidence),
            image=f"empty-table-{table.taken_utc:%Y%m%dT%H%M%S.%fZ}.png",
            sha256=hashlib.sha256(png).hexdigest(),
            noticed=None if table.noticed is None else table.noticed.as_json(),
        )

    @field_validator("noticed")
    @classmethod
    def _has_code(cls, noticed: dict[str, Any] | None) -> dict[str, Any] | None:
        if noticed is not None:
            TableProblemCode(str(noticed.get("code")))
        return noticed

    def problem(self) -> TableProblem | None:
        if self.noticed is None:
            return None
        parameters = {name: value for name, value in self.noticed.items() if name != "code"}
        return TableProblem(TableProblemCode(self.noticed["code"]), parameters)


def _metadata(bench: Bench, *, quiet: bool = False) -> _Stored | None:
    try:
        text = bench.state.read_file(_FILE)
        stored = None if text is None else _Stored.model_validate_json(text)
    except StateNotStored as error:
        detail = error.what.rstrip(".")
    except ValidationError as error:
        detail = f"{_FILE} is damaged ({error.errors(include_url=False)[0]['msg']})"
    else:
        if stored is None or stored.version == _VERSION:
            return stored
        detail = f"{_FILE} has version {stored.version}, this program reads version {_VERSION}"
    if quiet:
        return None
    raise _Unreadable(detail)


def _read(bench: Bench) -> EmptyTable | None:
    stored = _metadata(bench)
    if stored is None:
        return None
    try:
        png = bench.state.read_file(stored.image)
    except StateNotStored as error:
        raise _Unreadable(error.what.rstrip(".")) from error
    if png is None:
        raise _Unreadable(f"{stored.image} is missing")
    if hashlib.sha256(png).hexdigest() != stored.sha256:
        raise _Unreadable(f"{stored.image} is damaged")
    try:
        image = images.decode(png)
    except images.BadImage as error:
        raise _Unreadable(f"{stored.image} is not readable: {error}") from error
    return EmptyTable(image, stored.taken_utc, stored.camera, stored.locks, stored.evidence, stored.problem())
