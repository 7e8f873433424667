"""A retrieval kept in a folder of open formats: what is needed to look at it again, and to compute it again.

``run.json`` has the conditions and settings, ``model.jsonl`` the enrolled views, an object a line, ``events.jsonl``
what happened, an event a line, and ``frames/000.png``, ... the accepted frames, lossless. Of a dense search
``search_rules.json`` has the rules that it went by, ``empty_table.png`` the picture that the object was found with.

Decision: docs/decisions/0018.
"""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from importlib.metadata import version
from math import isfinite, nan
from pathlib import Path
from types import NoneType, TracebackType, UnionType
from typing import Any, Final, Self, TextIO, Union, get_args, get_origin, get_type_hints

import cv2
import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.core.validation import MIN_SIDE_PX
from hbr.descriptors import MODEL_NAME, PREFIX, Descriptor, descriptor, loaded_models
from rig.bench import Bench
from rig.config import RigConfig
from rig.config.values import validate
from rig.core.errors import CatalogError, RigError, UsageError
from rig.core.files import json_values, read, write
from rig.events.events import Accepted, Event, Identified, Moved, Ranked, Started, event_dict, event_kind
from rig.search.earlier_runs import NOT_SAVED, upgraded
from rig.search.model import Model, empty_table_for, model_of
from rig.search.stopping_rules import FILE as STOPPING_RULE
from rig.search.stopping_rules import read_stopping_rule, write_stopping_rule
from rig.views import image_files as images

FORMAT: Final = "hbr-rig run"
VERSION: Final = 3
"""Version 2 brought the dense search; version 3 stores codes instead of sentences, and terms of the glossary."""
EMPTY_TABLE: Final = "empty_table.png"

MAX_FRAME_PIXELS: Final = 64_000_000
"""Of 8000 x 8000, the largest frame of the configuration."""
MAX_REASON: Final = 300
_MAX_BYTES: Final = {"run.json": 1_000_000, "model.jsonl": 32_000_000, "events.jsonl": 10_000_000}
"""Far above those of real runs. Values of JSON can need twenty times as much memory as their text."""
_DAMAGE: Final = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, cv2.error)
"""What values of the wrong kind raise."""

_KINDS: Final[dict[str, type]] = {event_kind(kind): kind for kind in get_args(Event)}


class RunWriter:
    """Keeps one retrieval while it runs: what has been seen of it is in the folder, wherever it ends.

    Parameters
    ----------
    folder
        New or empty; missing folders above it are made.
    bench
        The bench that the retrieval runs on.
    model : Model or hbr.ViewIndex
        What is enrolled.
    empty_table : uint8 array (H, W, 3), optional
        As `rig.plans.identify.identify` is given it.

    Raises
    ------
    UsageError
        The folder holds something already, or cannot be written to.
    """

    def __init__(
        self,
        folder: Path,
        bench: Bench,
        model: Model | hbr.ViewIndex,
        *,
        empty_table: NDArray[np.uint8] | None = None,
    ) -> None:
        self._folder = folder
        model = Model(model) if isinstance(model, hbr.ViewIndex) else model
        views = model.views
        kind = descriptor(views.descriptor)
        started_utc = bench.clock.utc().isoformat()
        try:
            (folder / "frames").mkdir(parents=True, exist_ok=True)
            if len(list(folder.iterdir())) > 1:
                raise UsageError(
                    f"The folder {folder} is not empty.", next_step="Give a new folder for each run with --save-run."
                )
            write(folder / "model.jsonl", "".join(_model_lines(views)).encode())
            if model.rule is not None and isinstance(model.index, hbr.DenseIndex):
                write_stopping_rule(folder / STOPPING_RULE, model.rule, model.index, made_utc=started_utc)
            if empty_table is None:
                empty_table, _ = empty_table_for(bench, model)
            if empty_table is not None:
                write(folder / EMPTY_TABLE, images.encode(empty_table))
            about = {
                "format": FORMAT,
                "version": VERSION,
                "software": f"hbr-rig {version('hbr-rig')}",
                "started_utc": started_utc,
                "bench": bench.name,
                "devices": bench.devices(),
                "conditions": dict(bench.conditions),
                "findings": list(bench.findings),
                "descriptor": {"name": kind.name, "version": kind.version},
                "config": bench.config.model_dump(mode="json"),
            }
            write(folder / "run.json", (json.dumps(about, indent=2, default=str) + "\n").encode())
            self._events: TextIO = (folder / "events.jsonl").open("x", encoding="utf-8")
        except OSError as error:
            raise _not_writable(folder, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, RigError):
            self._line(error.as_dict())
        self.close()

    def close(self) -> None:
        self._events.close()

    def add(self, event: Event) -> None:
        """Take the next event of the stream; a frame is in the folder before its event.

        Raises
        ------
        UsageError
            The disk is full or fails.
        """
        try:
            if isinstance(event, Accepted):
                write(frame_path(self._folder, event.index), images.encode(event.image_bgr))
            self._line(event_dict(event))
        except OSError as error:
            raise _not_writable(self._folder, error) from error

    def _line(self, value: dict[str, Any]) -> None:
        self._events.write(json.dumps(value, ensure_ascii=False, allow_nan=False, default=str) + "\n")
        self._events.flush()


