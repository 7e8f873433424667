"""Reports: collected from the events of a plan, written as one self-contained HTML file."""

from rig.report.records import TILE, Correctness, Record, Truth
from rig.report.report import Meta, count_of, render_report, write_report

__all__ = ["TILE", "Correctness", "Meta", "Record", "Truth", "count_of", "render_report", "write_report"]
