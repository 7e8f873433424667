"""A finding of `rig doctor`: one line, and the fix for a problem."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from rig.core.errors import RigError


class Severity(StrEnum):
    """The severity of a finding: no problem, a possible problem, or a problem that prevents work."""

    FINE = "fine"
    WARNING = "warning"
    BAD = "bad"


MARKS = {Severity.FINE: "✓", Severity.WARNING: "!", Severity.BAD: "✗"}


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about the bench.

    Attributes
    ----------
    topic
        The checked part, for example ``servo``.
    level
        Its severity.
    text
        The finding, with its numbers.
    fix
        The command or the action that fixes the problem; empty if there is none.
    exit_code
        The exit code of `rig doctor` for this finding; 0 unless it is bad.
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
    """Return an error as a finding."""
    reason = error.evidence.get("reason")
    text = f"{error.what.rstrip('.')}: {reason}" if reason else error.what
    return Finding(topic, Severity.BAD, text, fix or error.next_step, error.exit_code, error.evidence)
