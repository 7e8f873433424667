"""Reports: collected from the events of a plan, written as one self-contained HTML file."""

from rig.report.records import Correctness, EnrollmentRecord, IdentificationRecord, Truth
from rig.report.report import Meta, count_of, render_report, write_report

__all__ = [
    "Correctness",
    "EnrollmentRecord",
    "IdentificationRecord",
    "Meta",
    "Truth",
    "count_of",
    "render_report",
    "write_report",
]
