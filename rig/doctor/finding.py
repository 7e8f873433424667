"""What an examination says: one finding a line, and one command that fixes it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from rig.core.errors import RigError


class Severity(StrEnum):
    """How bad it is: nothing to do, something to look at, something that stops the work."""

    FINE = "fine"
    WARNING = "warning"
    BAD = "bad"


MARKS = {Severity.FINE: "✓", Severity.WARNING: "!", Severity.BAD: "✗"}


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
    fix
        The one command, or act of the hands, that fixes it; empty where there is nothing to fix.
    exit_code
        What `rig doctor` ends with because of it, 0 unless the finding is bad.
    evidence
        The numbers, units in the keys.
    """

    topic: str
    level: Severity
    text: str
    fix: str = ""
    exit_code: int = 0
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return {
            "topic": self.topic,
            "level": str(self.level),
            "finding": self.text,
            "fix": self.fix or None,
            "evidence": dict(self.evidence),
        }


def fine(topic: str, text: str, **evidence: Any) -> Finding:
    return Finding(topic, Severity.FINE, text, evidence=evidence)


def warning(topic: str, text: str, fix: str, **evidence: Any) -> Finding:
    return Finding(topic, Severity.WARNING, text, fix, evidence=evidence)


def bad(topic: str, text: str, fix: str, exit_code: int = 4, **evidence: Any) -> Finding:
    return Finding(topic, Severity.BAD, text, fix, exit_code, evidence)


def of_error(topic: str, error: RigError, fix: str = "") -> Finding:
    """Return an error of the registry as a finding."""
    reason = error.evidence.get("reason")
    text = f"{error.what.rstrip('.')}: {reason}" if reason else error.what
    return Finding(topic, Severity.BAD, text, fix or error.next_step, error.exit_code, error.evidence)
