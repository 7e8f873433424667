"""A saved run: the folder of one search, with all data to show it and to compute it again.

``run.json`` contains the conditions and settings, ``model.jsonl`` the enrolled views (one object in each line),
``events.jsonl`` the events (one in each line), ``frames/000.png``, ... the accepted frames without loss. The folder of
a dense search also contains the empty-table image (``empty_table.png``).

Decision: docs/decisions/0017.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, TypeAdapter, ValidationError

import hbr
from hbr.core.arrays import MIN_SIDE_PX
from hbr.descriptors import descriptor
from rig.bench import Bench
from rig.config import RigConfig
from rig.core.errors import CatalogError, Problem, RigError, UsageError, os_errors_as
from rig.core.files import json_values, read, write
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import short
from rig.events.events import Accepted, Event, Failed, Identified, Started, event_dict, event_of
from rig.search.model import Model, empty_table_for, model_of
from rig.views import image_files as images

FORMAT: Final = "hbr-rig run"
VERSION: Final = 1  # a run of another version is not checked, because its decisions come from another program
EMPTY_TABLE: Final = "empty_table.png"

MAX_REASON: Final = 300  # a reason can contain the whole damaged value
_MAX_BYTES: Final = {"run.json": 1_000_000, "model.jsonl": 32_000_000, "events.jsonl": 10_000_000}
"""Larger than the files of all real runs. Values of JSON can need twenty times as much memory as their text."""
_DAMAGE: Final = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, cv2.error)
"""Exceptions because of values of a wrong type."""
_PROBLEM: Final = TypeAdapter(Problem)


class DescriptorUsed(BaseModel):
    """The descriptor of a run's views, and its version."""

    name: str
    version: int


class About(BaseModel):
    """What ``run.json`` contains: how the run was made."""

    model_config = ConfigDict(frozen=True)

    format: Literal["hbr-rig run"] = FORMAT
    version: int = VERSION
    software: str
    started_utc: AwareDatetime
    bench: str
    devices: dict[str, Any]
    conditions: dict[str, Any]
    findings: list[Any]
    descriptor: DescriptorUsed
    config: RigConfig


@contextmanager
def save_run(
    folder: Path, bench: Bench, model: Model, config: RigConfig | None = None
) -> Iterator[Callable[[Event], None]]:
    """Return a function, in a ``with`` block, that stores the next event of one search; an error is stored, too.

    After an interruption the folder contains all events so far; a frame is in the folder before its event.

    Raises `UsageError`: the folder is not empty, or the disk is full or fails.
    """
    views = model.views
    kind = descriptor(views.descriptor)
    with _writing(folder):
        (folder / "frames").mkdir(parents=True, exist_ok=True)
        if len(list(folder.iterdir())) > 1:
            raise UsageError(f"The folder {folder} is not empty.", next_step="Give a new folder for each run.")
        write(folder / "model.jsonl", "".join(_model_lines(views)).encode())
        empty_table, _ = empty_table_for(bench, model)
        if empty_table is not None:
            write(folder / EMPTY_TABLE, images.encode(empty_table))
        about = About(
            software=f"hbr-rig {version_of('hbr-rig')}",
            started_utc=bench.clock.utc(),
            bench=bench.name,
            devices=plain(bench.devices()),
            conditions=plain(bench.conditions),
            findings=plain(bench.findings),
            descriptor=DescriptorUsed(name=kind.name, version=kind.version),
            config=config or bench.config,
        )
        text = about.model_dump_json(indent=2, exclude={"config": {"serve"}})  # it has the tokens
        write(folder / "run.json", f"{text}\n".encode())
        lines = (folder / "events.jsonl").open("x", encoding="utf-8")

    def store(value: dict[str, Any]) -> None:
        lines.write(json.dumps(value, ensure_ascii=False, allow_nan=False, default=str) + "\n")
        lines.flush()

    def save(event: Event) -> None:
        with _writing(folder):
            if isinstance(event, Accepted):
                write(folder / _frame_file(event.index), images.encode(event.image_bgr))
            store(event_dict(event))

    with lines:
        try:
            yield save
        except RigError as error:
            store(plain(error.problem))
            raise