@dataclass(frozen=True, slots=True)
class SavedRun:
    """A run as its folder has it.

    Attributes
    ----------
    folder
        Where it is.
    about
        Bench, devices, conditions and software, as JSON values.
    config
        The settings it ran under.
    model : Model
        The enrolled views, and the rules, that it was decided by.
    empty_table : uint8 array (H, W, 3), or None
        The bench without an object.
    error
        What ended it, where that was an error, as `RigError.as_dict` tells it.
    is_cut
        Whether the last line of the events was cut off while it was written.
    """

    folder: Path
    about: dict[str, Any]
    config: RigConfig
    model: Model
    empty_table: NDArray[np.uint8] | None
    error: dict[str, Any] | None
    is_cut: bool
    _lines: tuple[dict[str, Any], ...]

    @property
    def views(self) -> hbr.Views:
        """The enrolled views it was decided by."""
        return self.model.views

    def events(self) -> Iterator[Event]:
        """Yield the events in their order, frames included.

        Raises
        ------
        UsageError
            An event is none that this program knows, or a frame is missing.
        """
        for number, line in enumerate(self._lines, 1):
            try:
                event = event_of(line if self.is_current else upgraded(line), self._frame)
                _check_event(event)
            except _DAMAGE as error:
                raise _damaged(self.folder, f"events.jsonl, line {number}: {_reason(error)}") from error
            yield event

    @contextmanager
    def damage(self) -> Iterator[None]:
        """Report errors of a computation with the run's values as damage of the run, in a ``with`` block.

        Values can have the right types and still not fit together, such as a list of candidates that is empty.

        Raises
        ------
        UsageError
            The values do not fit together.
        """
        try:
            yield
        except _DAMAGE as error:
            raise _damaged(self.folder, f"its values do not fit together: {_reason(error)}") from error

    @property
    def started(self) -> Started:
        """How the run began.

        Raises
        ------
        UsageError
            It does not say.
        """
        first = next(self.events(), None)
        if not isinstance(first, Started):
            raise _damaged(self.folder, "events.jsonl does not begin with the event started")
        return first

    def not_saved(self, event: Event) -> tuple[str, ...]:
        """Return the fields of an event that the run's format does not have."""
        return () if self.is_current else NOT_SAVED.get(type(event), ())

    @property
    def is_current(self) -> bool:
        """Whether the run has the format of this version."""
        return bool(self.about["version"] == VERSION)

    def _frame(self, index: int) -> NDArray[np.uint8]:
        frame = _image(self.folder, frame_path(self.folder, index))
        x, y, width, height = self.config.view.roi or (0, 0, 0, 0)
        if x + width > frame.shape[1] or y + height > frame.shape[0]:
            raise ValueError(f"frame {index} has {frame.shape[1]} x {frame.shape[0]} pixels, less than the region")
        return frame


def load_run(folder: Path) -> SavedRun:
    """Read a saved run; a last event that was cut off while it was written is left out.

    Raises
    ------
    UsageError
        The folder holds no run, a damaged one, or one of a newer version; or the run needs a model that is not loaded
        (`hbr.descriptors.load_model`).
    """
    try:
        about = json_values(_bytes(folder, "run.json"))
        if about.get("format") != FORMAT:
            raise ValueError("run.json is not that of a saved run")
        if about["version"] not in range(1, VERSION + 1):
            raise UsageError(
                f"The run {folder} has the format version {about['version']}; this program reads 1 to {VERSION}.",
                next_step="Use the program that saved it, or a newer one.",
            )
        if not all(isinstance(about[key], str) for key in ("bench", "software", "started_utc")):
            raise TypeError("bench, software or started_utc in run.json is not text")
        if not isinstance(about["devices"], dict):
            raise TypeError("devices in run.json is not an object")
        kind = _descriptor(folder, about["descriptor"])
        config = validate(RigConfig, about["config"], where=str(folder / "run.json"))
        views = _views((_object(line) for line in _lines(_bytes(folder, "model.jsonl"))), kind.name)
        stored = read_stopping_rule(folder)
        model = model_of(views, rule=None if stored is None else stored.adapted(views))
        empty_table = _image(folder, folder / EMPTY_TABLE) if (folder / EMPTY_TABLE).exists() else None
        content = _bytes(folder, "events.jsonl")
        is_cut = bool(content) and not content.endswith(b"\n")
        lines = [_object(line) for line in _lines(content)[: -1 if is_cut else None]]
        failed = lines.pop() if lines and "event" not in lines[-1] else None
        if failed is not None and not {"code", "error", "what"} <= failed.keys():
            raise ValueError("the last line of events.jsonl is neither an event nor an error")
    except CatalogError as error:
        raise _damaged(folder, f"{error.what}: {error.evidence['reason']}") from error
    except _DAMAGE as error:
        raise _damaged(folder, _reason(error)) from error
    return SavedRun(folder, about, config, model, empty_table, failed, is_cut, tuple(lines))


