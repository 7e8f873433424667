"""The findings of `rig catalog verify` in words."""

from typing import Final

from rig.catalog.verify_images import Finding, Problem

_EVIDENCE: Final = {
    Problem.DAMAGED_DATABASE: "SQLite reports: {message}",
    Problem.ORPHANED_ROW: "a row of {table} refers to a missing row of {parent}: {row}",
    Problem.MISSING_IMAGE: "{reason}",
    Problem.UNREADABLE_IMAGE: "{reason}",
    Problem.CHANGED_IMAGE: "{bytes} bytes now, {stored_bytes} when it was stored",
    Problem.SIZES_DIFFER: "{size_px[0]} x {size_px[1]} pixels, the first view of its enrollment has "
    "{first_size_px[0]} x {first_size_px[1]}",
    Problem.OBJECT_CHANGED: "its name, label, note or dates are not those that were stored",
    Problem.ENROLLMENT_CHANGED: "something in enrollment {enrollment_id} is not what was stored",
    Problem.LOG_CHANGED: "entry {entry_id} of the log is not the one that was written, or one before is missing",
    Problem.RESULT_CHANGED: "row {entry_id} of {table} is not the one that was written, or is missing",
    Problem.SETTING_CHANGED: "the {setting} is {found}, not {stored}",
    Problem.DESCRIPTOR_DIFFERS: "the stored {descriptor} is not that of the image",
}
_BACKUP: Final = "restore it from a backup"


def finding_text(finding: Finding) -> str:
    """Return a finding in one line: the problem, the object and the file, the evidence, and the fix."""
    place = ": ".join(text for text in (finding.object_name and repr(finding.object_name), finding.path) if text)
    what = f"{finding.problem}: {place}" if place else str(finding.problem)
    evidence = _EVIDENCE.get(finding.problem, "").format_map(finding.details)
    fix = f"repaired: {finding.repair}" if finding.repair else _fix(finding)
    return "; ".join(part for part in (what, evidence, fix) if part)


def _fix(finding: Finding) -> str:
    match finding.problem:
        case Problem.OBJECT_CHANGED | Problem.ENROLLMENT_CHANGED:
            return "restore the database from a backup, or delete the object and enroll it again"
        case Problem.DAMAGED_DATABASE | Problem.LOG_CHANGED | Problem.RESULT_CHANGED | Problem.SETTING_CHANGED:
            return _BACKUP
        case Problem.MISSING_IMAGE | Problem.CHANGED_IMAGE:
            if copy := finding.details["copy"]:
                return f"to restore it from {copy}: rig catalog verify --repair"
            return f"{_BACKUP}, or enroll the object again: rig enroll --replace" if finding.object_name else _BACKUP
        case Problem.UNREADABLE_IMAGE | Problem.SIZES_DIFFER:
            return "enroll the object again: rig enroll --replace" if finding.object_name else "nothing can be done"
        case Problem.NOT_DESCRIBED:
            return "describe it: rig catalog redescribe"
        case _:
            return "to repair it: rig catalog verify --repair"