@contextmanager
def saving(
    next_folder: Callable[[], Path] | None, bench: Bench, model: Callable[[], Model], config: RigConfig | None = None
) -> Iterator[Callable[[Event], None]]:
    """Return a function, in a ``with`` block, that saves events: each search in the folder of ``next_folder``.

    Without ``next_folder`` it saves nothing. Errors as for `save_run`.
    """
    with ExitStack() as search:
        save: Callable[[Event], None] | None = None

        def add(event: Event) -> None:
            nonlocal save
            if next_folder is not None and isinstance(event, Started):
                save = search.enter_context(save_run(next_folder(), bench, model(), config))
            if save is not None:
                save(event)
                if isinstance(event, Identified | Failed):
                    search.close()
                    save = None

        yield add


@dataclass(frozen=True, slots=True)
class SavedRun:
    """The content of a saved run."""

    folder: Path
    about: About
    model: Model
    empty_table: NDArray[np.uint8] | None
    """The sheet of empty-table images, uint8 (H, W, 3) (`rig.views.table_sheet`)."""
    error: Problem | None
    """The error that ended the search."""
    is_cut: bool
    """Whether the last line of the events was cut off while it was written."""
    _lines: tuple[dict[str, Any], ...]

    @property
    def config(self) -> RigConfig:
        """The settings of the search."""
        return self.about.config

    @property
    def views(self) -> hbr.Views:
        """The enrolled views of the search."""
        return self.model.views

    def events(self) -> Iterator[Event]:
        """Yield the events in their order, frames included.

        Raises `UsageError`: an event is not known to this program, or a frame is missing.
        """
        for number, line in enumerate(self._lines, 1):
            try:
                event = event_of(line)
                if isinstance(event, Accepted):
                    event = replace(event, image_bgr=self._frame(event.index))
            except _DAMAGE as error:
                raise _damaged(self.folder, f"events.jsonl, line {number}: {_reason(error)}") from error
            yield event

    @contextmanager
    def damage(self) -> Iterator[None]:
        """Report errors of a computation with the run's values as damage of the run, in a ``with`` block.

        Values with the right types may still not fit together, for example an empty list of candidates.

        Raises `UsageError`: the values do not fit together.
        """
        try:
            yield
        except _DAMAGE as error:
            raise _damaged(self.folder, f"its values do not fit together: {_reason(error)}") from error

    @property
    def started(self) -> Started:
        """The first event."""
        first = next(self.events(), None)
        if not isinstance(first, Started):
            raise _damaged(self.folder, "events.jsonl does not begin with the event started")
        return first

    def _frame(self, index: int) -> NDArray[np.uint8]:
        frame = _image(self.folder, _frame_file(index))
        x, y, width, height = self.config.view.roi or (0, 0, 0, 0)
        if x + width > frame.shape[1] or y + height > frame.shape[0]:
            raise ValueError(f"frame {index} has {frame.shape[1]} x {frame.shape[0]} pixels, less than the region")
        return frame


