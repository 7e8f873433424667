"""The findings of `rig catalog verify` in words."""

from typing import Final

from rig.catalog.verify import Finding, Problem

_EVIDENCE: Final = {
    Problem.DAMAGED_DATABASE: "{message}",
    Problem.LOG_CHANGED: "entry {entry_id} of the log is not the one that was written, or one before is missing",
    Problem.ENROLLMENT_CHANGED: "something in enrollment {enrollment_id} is not what was stored",
    Problem.MISSING_ENROLLMENT: "enrollment {enrollment_id} is in the log, and this program did not remove it",
    Problem.MISSING_IMAGE: "{reason}",
    Problem.CHANGED_IMAGE: "{bytes} bytes now, {stored_bytes} when it was stored",
    Problem.DESCRIPTION_DAMAGED: "the stored {descriptor} is not the one that was computed",
}


def finding_text(finding: Finding) -> str:
    """Return a finding in one line: the problem, the object and the file, the evidence, and what to do."""
    place = ": ".join(text for text in (finding.object_name and repr(finding.object_name), finding.path) if text)
    what = f"{finding.problem}: {place}" if place else str(finding.problem)
    return f"{what}; {_EVIDENCE[finding.problem].format_map(finding.details)}; {_fix(finding)}"


def _fix(finding: Finding) -> str:
    match finding.problem:
        case Problem.DESCRIPTION_DAMAGED:
            return "it is computed again when it is needed"
        case Problem.ENROLLMENT_CHANGED | Problem.MISSING_ENROLLMENT:
            return "restore the catalog from a backup, or delete the object and enroll it again"
        case Problem.MISSING_IMAGE | Problem.CHANGED_IMAGE if finding.object_name:
            return "restore it from a backup, or enroll the object again: rig enroll --replace"
        case _:
            return "restore it from a backup"
