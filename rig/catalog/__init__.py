"""The catalog of enrolled objects: facts in a database, and the images as files beside it."""

from rig.catalog.catalog import Catalog, OpenEnrollment
from rig.catalog.facts import Action, Enrollment, Entry, Session, View
from rig.catalog.records import EnrollmentStatus, Provenance, RecordedOutcome, clean_name
from rig.catalog.state import EnrollmentState, ObjectDetails, ObjectSummary

__all__ = [
    "Action",
    "Catalog",
    "Enrollment",
    "EnrollmentState",
    "EnrollmentStatus",
    "Entry",
    "ObjectDetails",
    "ObjectSummary",
    "OpenEnrollment",
    "Provenance",
    "RecordedOutcome",
    "Session",
    "View",
    "clean_name",
]
