"""What an examination says: one finding a line, and one command that mends it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from rig.core.errors import RigError


class Level(StrEnum):
    """How bad it is: nothing to do, something to look at, something that stops the work."""

    FINE = "fine"
    WARNING = "warning"
    BAD = "bad"


MARKS = {Level.FINE: "✓", Level.WARNING: "!", Level.BAD: "✗"}


@dataclass(frozen=True, slots=True)
class Finding:
    """One fact about the bench.

    Attributes
    ----------
    topic
        What was looked at: ``servo``.
    level
        How bad it is.
    text
        What was found, with its numbers.
    mend
        The one command, or act of the hands, that mends it; empty where there is nothing to mend.
    exit_code
        What `rig doctor` ends with because of it, 0 unless the finding is bad.
    evidence
        The numbers, units in the keys.
    """

    topic: str
    level: Level
    text: str
    mend: str = ""
    exit_code: int = 0
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return {
            "topic": self.topic,
            "level": str(self.level),
            "finding": self.text,
            "mend": self.mend or None,
            "evidence": dict(self.evidence),
        }


def fine(topic: str, text: str, **evidence: Any) -> Finding:
    return Finding(topic, Level.FINE, text, evidence=evidence)


def warning(topic: str, text: str, mend: str, **evidence: Any) -> Finding:
    return Finding(topic, Level.WARNING, text, mend, evidence=evidence)


def bad(topic: str, text: str, mend: str, exit_code: int = 4, **evidence: Any) -> Finding:
    return Finding(topic, Level.BAD, text, mend, exit_code, evidence)


def of_error(topic: str, error: RigError, mend: str = "") -> Finding:
    """Return an error of the registry as a finding."""
    reason = error.evidence.get("reason")
    text = f"{error.what.rstrip('.')}: {reason}" if reason else error.what
    return Finding(topic, Level.BAD, text, mend or error.next_step, error.exit_code, error.evidence)
