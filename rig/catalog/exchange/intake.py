"""Into a catalog: images are checked and described aside, then all of it comes in at once."""

import shutil
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

from sqlalchemy import Connection, insert, select, update

from rig.catalog import audit, images
from rig.catalog.catalog import Catalog
from rig.catalog.database import insert_row
from rig.catalog.describing import known_descriptor, settings_of, within
from rig.catalog.exchange.package import Enrollment, Gap, ImageSource, Object, Package, Refused
from rig.catalog.jobs import Progressed, portions, processes
from rig.catalog.records import EnrollmentStatus, Region
from rig.catalog.schema import DESCRIPTOR, descriptors, enrollments, objects, sittings, views
from rig.catalog.staging import staging
from rig.catalog.upkeep import LOST
from rig.errors import ImportRefused, ObjectExists, UsageError
from rig.files import make_folder, sync_folder, sync_tree
from rig.processes import over_processes


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


@dataclass(frozen=True, slots=True)
class Imported:
    """What came in, what was refused, and which views lack."""

    objects: int
    views: int
    bytes: int
    skipped: tuple[str, ...]
    replaced: tuple[str, ...]
    refused: tuple[Refused, ...]
    gaps: tuple[Gap, ...]


class _Item(NamedTuple):
    """An image to be staged; ``image`` is its name in the package."""

    image: str
    source: ImageSource
    sha256: str | None
    folder: str
    stem: str
    describe: bool = False
    region: Region | None = None


class _Staged(NamedTuple):
    """An image that is staged as ``file``, or the reason why not."""

    file: str
    sha256: str = ""
    size: int = 0
    packed: bytes | None = None
    reason: str = ""


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
            known = set(connection.scalars(select(objects.c.name).where(objects.c.deleted_utc.is_(None))))
    return _plan(package, conflict, known)


def _plan(package: Package, conflict: Conflict, known: set[str]) -> Plan:
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


