"""Reports: collected from the events of a plan, written as one self-contained HTML file."""

from rig.report.contact_sheet import contact_sheet, thumbnail
from rig.report.page import Meta, render_report, write_report
from rig.report.records import EnrollmentRecord, IdentificationRecord, Truth

__all__ = [
    "EnrollmentRecord",
    "IdentificationRecord",
    "Meta",
    "Truth",
    "contact_sheet",
    "render_report",
    "thumbnail",
    "write_report",
]
