"""Views of an enrolled object that are taken again: a new enrollment takes over the others and replaces the former.

Until the last view is taken, nothing is stored but images. Then one transaction adds the new enrollment and supersedes
the former one, so that an interruption at any time leaves the former one in use.

Decision: docs/decisions/0009.
"""

import secrets
from collections.abc import Collection
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rig.catalog.catalog import Catalog, new_session, store_image
from rig.catalog.describing import described, hold
from rig.catalog.facts import Action, Enrollment, Session, View
from rig.catalog.records import EnrollmentStatus, Provenance
from rig.catalog.state import EnrollmentState, ending
from rig.catalog.transfer import add_rows, digest, same_session, same_view
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do


@dataclass(eq=False)
class Retake:
    """Takes views as a `rig.catalog.OpenEnrollment` does; ``former`` is the enrollment whose others are taken over."""

    catalog: Catalog
    object_name: str
    former: Enrollment
    indices: tuple[int, ...]
    session: Session
    _taken: dict[int, tuple[View, bytes]] = field(default_factory=dict)
    _held: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        catalog: Catalog,
        name: str,
        indices: Collection[int],
        *,
        provenance: Provenance,
        empty_table: NDArray[np.uint8] | None = None,
    ) -> Self:
        """Begin to take the views with these indices again. The other values are as for `Catalog.begin`.

        Raises `ObjectNotFound`: there is no object of that name. `CatalogError`: it has no complete enrollment, or was
        not enrolled by a bench at rest. `UsageError`: it has no such views, or no other ones.
        """
        found = catalog.object(name)
        former, name = found.complete, found.summary.name
        if former is None:
            raise CatalogError(f"{name!r} has no complete enrollment.", next_step=Do.CONTINUE_ENROLLMENT(name=name))
        if any(view.commanded_deg is None for view in former.views):
            raise CatalogError(
                f"The views of {name!r} were not taken by a bench.", next_step=Do.ENROLL_AGAIN(name=name)
            )
        if any(view.evidence.get("motion") for view in former.views):  # the table does not stand where they were taken
            raise CatalogError(
                f"The views of {name!r} were taken in motion.", next_step=Do.ENROLL_AGAIN(name=name, fly=True)
            )
        count, wanted = len(former.views), tuple(sorted(set(indices)))
        if not wanted or not 0 <= wanted[0] <= wanted[-1] < count:
            raise UsageError(
                f"{name!r} has the views 1 to {count}.", next_step="Choose one of them.", evidence={"views": count}
            )
        if len(wanted) == count:
            raise UsageError(
                f"All views of {name!r} are to be taken again, so nothing shows that it stands as before.",
                next_step=Do.ENROLL_AGAIN(name=name),
            )
        return cls(catalog, name, former, wanted, new_session(catalog, len(former.sessions), provenance, empty_table))

    def add(self, view: View, image_bgr: NDArray[np.uint8], encoded: Future[bytes] | None = None) -> View:
        """Store the image of a view, as `OpenEnrollment.add`; the view itself waits for `finish`."""
        png = store_image(self.catalog, view, image_bgr, encoded)
        view.session = self.session.number
        self._taken[view.index] = view, png
        hold(self._held, view.image, image_bgr)
        return view

    def abandon(self) -> None:
        """Forget the views; the former enrollment stays in use."""
        self._taken.clear()

    def finish(self) -> None:
        """Describe all views together, and make the new enrollment the one that searches use, in one transaction.

        Raises `CatalogError`: the object was enrolled again or deleted meanwhile; nothing has changed.
        """
        database, clock, former = self.catalog.database, self.catalog.clock, self.former
        new = Enrollment(
            key="", object_id=0, started_utc=self.session.started_utc, planned_azimuth_deg=former.planned_azimuth_deg
        )
        new.sessions = [*map(same_session, former.sessions), self.session]
        taken = {index: view for index, (view, _) in self._taken.items()}
        new.views = [taken.get(view.index) or same_view(view) for view in former.views]
        digest(new, secrets.token_hex(32))
        described(database, new, self.object_name, held=self._held)
        with self.catalog.writing() as before:
            known = before.by_id(former.object_id)
            current = before.of_status(known, EnrollmentStatus.COMPLETE)
            if known.deleted or current is None or current.enrollment.key != former.key:
                raise CatalogError(
                    f"{self.object_name!r} was enrolled again or deleted while its views were taken.",
                    next_step="Look at its views, and begin again.",
                )
            for view, png in self._taken.values():
                if database.images.size(view.image) != len(png):  # `collect_garbage` removed it
                    database.images.put(png)
            add_rows(before.transaction, new, former.object_id)
            before.end_current(known, EnrollmentStatus.COMPLETE)
            columns = ending(EnrollmentState(new, EnrollmentStatus.COMPLETE, clock.utc()))
            columns["details"] |= {"taken_again": list(self.indices)}
            before.append(Action.ENROLLED, known.object_name, **columns)
