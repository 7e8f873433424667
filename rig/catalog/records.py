"""The records that the catalog stores and returns."""

import json
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import metadata
from typing import Any, Final

from rig.core.control_characters import has_control_characters
from rig.core.errors import UsageError
from rig.core.next_steps import Do

MAX_NAME_LENGTH: Final = 100  # longer: names do not fit tables and file names
MAX_VIEWS: Final = 10_000
"""Most views of one enrollment: one every 0.036°."""

JsonObject = Mapping[str, Any]
Region = tuple[int, int, int, int]
"""Part of an image: x, y, width, height in pixels."""


def is_region(value: Sequence[object]) -> bool:
    """Return whether these are x, y, width and height of a part of some image."""
    numbers = [number for number in value if type(number) is int]
    return len(numbers) == len(value) == 4 and min(numbers[:2]) >= 0 and min(numbers[2:]) >= 1


def is_plan(azimuths_deg: Sequence[float]) -> bool:
    """Return whether an enrollment can have views at these azimuths."""
    return 1 <= len(azimuths_deg) <= MAX_VIEWS and all(0 <= azimuth_deg < 360 for azimuth_deg in azimuths_deg)


class EnrollmentStatus(StrEnum):
    """State of an enrollment. Searches use the one complete enrollment of each object."""

    IN_PROGRESS = "in progress"
    COMPLETE = "complete"
    ABANDONED = "abandoned"
    SUPERSEDED = "superseded"


class RecordedOutcome(StrEnum):
    """Outcome of an identification."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


def this_software() -> str:
    """Return the name and version of this program."""
    try:
        return f"hbr-rig {metadata.version('hbr-rig')}"
    except metadata.PackageNotFoundError:
        return "hbr-rig, not installed"


@dataclass(frozen=True, slots=True)
class Provenance:
    """The bench, devices and settings that took a view.

    Raises `UsageError`: the devices or conditions are not JSON values.
    """

    bench: str
    devices: JsonObject
    """Identities of servo, IMU and camera (models, serials, firmware), as JSON values."""
    conditions: JsonObject = field(default_factory=dict)
    """Noise model, calibrations in force and settings, as JSON values."""
    software: str = field(default_factory=this_software)
    """Name and version of the program."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "devices", as_json(self.devices, "The identities of the devices"))
        object.__setattr__(self, "conditions", as_json(self.conditions, "The conditions"))


def clean_name(name: str) -> str:
    """Return the name of an object as the catalog stores and compares it: composed (NFC), without outer spaces.

    Raises `UsageError`: the name is empty, is longer than 100 characters or contains characters that cannot be printed.
    """
    cleaned = unicodedata.normalize("NFC", name).strip()
    if not cleaned:
        raise UsageError("The name of the object is empty.", next_step="Give a name, such as mug-white.")
    if not cleaned.isprintable():
        raise UsageError(
            f"The name {cleaned!r} contains characters that cannot be printed.", next_step="Remove them from the name."
        )
    if len(cleaned) > MAX_NAME_LENGTH:
        raise UsageError(
            f"The name has {len(cleaned)} characters; at most {MAX_NAME_LENGTH} are allowed.",
            next_step="Shorten the name and put the rest into the note.",
        )
    return cleaned


def check_text(text: str, what: str) -> None:
    """Raise `UsageError` for text that cannot be stored: bytes of another encoding, or control characters."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"The {what} {text!r} is not valid text.", next_step="Type it in UTF-8.") from error
    if has_control_characters(text):
        raise UsageError(
            f"The {what} {text!r} contains control characters.",
            next_step=("Remove them. Of an enrolled object,", Do.LABEL()),
        )


def checked_texts(label: str | None, note: str | None) -> dict[str, str]:
    """Return the texts of an object that are not None; a `UsageError` if one cannot be stored."""
    given = {key: text for key, text in (("label", label), ("note", note)) if text is not None}
    for key, text in given.items():
        check_text(text, key)
    return given


def as_json(values: JsonObject, what: str) -> dict[str, Any]:
    """Return the values as they will be read back from JSON. Numpy scalars become Python scalars."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(values), allow_nan=False, default=_scalar))
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{what} cannot be stored as JSON: {error}.",
            next_step="Use text, finite numbers, true, false, None, lists and mappings.",
        ) from error
    return plain


def _scalar(value: Any) -> object:
    if getattr(value, "ndim", None) == 0:
        return value.item()
    raise TypeError(f"{value!r} is of type {type(value).__name__}")
