"""The empty-table images of a bench: stored beside the bench's state, and checked before they are used.

A turntable has one, a camera that moves around the object one for each azimuth (`rig.views.table_sheet`).

Decision: docs/decisions/0012.
"""

from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, SkipValidation, ValidationError

from rig.bench import Bench
from rig.core.errors import StateNotStored
from rig.devices.camera import CameraIdentity, CameraLocks
from rig.views import image_files as images
from rig.views.table_problems import TableProblem, TableProblemCode, surroundings_problem
from rig.views.table_sheet import TableSheet

MAX_AGE_H: Final = 12.0
"""A working day. On another day the illumination is different."""

_FILE: Final = "empty-table.json"


class EmptyTable(BaseModel):
    """A sheet of empty-table images, and how it was taken; without its pixels, the content of the JSON file beside it.

    ``image_bgr`` is the sheet, uint8 (H, W, 3). Its images are whole frames. The one at the table angle 0 was accepted
    with the measurements ``evidence``. A search or an enrollment may have ``noticed`` since then that the surroundings
    differ; it is the largest agreement of frames in a row, from 0 to 1. The name of the file ``image`` contains the
    SHA-256 of its bytes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    version: Literal[1] = 1
    image_bgr: SkipValidation[NDArray[np.uint8]] = Field(np.empty((0, 0, 3), np.uint8), exclude=True, repr=False)
    taken_utc: AwareDatetime
    camera: CameraIdentity
    locks: CameraLocks
    evidence: dict[str, Any]
    noticed: float | None = None
    image: str = Field("", pattern=r"^empty-table-[0-9a-f]{64}\.png$")


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
    try:
        table = _stored(bench)
        png = None if table is None else bench.state.read_file(table.image)
        image_bgr = None if png is None else images.decode(png)
    except StateNotStored as error:
        return _unreadable(error.what.rstrip("."))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        return _unreadable(f"{_FILE} is damaged ({'.'.join(map(str, first['loc']))}: {first['msg']})")
    except images.BadImage as error:
        return _unreadable(f"its file is damaged: {error}")
    if table is None:
        return EmptyTableStatus(None, (TableProblem(TableProblemCode.MISSING),))
    if png is None or image_bgr is None:
        return _unreadable(f"{table.image} is missing")
    if images.digest(png) not in table.image:
        return _unreadable(f"{table.image} is damaged")
    table = table.model_copy(update={"image_bgr": image_bgr})
    if unusable := _unusable(table, bench):
        return EmptyTableStatus(None, (unusable,))
    return EmptyTableStatus(table, _reasons_for_new_image(table, bench))


def _unreadable(detail: str) -> EmptyTableStatus:
    return EmptyTableStatus(None, (TableProblem(TableProblemCode.UNREADABLE, {"detail": detail}),))


def store_empty_table(bench: Bench, table: EmptyTable) -> None:
    """Store an image instead of the previous one, which stays until the new one is completely on the disk.

    Raises `StateNotStored`: the disk is full or not writable.
    """
    png = images.encode(table.image_bgr)
    stored = table.model_copy(update={"image": f"empty-table-{images.digest(png)}.png"})
    before = _stored_if_readable(bench)
    # The pixels are on the disk before the JSON file names them, so that at any time it names a complete image.
    bench.state.store_file(stored.image, png)
    _store(bench, stored)
    if before is not None and before.image != stored.image:
        bench.state.remove_file(before.image)


def store_table_problem(bench: Bench, agreement: float) -> None:
    """Store with the bench's image that the surroundings differ, so that the next command asks for a new image."""
    before = _stored_if_readable(bench)
    if before is not None:
        with suppress(StateNotStored):  # the warning was shown; other writes report a full disk
            _store(bench, before.model_copy(update={"noticed": agreement}))


def _store(bench: Bench, table: EmptyTable) -> None:
    bench.state.store_file(_FILE, table.model_dump_json(indent=1).encode())


def _unusable(table: EmptyTable, bench: Bench) -> TableProblem | None:
    now, before = bench.camera.identity, table.camera
    sheet = TableSheet.of(table.image_bgr, now.height, now.width)
    if sheet is None:
        sizes = {"image_px": (before.width, before.height), "frame_px": (now.width, now.height)}
        return TableProblem(TableProblemCode.OTHER_SIZE, sizes)
    if (len(sheet) > 1) != (bench.config.table.carries == "camera"):
        return TableProblem(TableProblemCode.OTHER_MOTION)
    if not now.is_same_camera(before):
        shown = [camera.device or camera.name for camera in (before, now)]
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
    if table.noticed is not None:
        problems.append(surroundings_problem(table.noticed))
    return tuple(problems)


def _stored(bench: Bench) -> EmptyTable | None:
    """Return the stored image without its pixels; None if there is none.

    Raises `StateNotStored`, `ValidationError`: its file cannot be read, or is damaged.
    """
    text = bench.state.read_file(_FILE)
    return None if text is None else EmptyTable.model_validate_json(text)


def _stored_if_readable(bench: Bench) -> EmptyTable | None:
    with suppress(StateNotStored, ValidationError):
        return _stored(bench)
    return None