def bring_in(
    catalog: Catalog, plan: Plan, *, label: str | None = None, strict: bool = False, jobs: int | None = None
) -> Generator[Progressed, None, Imported]:
    """Import what was planned, all of it or nothing.

    Images are copied and described aside by several processes; when every one is on the disk, one transaction takes
    them in. Whatever ends the call before that leaves the catalog as it was.

    Parameters
    ----------
    label
        For the new objects that have none.
    strict
        Refuse everything when one image is refused; a bundle is always taken like that.
    jobs
        Processes; one for each core otherwise.

    Raises
    ------
    ImportRefused
        Nothing is left to import, or an image was refused and all are wanted.
    ObjectExists
        Another process brought one of the objects in meanwhile.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    package = plan.package
    strict = strict or package.strict
    refused = list(package.refused)
    if strict and refused:
        raise _not_whole(package, refused)
    with catalog.database.in_words(), staging(catalog.path) as folder:
        items = list(_items(plan))
        staged: dict[str, _Staged] = {}
        yield Progressed(0, len(items))
        work = partial(_stage, folder)
        for portion, found in over_processes(work, portions(items), processes(jobs, len(items))):
            for item, one in zip(portion, found, strict=True):
                staged[item.image] = one
                if one.reason:
                    refused.append(Refused(item.image, one.reason))
            if strict and refused:
                raise _not_whole(package, refused)
            yield Progressed(len(staged), len(items))
        wanted = [kept for kept in (_without(item, staged) for item in plan.wanted) if kept.enrollments]
        if not wanted and items:
            raise _not_whole(package, refused)
        sync_tree(folder)
        _commit(catalog, plan, wanted, staged, folder, label)
    return Imported(
        len(wanted),
        sum(len(enrollment.views) for item in wanted for enrollment in item.enrollments),
        sum(one.size for one in staged.values()),
        plan.skipped,
        plan.replaced,
        tuple(refused),
        package.gaps,
    )


def rehearse(plan: Plan, *, strict: bool = False, jobs: int | None = None) -> Generator[Progressed, None, Imported]:
    """Look at every image that `bring_in` would take, and return what it would; nothing is written.

    Raises
    ------
    ImportRefused
        An image was refused and all are wanted.
    """
    package = plan.package
    refused = list(package.refused)
    items = list(_items(plan))
    size = done = 0
    yield Progressed(0, len(items))
    for portion, found in over_processes(partial(_stage, None), portions(items), processes(jobs, len(items))):
        for item, one in zip(portion, found, strict=True):
            size += one.size
            if one.reason:
                refused.append(Refused(item.image, one.reason))
        done += len(portion)
        yield Progressed(done, len(items))
    if refused and (strict or package.strict):
        raise _not_whole(package, refused)
    spoiled = {file.path for file in refused}
    left = [
        sum(view.image not in spoiled for enrollment in item.enrollments for view in enrollment.views)
        for item in plan.wanted
    ]
    return Imported(
        sum(count > 0 for count in left), sum(left), size, plan.skipped, plan.replaced, tuple(refused), package.gaps
    )


def _not_whole(package: Package, refused: list[Refused]) -> ImportRefused:
    return ImportRefused(
        f"{package.origin} is not taken: {len(refused)} of its files cannot be used; nothing was imported",
        next_step="mend or remove the files listed and import it again",
        evidence={"refused": [f"{file.path}: {file.reason}" for file in refused[:20]]},
    )


def _items(plan: Plan) -> Iterator[_Item]:
    sources = plan.package.sources
    for i, item in enumerate(plan.wanted):
        for j, enrollment in enumerate(item.enrollments):
            folder = f"{i}-{j}"
            for view in enrollment.views:
                yield _Item(
                    view.image,
                    sources[view.image],
                    view.image_sha256,
                    folder,
                    f"{view.index:03d}",
                    not view.descriptors,
                    plan.package.regions.get(view.image),
                )
            for k, sitting in enumerate(enrollment.sittings):
                image, sha256 = sitting.reference_image, sitting.reference_image_sha256
                if image is not None:
                    yield _Item(image, sources[image], sha256, folder, f"empty-{k:03d}")


def _stage(root: Path | None, portion: tuple[_Item, ...]) -> list[_Staged]:
    return [_stage_one(root, item) for item in portion]


def _stage_one(root: Path | None, item: _Item) -> _Staged:
    try:
        content = _read(item.source)
        image = images.decode(content)
    except images.BadImage as error:
        return _Staged("", reason=str(error))
    except (OSError, BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, zlib.error) as error:
        return _Staged("", reason=f"cannot be read: {error}")
    sha256 = images.digest(content)
    if item.sha256 is not None and sha256 != item.sha256:
        return _Staged("", reason="is not the image that was stored")
    if root is None:
        return _Staged("", sha256, len(content))
    packed = None
    if item.describe:
        kind = known_descriptor(DESCRIPTOR)
        try:
            packed = kind.pack(kind.describe(within(image, item.region)))
        except UsageError as error:
            return _Staged("", reason=error.what)
    folder = root / item.folder
    folder.mkdir(exist_ok=True)
    file = f"{item.folder}/{item.stem}{images.suffix(content)}"
    (root / file).write_bytes(content)
    return _Staged(file, sha256, len(content), packed)


def _read(source: ImageSource) -> bytes:
    if source.member is None:
        with Path(source.file).open("rb") as file:
            return file.read(images.MAX_FILE_BYTES + 1)
    with _archive(source.file).open(source.member) as member:
        return member.read(images.MAX_FILE_BYTES + 1)


@cache
def _archive(file: str) -> ZipFile:
    return ZipFile(file)


def _without(item: Object, staged: dict[str, _Staged]) -> Object:
    """The object without the views whose images were refused."""
    if not any(staged[view.image].reason for enrollment in item.enrollments for view in enrollment.views):
        return item
    kept = []
    for enrollment in item.enrollments:
        good = [view for view in enrollment.views if not staged[view.image].reason]
        if good:
            views_left = tuple(view.model_copy(update={"index": index}) for index, view in enumerate(good))
            planned = tuple(enrollment.planned_azimuth_deg[view.index] for view in good)
            kept.append(enrollment.model_copy(update={"views": views_left, "planned_azimuth_deg": planned}))
    return item.model_copy(update={"enrollments": tuple(kept)})


def _commit(
    catalog: Catalog, plan: Plan, wanted: list[Object], staged: dict[str, _Staged], folder: Path, label: str | None
) -> None:
    moved: list[tuple[Path, Path]] = []
    try:
        with catalog.database.write() as connection:
            known = set(connection.scalars(select(objects.c.name).where(objects.c.deleted_utc.is_(None))))
            _plan(plan.package, plan.conflict, known - set(plan.skipped))  # another process may have been faster
            for item in wanted:
                _insert(catalog, connection, item, plan, staged, folder, label, moved)
            for above in {target.parent for _, target in moved}:
                sync_folder(above)
            audit.append(
                connection,
                catalog.clock,
                "imported",
                origin=plan.package.origin,
                objects=[item.name for item in wanted],
                views=sum(len(enrollment.views) for item in wanted for enrollment in item.enrollments),
                replaced=list(plan.replaced),
            )
    except BaseException:
        for source, target in moved:
            target.rename(source)
        raise


def _insert(
    catalog: Catalog,
    connection: Connection,
    item: Object,
    plan: Plan,
    staged: dict[str, _Staged],
    folder: Path,
    label: str | None,
    moved: list[tuple[Path, Path]],
) -> None:
    object_id = connection.scalar(
        select(objects.c.id).where(objects.c.name == item.name, objects.c.deleted_utc.is_(None))
    )
    if object_id is None:
        object_id = insert_row(
            connection,
            objects,
            name=item.name,
            label=item.label or label or "",
            note=item.note,
            created_utc=item.created_utc,
        )
    else:
        _make_way(catalog, connection, object_id, {enrollment.status for enrollment in item.enrollments})
    for enrollment in item.enrollments:
        enrollment_id = insert_row(
            connection,
            enrollments,
            object_id=object_id,
            status=enrollment.status,
            started_utc=enrollment.started_utc,
            finished_utc=enrollment.finished_utc,
            planned_azimuth_deg=enrollment.planned_azimuth_deg,
        )
        target = images.folder(object_id, item.name, enrollment_id)
        names = [view.image for view in enrollment.views]
        names += [sitting.reference_image for sitting in enrollment.sittings if sitting.reference_image]
        if names:
            _move(catalog.path, folder / Path(staged[names[0]].file).parent, target, moved)
        _insert_views(connection, enrollment_id, enrollment, staged, target, plan.package.regions)


def _make_way(catalog: Catalog, connection: Connection, object_id: int, statuses: set[EnrollmentStatus]) -> None:
    """Have the enrollments that are in use superseded or abandoned where others come."""
    for before, after in (
        (EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED),
        (EnrollmentStatus.IN_PROGRESS, EnrollmentStatus.ABANDONED),
    ):
        if before in statuses:
            values: dict[str, Any] = {"status": after}
            if before == EnrollmentStatus.IN_PROGRESS:
                values["finished_utc"] = catalog.clock.utc()
            connection.execute(
                update(enrollments)
                .where(enrollments.c.object_id == object_id, enrollments.c.status == before)
                .values(values)
            )


def _move(root: Path, source: Path, target: Path, moved: list[tuple[Path, Path]]) -> None:
    make_folder((root / target).parent, within=root)
    if (root / target).exists():  # of an import that was killed in its last moment; no row knows it
        aside = root / LOST / target
        make_folder(aside.parent, within=root)
        shutil.rmtree(aside, ignore_errors=True)
        (root / target).rename(aside)
    source.rename(root / target)
    moved.append((source, root / target))


def _insert_views(
    connection: Connection,
    enrollment_id: int,
    enrollment: Enrollment,
    staged: dict[str, _Staged],
    target: Path,
    regions: dict[str, Region],
) -> None:
    sitting_ids = []
    for sitting in enrollment.sittings:
        values: dict[str, Any] = {}
        if sitting.reference_image is not None:
            one = staged[sitting.reference_image]
            values = {
                "reference_image": (target / Path(one.file).name).as_posix(),
                "reference_image_sha256": one.sha256,
                "reference_image_bytes": one.size,
            }
        sitting_ids.append(
            insert_row(
                connection,
                sittings,
                enrollment_id=enrollment_id,
                started_utc=sitting.started_utc,
                bench=sitting.bench,
                software=sitting.software,
                devices=sitting.devices,
                conditions=sitting.conditions,
                **values,
            )
        )
    rows = []
    for view in enrollment.views:
        one = staged[view.image]
        row = view.model_dump(exclude={"index", "sitting", "image", "image_sha256", "image_bytes", "descriptors"})
        rows.append(
            {
                **row,
                "enrollment_id": enrollment_id,
                "view_index": view.index,
                "sitting_id": sitting_ids[view.sitting],
                "image": (target / Path(one.file).name).as_posix(),
                "image_sha256": one.sha256,
                "image_bytes": one.size,
            }
        )
    if not rows:
        return
    connection.execute(insert(views), rows)
    ids = {
        index: view_id
        for view_id, index in connection.execute(
            select(views.c.id, views.c.view_index).where(views.c.enrollment_id == enrollment_id)
        )
    }
    kind = known_descriptor(DESCRIPTOR)
    described = []
    for view in enrollment.views:
        packed = staged[view.image].packed
        levels = [(d.name, d.version, d.settings, bytes.fromhex(d.packed)) for d in view.descriptors]
        if packed is not None:
            levels.append((kind.name, kind.version, settings_of(regions.get(view.image)), packed))
        described += [
            {"view_id": ids[view.index], "name": name, "version": version, "settings": settings, "packed": said}
            for name, version, settings, said in levels
        ]
    connection.execute(insert(descriptors), described)