def load_run(folder: Path) -> SavedRun:
    """Read a saved run; a last event that was cut off while it was written is left out.

    Raises `UsageError`: the folder contains no run, a damaged run, or one of another version of the program.
    """
    try:
        values = _object(_bytes(folder, "run.json"), "run.json")
        if values.get("format") == FORMAT and (number := values.get("version")) != VERSION:
            raise UsageError(
                f"Another version of the program saved the run {folder}: it has the format version {number}, this "
                f"program reads {VERSION}.",
                next_step="Use the version of hbr-rig that saved it.",
            )
        about = About.model_validate(values)
        # The model: the enrolled views of the day.
        used = about.descriptor
        if used.version != descriptor(used.name).version:
            raise ValueError(f"it was described by {used.name} {used.version}, which this program does not have")
        model = model_of(_views((_object(line) for line in _lines(_bytes(folder, "model.jsonl"))), used.name))
        empty_table = _image(folder, EMPTY_TABLE) if (folder / EMPTY_TABLE).exists() else None
        # The events: a power cut may have cut off the last line.
        content = _bytes(folder, "events.jsonl")
        is_cut = bool(content) and not content.endswith(b"\n")
        lines = [_object(line) for line in _lines(content)[: -1 if is_cut else None]]
        has_failed = bool(lines) and "event" not in lines[-1]
        failed = _PROBLEM.validate_python(lines.pop()) if has_failed else None
    except ValidationError as error:
        where = "run.json" if error.title == About.__name__ else "the error at the end of events.jsonl"
        raise _damaged(folder, f"{where}: {_reason(error)}") from error
    except CatalogError as error:
        raise _damaged(folder, f"{error.what.rstrip('.')}: {error.evidence['reason']}") from error
    except _DAMAGE as error:
        raise _damaged(folder, _reason(error)) from error
    return SavedRun(folder, about, model, empty_table, failed, is_cut, tuple(lines))


def _frame_file(index: int) -> str:
    return f"frames/{index:03d}.png"


def _model_lines(views: hbr.Views) -> Iterator[str]:
    pack = descriptor(views.descriptor).pack
    for number, name in enumerate(views.object_names):
        rows = views.of(number)
        line = {
            "object": name,
            "azimuth_deg": views.azimuth_deg[rows].tolist(),
            "descriptors": [pack(levels).hex() for levels in views.levels(rows)],
        }
        yield json.dumps(line, ensure_ascii=False) + "\n"


def _views(lines: Iterable[dict[str, Any]], kind: str) -> hbr.Views:
    parts = [
        hbr.Views.of_object(
            line["object"],
            descriptor(kind).unpack_rows(bytes.fromhex("".join(line["descriptors"]))),
            line["azimuth_deg"],
            kind,
        )
        for line in lines
    ]
    return hbr.Views.concatenate(parts) if parts else hbr.Views.empty(kind)


def _image(folder: Path, name: str) -> NDArray[np.uint8]:
    image = images.decode(_bytes(folder, name))
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise ValueError(f"{name} has {image.shape[1]} x {image.shape[0]} pixels")
    return image


def _lines(content: bytes) -> list[str]:
    """Return the lines of JSON Lines; only a line feed ends a line; it may be missing in the last line."""
    return content.decode().removesuffix("\n").split("\n") if content else []


def _object(text: str | bytes, name: str = "a line") -> dict[str, Any]:
    values = json_values(text)
    if not isinstance(values, dict):
        raise TypeError(f"{name} is not a JSON object")
    return values


def _bytes(folder: Path, name: str) -> bytes:
    """Return the content of one of the run's files; a link that leads out of the folder is not followed."""
    path = folder / name
    try:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise OSError(None, "it is a link to a file outside the run", str(path))
        return read(path, max_bytes=_MAX_BYTES.get(name, images.MAX_FILE_BYTES))
    except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle
        raise UsageError(
            f"There is no saved run in {folder}: {name} cannot be read.",
            next_step="Give a folder in which a run was saved.",
            evidence={"reason": getattr(error, "strerror", None) or str(error)},
        ) from error


def _reason(error: Exception) -> str:
    """Return an error in words; of Python's own errors, only those of a ValueError or TypeError are useful."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return short(f"{'.'.join(map(str, first['loc']))}: {first['msg']}", MAX_REASON)
    text = str(error) if isinstance(error, ValueError | TypeError) else "a value is missing, or it has the wrong kind"
    return short(text, MAX_REASON)


def _damaged(folder: Path, reason: str) -> UsageError:
    return UsageError(
        f"The run in {folder} cannot be read.",
        next_step="Use a backup, or open its files in other programs: they are PNG and JSON Lines.",
        evidence={"reason": reason},
    )


def _writing(folder: Path) -> AbstractContextManager[None]:
    step = ("Give a new folder, on a disk with space.", Do.RUN_AGAIN(save_run="FOLDER"))
    return os_errors_as(UsageError, f"The run cannot be saved in {folder}.", next_step=step)
