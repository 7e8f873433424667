"""What an import would do to a catalog."""

from collections.abc import Set
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import Connection, select

from rig.catalog.catalog import Catalog
from rig.catalog.exchange.package import Object, Package
from rig.catalog.schema import objects
from rig.core.errors import ObjectExists


class Conflict(StrEnum):
    """What to do about an object whose name is in the catalog already."""

    REFUSE = "refuse"
    SKIP = "skip"
    REPLACE = "replace"


@dataclass(frozen=True, slots=True)
class Plan:
    """What an import would do: objects that are new, that replace others, or are left out."""

    package: Package
    conflict: Conflict
    new: tuple[str, ...]
    replaced: tuple[str, ...]
    skipped: tuple[str, ...]

    @property
    def wanted(self) -> tuple[Object, ...]:
        """The objects that are to come in."""
        return tuple(item for item in self.package.objects if item.name not in self.skipped)


def plan_import(catalog: Catalog | None, package: Package, conflict: Conflict = Conflict.REFUSE) -> Plan:
    """Look which objects of a package are in the catalog already; None is a catalog that is yet to be made.

    Raises
    ------
    ObjectExists
        Some are, and conflicts are refused.
    """
    known: set[str] = set()
    if catalog is not None:
        with catalog.database.read() as connection:
            known = names_in_use(connection)
    return make_plan(package, conflict, known)


def names_in_use(connection: Connection) -> set[str]:
    """Return the names of the objects in use."""
    return set(connection.scalars(select(objects.c.name).where(objects.c.deleted_utc.is_(None))))


def make_plan(package: Package, conflict: Conflict, known: Set[str]) -> Plan:
    """Plan to bring a package into a catalog that has these names in use; see `plan_import`."""
    both = tuple(item.name for item in package.objects if item.name in known)
    if both and conflict == Conflict.REFUSE:
        raise ObjectExists(
            f"{len(both)} of the {len(package.objects)} objects are in the catalog already; nothing was imported",
            next_step="leave them out (--on-conflict skip), or take them as new enrollments (--on-conflict replace)",
            evidence={"objects": list(both[:20])},
        )
    skipped, replaced = (both, ()) if conflict == Conflict.SKIP else ((), both)
    new = tuple(item.name for item in package.objects if item.name not in known)
    return Plan(package, conflict, new, replaced, skipped)
