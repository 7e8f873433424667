"""The findings of `rig catalog verify` in words."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.catalog.verify_images import Finding


def finding_text(finding: "Finding") -> str:
    """Return a finding in one line: the problem, the object and the file, the evidence, and the fix."""
    place = ": ".join(text for text in (finding.object_name and repr(finding.object_name), finding.path) if text)
    parts = [f"{finding.problem}: {place}" if place else str(finding.problem), *_evidence(finding)]
    fix = f"repaired: {finding.repair}" if finding.repair else _fix(finding)
    return "; ".join(part for part in (*parts, fix) if part)


def _evidence(finding: "Finding") -> list[str]:
    from rig.catalog.verify_images import Problem

    details = finding.details
    match finding.problem:
        case Problem.DAMAGED_DATABASE:
            return [f"SQLite reports: {details['message']}"]
        case Problem.ORPHANED_ROW:
            return [f"a row of {details['table']} refers to a missing row of {details['parent']}: {details['row']}"]
        case Problem.MISSING_IMAGE | Problem.UNREADABLE_IMAGE:
            return [details["reason"]]
        case Problem.CHANGED_IMAGE:
            return [f"{details['bytes']} bytes now, {details['stored_bytes']} when it was stored"]
        case Problem.SIZES_DIFFER:
            size, first = ("{} x {}".format(*details[key]) for key in ("size_px", "first_size_px"))
            return [f"{size} pixels, the first view of its enrollment has {first}"]
        case Problem.OBJECT_CHANGED:
            return ["its name, label, note or dates are not those that were stored"]
        case Problem.ENROLLMENT_CHANGED:
            return [f"something in enrollment {details['enrollment_id']} is not what was stored"]
        case Problem.LOG_CHANGED:
            return [f"entry {details['entry_id']} of the log is not the one that was written, or one before is missing"]
        case Problem.RESULT_CHANGED:
            return [f"row {details['entry_id']} of {details['table']} is not the one that was written, or is missing"]
        case Problem.SETTING_CHANGED:
            return [f"the {details['setting']} is {details['found']}, not {details['stored']}"]
        case Problem.DESCRIPTOR_DIFFERS:
            return [f"the stored {details['descriptor']} is not that of the image"]
        case _:
            return []


def _fix(finding: "Finding") -> str:
    from rig.catalog.verify_images import Problem

    match finding.problem:
        case Problem.OBJECT_CHANGED | Problem.ENROLLMENT_CHANGED:
            return "restore the database from a backup, or delete the object and enroll it again"
        case Problem.DAMAGED_DATABASE | Problem.LOG_CHANGED | Problem.RESULT_CHANGED | Problem.SETTING_CHANGED:
            return "restore it from a backup"
        case Problem.MISSING_IMAGE | Problem.CHANGED_IMAGE:
            if copy := finding.details["copy"]:
                return f"to restore it from {copy}: rig catalog verify --repair"
            again = "restore it from a backup, or enroll the object again: rig enroll --replace"
            return again if finding.object_name else "restore it from a backup"
        case Problem.UNREADABLE_IMAGE | Problem.SIZES_DIFFER:
            return "enroll the object again: rig enroll --replace" if finding.object_name else "nothing can be done"
        case Problem.NOT_DESCRIBED:
            return "describe it: rig catalog redescribe"
        case _:
            return "to repair it: rig catalog verify --repair"
