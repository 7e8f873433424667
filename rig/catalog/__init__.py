"""The catalog of enrolled objects: an SQLite file, and the images as files beside it."""

from rig.catalog.audit import Action, AuditEntry
from rig.catalog.catalog import Catalog
from rig.catalog.enrollment import Enrollment
from rig.catalog.queries import ModelSet
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ObjectDetails,
    ObjectSummary,
    Provenance,
    Session,
    StoredView,
    ViewRecord,
    clean_name,
)

__all__ = [
    "Action",
    "AuditEntry",
    "Catalog",
    "Enrollment",
    "EnrollmentStatus",
    "EnrollmentSummary",
    "ModelSet",
    "ObjectDetails",
    "ObjectSummary",
    "Provenance",
    "Session",
    "StoredView",
    "ViewRecord",
    "clean_name",
]
