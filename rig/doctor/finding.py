"""The findings of `rig doctor` and `rig find`. A check words each where it finds it, as errors are worded."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from typing import Any

from rig.core.errors import RigError
from rig.core.masking import masked
from rig.core.next_steps import NextSteps, SomeSteps, as_steps, in_words
from rig.core.phrases import filled


class Severity(StrEnum):
    """The severity of a finding: no problem, a possible problem, or a problem that prevents work."""

    FINE = "fine"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about the bench."""

    level: Severity
    """Its severity."""
    code: str
    """What was found: ``no_servo``. It is unique among those of a topic."""
    words: str
    """The same for people."""
    steps: NextSteps = ()
    """What fixes the problem, as the next step of an error; empty if nothing does."""
    evidence: Mapping[str, Any] = field(default_factory=dict)
    """The values in its text and other evidence, units in the keys."""
    topic: str = ""
    """The checked part, for example ``servo``."""
    exit_code: int = 0
    """The exit code of `rig doctor` for this finding; 0 unless it is bad. Topic and exit code come from the check."""

    @property
    def fix(self) -> str:
        """What fixes the problem, as a terminal shows it."""
        return in_words(self.steps)

    @property
    def reported(self) -> dict[str, Any]:
        """The finding as `--json` and the server give it."""
        found = {"topic": self.topic, "level": self.level, "code": self.code, "finding": self.words}
        return {**found, "fix": self.fix or None, "steps": self.steps, "evidence": _as_json(self.evidence)}


def finding(level: Severity, code: str, text: str, fix: SomeSteps = (), /, **evidence: Any) -> Finding:
    """Return a finding; ``text`` is a template of its evidence, and ``fix`` is what solves the problem."""
    known = masked(evidence)
    words = filled(text, **{key: _listed(value) for key, value in known.items()})
    return Finding(level, code, words, as_steps(fix), known)


fine, warning, bad = (partial(finding, level) for level in Severity)


def graded(
    code: str, text: str, fix: SomeSteps, /, *, is_bad: bool = False, is_warning: bool = False, **evidence: Any
) -> Finding:
    """Return a finding whose severity depends on a limit; it has the ``fix`` unless it is fine."""
    level = Severity.BAD if is_bad else Severity.WARNING if is_warning else Severity.FINE
    return finding(level, code, text, () if level is Severity.FINE else fix, **evidence)


def of_error(error: RigError, fix: SomeSteps = ()) -> Finding:
    """Return an error as a finding; its evidence ``error_code`` is the code of the error."""
    reason = error.evidence.get("reason")
    what = f"{error.what.rstrip('.')}: {reason}" if reason else error.what
    found = bad("error", "{what}", fix or error.steps, **{**error.evidence, "what": what, "error_code": error.code})
    return replace(found, exit_code=error.exit_code)


def _listed(value: Any) -> Any:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list | tuple) else "?" if value is None else value


def _as_json(value: Any) -> Any:
    """Return a value as JSON can have it; devices and dates as text."""
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _as_json(item) for key, item in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
