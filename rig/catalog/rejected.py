"""Files that an import cannot use, and why."""

from dataclasses import dataclass, field
from enum import Enum, unique
from typing import Any


@unique
class ImportProblem(Enum):
    """A reason why a file is not imported: the name is its code, the value the template of its text."""

    NOT_A_FILE = "is not a file"
    LINK_OUTSIDE = "is a link to a file outside the folder"
    NAME_PATTERN = "does not match the pattern {pattern}"
    SAME_AZIMUTH = "shows {name!r} from the same azimuth as {other}"
    INVALID_VALUE = "{error}"
    UNREADABLE = "cannot be read: {error}"
    INVALID_IMAGE = "cannot be used: {error}"
    OTHER_IMAGE = "is not the stored image"
    NOT_DESCRIBED = "cannot be described: {error}"


@dataclass(frozen=True, slots=True)
class Reason:
    """An `ImportProblem` with the values of its text."""

    code: ImportProblem
    values: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.code.value.format_map(self.values)


@dataclass(frozen=True, slots=True)
class RejectedFile:
    """A file that is not imported, and why."""

    path: str
    reason: Reason

    def as_json(self) -> dict[str, Any]:
        """Return the file with the code and the text of the reason."""
        code = self.reason.code.name.lower()
        return {"path": self.path, "code": code, "values": self.reason.values, "reason": str(self.reason)}
