"""Plan an import: which objects are new, replace others, or are skipped."""

from collections.abc import Set
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import Connection, select

from rig.catalog.catalog import Catalog
from rig.catalog.exchange.batch import ImportBatch, Object
from rig.catalog.schema import objects
from rig.core.errors import ObjectExists
from rig.core.next_steps import Do


class Conflict(StrEnum):
    """What an import does with an object whose name is in the catalog already."""

    REJECT = "reject"
    SKIP = "skip"
    REPLACE = "replace"


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of an import: the names of the new, the replaced and the skipped objects."""

    batch: ImportBatch
    conflict: Conflict
    new: tuple[str, ...]
    replaced: tuple[str, ...]
    skipped: tuple[str, ...]

    @property
    def wanted(self) -> tuple[Object, ...]:
        """The objects to import."""
        return tuple(item for item in self.batch.objects if item.name not in self.skipped)


def plan_import(catalog: Catalog | None, batch: ImportBatch, conflict: Conflict = Conflict.REJECT) -> Plan:
    """Plan the import of a batch into a catalog; None is a catalog that does not exist yet.

    Raises
    ------
    ObjectExists
        Some objects are in the catalog already, and conflicts are rejected.
    """
    known: set[str] = set()
    if catalog is not None:
        with catalog.database.read() as connection:
            known = names_in_use(connection)
    return make_plan(batch, conflict, known)


def names_in_use(connection: Connection) -> set[str]:
    """Return the names of the objects in use."""
    return set(connection.scalars(select(objects.c.name).where(objects.c.deleted_utc.is_(None))))


def make_plan(batch: ImportBatch, conflict: Conflict, known: Set[str]) -> Plan:
    """Plan the import of a batch into a catalog with these names in use; see `plan_import`."""
    both = tuple(item.name for item in batch.objects if item.name in known)
    if both and conflict == Conflict.REJECT:
        raise ObjectExists(
            f"{len(both)} of {len(batch.objects)} objects {'is' if len(both) == 1 else 'are'} in the catalog already; "
            "nothing was imported.",
            next_step=(
                "To skip them,",
                Do.RUN_AGAIN(on_conflict="skip"),
                "To import them as new enrollments,",
                Do.RUN_AGAIN(on_conflict="replace"),
            ),
            evidence={"objects": list(both[:20])},
        )
    skipped, replaced = (both, ()) if conflict == Conflict.SKIP else ((), both)
    new = tuple(item.name for item in batch.objects if item.name not in known)
    return Plan(batch, conflict, new, replaced, skipped)