def frame_path(folder: Path, index: int) -> Path:
    """Return where the frame of an accepted view is kept."""
    return folder / "frames" / f"{index:03d}.png"


def event_of(values: dict[str, Any], frame: Any) -> Event:
    """Return the event that `event_dict` made ``values`` of; ``frame`` gives the picture of an accepted view.

    Numbers that were not finite come back as nan: what they were is not known.

    Raises
    ------
    LookupError, TypeError, ValueError, ArithmeticError
        It is no event, or its fields are not those of its kind.
    """
    values = dict(values)
    name = values.pop("event")
    if name not in _KINDS:
        raise ValueError(f"there is no event {name!r}")
    if name == "accepted":
        values["image_bgr"] = frame(values["index"])
    event: Event = built(_KINDS[name], values)
    return event


def built(kind: Any, value: Any) -> Any:
    """Return JSON values as the type that is meant; fields that a newer program added are left out."""
    origin = get_origin(kind)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        given = {f.name: built(hints[f.name], value[f.name]) for f in fields(kind) if f.name in value}
        return kind(**given)  # type: ignore[operator]
    if origin in (Union, UnionType):
        if value is None and NoneType in get_args(kind):
            return None
        return built(next(k for k in get_args(kind) if k is not NoneType), value)
    if origin is tuple:
        items = get_args(kind)
        return tuple(built(items[0] if items[-1] is Ellipsis else items[i], item) for i, item in enumerate(value))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(value)
    if kind is float:
        if value is None:
            return nan
        if type(value) not in (int, float) or not isfinite(value):
            raise TypeError(f"{value!r} is no finite number")
        return float(value)
    if kind in (str, bool, int) and type(value) is not kind:
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return value


def _model_lines(views: hbr.Views) -> Iterator[str]:
    pack = descriptor(views.descriptor).pack
    for number, name in enumerate(views.object_names):
        rows = views.of(number)
        line = {
            "object": name,
            "azimuth_deg": views.azimuth_deg[rows].tolist(),
            "descriptors": [pack(levels).hex() for levels in views.descriptors[rows]],
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


def _descriptor(folder: Path, used: dict[str, Any]) -> Descriptor:
    """Return the descriptor of a run. A network is known by its digest: the path of its file is the user's to give."""
    name, number = used["name"], used["version"]
    if name.startswith(PREFIX):
        for model in loaded_models():
            if model.name == name or (model.version == number and not MODEL_NAME.fullmatch(name)):  # earlier: a path
                return model
        raise UsageError(
            f"The run {folder} needs the model {name}.",
            next_step="Give the ONNX file with this SHA-256: --model FILE.",
            evidence={"CRC-32": number},
        )
    kind = descriptor(name)
    if number != kind.version:
        raise ValueError(f"it was described by {name} {number}, which this program does not have")
    return kind


def _check_event(event: Event) -> None:
    """Check the values that a search computes with; those of other events are only shown."""
    if isinstance(event, Accepted) and not isfinite(event.azimuth_deg):
        raise ValueError("the azimuth is not a number")
    if isinstance(event, Moved) and not isfinite(event.encoder_deg):
        raise ValueError("the table angle is not a number")
    if isinstance(event, Started) and event.seed is not None and event.seed < 0:
        raise ValueError("the seed is negative")
    if isinstance(event, Ranked | Identified) and not event.candidates:
        raise ValueError("there are no candidates")


def _image(folder: Path, path: Path) -> NDArray[np.uint8]:
    image = images.decode(_bytes(folder, str(path.relative_to(folder))), max_pixels=MAX_FRAME_PIXELS)
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise ValueError(f"{path.name} has {image.shape[1]} x {image.shape[0]} pixels")
    return image


def _lines(content: bytes) -> list[str]:
    """Return the lines of JSON Lines; only a line feed ends a line, and the last line may lack it."""
    return content.decode().removesuffix("\n").split("\n") if content else []


def _object(line: str) -> dict[str, Any]:
    values = json_values(line)
    if not isinstance(values, dict):
        raise TypeError("a line is no JSON object")
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
            next_step="Give a folder that rig identify --save-run has written.",
            evidence={"reason": getattr(error, "strerror", None) or str(error)},
        ) from error


def _reason(error: Exception) -> str:
    """Return what an error says about a value; that of a KeyError is only the key."""
    text = str(error) if type(error) in (ValueError, TypeError) else f"{type(error).__name__}: {error}"
    return text if len(text) <= MAX_REASON else f"{text[:MAX_REASON]}…"


def _damaged(folder: Path, reason: str) -> UsageError:
    return UsageError(
        f"The run in {folder} cannot be read.",
        next_step="Take it from a backup, or look at its files: they are PNG and JSON Lines.",
        evidence={"reason": reason},
    )


def _not_writable(folder: Path, error: OSError) -> UsageError:
    return UsageError(
        f"The run cannot be saved in {folder}.",
        next_step="Give a new folder, on a disk with space, with --save-run.",
        evidence={"reason": error.strerror or str(error)},
    )
