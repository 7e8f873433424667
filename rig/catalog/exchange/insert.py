"""Insert staged objects into a catalog in one transaction."""

import secrets
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sqlalchemy import Connection, select

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.database import insert_row
from rig.catalog.exchange.batch import Enrollment, Object
from rig.catalog.exchange.plan import Plan, make_plan, names_in_use
from rig.catalog.exchange.stage import StagedImage
from rig.catalog.places import image_file, lost_file, make_folder_within
from rig.catalog.queries import in_use
from rig.catalog.records import EnrollmentStatus, ImageFile, Provenance
from rig.catalog.rows import (
    NewView,
    abandon_unfinished,
    insert_session,
    insert_views,
    measured,
    supersede,
    unfinished_and_complete,
)
from rig.catalog.schema import enrollments, objects
from rig.catalog.seal import changing_enrollments, seal_enrollments, seal_objects
from rig.core.files import sync_folder
from rig.views import image_files as images


def insert_objects(
    catalog: Catalog,
    plan: Plan,
    wanted: Sequence[Object],
    staged: Mapping[str, StagedImage],
    folder: Path,
    label: str | None,
) -> None:
    """Insert the ``wanted`` objects of a plan and move their images from ``folder`` to their places; all or nothing.

    Raises
    ------
    ObjectExists
        Another process has inserted one of the objects since the plan was made.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    inserter = _Inserter(catalog, staged, folder, label)
    if not catalog.database.images.moves:
        inserter.copy_images()
    try:
        with catalog.database.write() as connection:
            # check again: another process may have inserted objects since the plan was made
            make_plan(plan.batch, plan.conflict, names_in_use(connection) - set(plan.skipped))
            for item in wanted:
                inserter.insert(connection, item)
            for parent in {target.parent for _, target in inserter.moved}:
                sync_folder(parent)
            audit.append(
                connection,
                catalog.clock,
                audit.Action.IMPORTED,
                origin=plan.batch.origin,
                objects=[item.name for item in wanted],
                views=sum(len(enrollment.views) for item in wanted for enrollment in item.enrollments),
                replaced=list(plan.replaced),
            )
    except BaseException:
        for source, target in inserter.moved:
            target.rename(source)
        raise


@dataclass
class _Inserter:
    """Inserts objects, and remembers which folders it has moved."""

    catalog: Catalog
    staged: Mapping[str, StagedImage]
    folder: Path
    label: str | None
    moved: list[tuple[Path, Path]] = field(default_factory=list)
    token: str = field(default_factory=lambda: secrets.token_hex(8))

    def insert(self, connection: Connection, item: Object) -> None:
        object_id = connection.scalar(select(objects.c.id).where(in_use(item.name)))
        if object_id is None:
            object_id = insert_row(
                connection,
                objects,
                name=item.name,
                label=item.label or self.label or "",
                note=item.note,
                created_utc=item.created_utc,
            )
            seal_objects(connection, [object_id])
        else:
            statuses = {enrollment.status for enrollment in item.enrollments}
            with changing_enrollments(connection, unfinished_and_complete(connection, object_id)):
                if EnrollmentStatus.COMPLETE in statuses:
                    supersede(connection, object_id)
                if EnrollmentStatus.IN_PROGRESS in statuses:
                    abandon_unfinished(connection, object_id, self.catalog.clock.utc())
        for enrollment in item.enrollments:
            self._insert_enrollment(connection, object_id, item.name, enrollment)

    def _insert_enrollment(self, connection: Connection, object_id: int, name: str, enrollment: Enrollment) -> None:
        columns = enrollment.model_dump(exclude={"sessions", "views"})
        enrollment_id = insert_row(connection, enrollments, object_id=object_id, **columns)
        target = images.folder(object_id, name, enrollment_id)
        names = [view.image for view in enrollment.views]
        names += [session.empty_table_image for session in enrollment.sessions if session.empty_table_image]
        if names:
            source = Path(self.staged[names[0]].file).parent
            if self.catalog.database.images.moves:
                self._move(self.folder / source, target)
            else:
                target = self._copied(source)
        session_ids = [
            insert_session(
                connection,
                enrollment_id,
                session.started_utc,
                Provenance(session.bench, session.devices, session.conditions, session.software),
                self._image_file(session.empty_table_image, target) if session.empty_table_image else None,
            )
            for session in enrollment.sessions
        ]
        new = []
        for view in enrollment.views:
            one = self.staged[view.image]
            columns = measured(view) | ({} if one.segmentation is None else {"segmentation": one.segmentation})
            packed = [*(bundled.as_packed() for bundled in view.descriptors), *one.packed]
            image = self._image_file(view.image, target)
            new.append(NewView(view.index, columns, session_ids[view.session], view.captured_utc, image, packed))
        insert_views(connection, enrollment_id, new)
        seal_enrollments(connection, [enrollment_id])

    def _image_file(self, name: str, target: Path) -> ImageFile:
        one = self.staged[name]
        return ImageFile((target / Path(one.file).name).as_posix(), one.sha256, one.size)

    def copy_images(self) -> None:
        """Store the images before the transaction: other benches do not wait for a slow store meanwhile.

        If the import fails after that, no row refers to them, and `rig catalog verify` finds them.
        """
        for source in sorted(self.folder.iterdir()):
            self.catalog.database.images.copy_in(source, self._copied(Path(source.name)).as_posix())

    def _copied(self, source: Path) -> Path:
        return Path(images.IMAGE_FOLDER, f"import-{self.token}", source)

    def _move(self, source: Path, target: Path) -> None:
        root = self.catalog.path
        place = image_file(root, target.as_posix())
        make_folder_within(root, place.parent)
        if place.exists():  # left by an import that was killed before its commit: no row refers to it
            aside = lost_file(root, target.as_posix())
            make_folder_within(root, aside.parent)
            shutil.rmtree(aside, ignore_errors=True)
            place.rename(aside)
        source.rename(place)
        self.moved.append((source, place))
