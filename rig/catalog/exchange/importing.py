"""Import objects: check and describe their images in a staging folder, then insert all of them at once.

Decision: docs/decisions/0015.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rig.catalog.catalog import Catalog
from rig.catalog.describing import known_descriptor
from rig.catalog.exchange.batch import Gap, Object, RejectedFile
from rig.catalog.exchange.insert import insert_objects
from rig.catalog.exchange.plan import Plan
from rig.catalog.exchange.stage import StagedImage, items_of, stage
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.staging import staging
from rig.core.errors import ImportRejected
from rig.core.files import sync_tree
from rig.core.processes import Jobs, map_in_processes


@dataclass(frozen=True, slots=True)
class Imported:
    """Result of an import: what was imported, what was rejected, and which views are missing."""

    objects: int
    views: int
    bytes: int
    skipped: tuple[str, ...]
    replaced: tuple[str, ...]
    rejected: tuple[RejectedFile, ...]
    gaps: tuple[Gap, ...]


def import_objects(
    catalog: Catalog,
    plan: Plan,
    *,
    label: str | None = None,
    descriptors: Sequence[str] = (),
    strict: bool = False,
    jobs: Jobs | None = None,
) -> Generator[JobProgress, None, Imported]:
    """Import the objects of a plan, all or nothing.

    Several processes copy the images into a staging folder and describe them. When all are on the disk, one transaction
    inserts them. If the call ends before that, the catalog is unchanged.

    Parameters
    ----------
    label
        Label of new objects that have none.
    descriptors
        Descriptors (`hbr.descriptors`) to compute besides CEDD, for views without descriptors.
    strict
        Import nothing if one image is rejected. This is always so for a bundle.
    jobs
        Number of processes, or a cluster; None for one process per core.

    Raises
    ------
    UsageError
        There is no such descriptor.
    ImportRejected
        Nothing is left to import, or an image was rejected and the import is strict.
    ObjectExists
        Another process has inserted one of the objects since the plan was made.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    for name in descriptors:
        known_descriptor(name)
    strict = strict or plan.batch.strict
    if strict and plan.batch.rejected:
        raise _import_error(plan, plan.batch.rejected)
    with catalog.database.catalog_errors(), staging(catalog.path) as folder:
        staged = yield from _stage_all(plan, folder, tuple(descriptors), strict, jobs)
        result, wanted = _result(plan, staged)
        if staged and not wanted:
            raise _import_error(plan, result.rejected)
        sync_tree(folder)
        insert_objects(catalog, plan, wanted, staged, folder, label)
    return result


def preview_import(
    plan: Plan, *, strict: bool = False, jobs: Jobs | None = None
) -> Generator[JobProgress, None, Imported]:
    """Check every image of a plan, and return what `import_objects` would return. Nothing is written.

    Raises
    ------
    ImportRejected
        An image was rejected and the import is strict.
    """
    staged = yield from _stage_all(plan, None, (), False, jobs)
    result, _ = _result(plan, staged)
    if result.rejected and (strict or plan.batch.strict):
        raise _import_error(plan, result.rejected)
    return result


def _stage_all(
    plan: Plan, folder: Path | None, descriptors: tuple[str, ...], strict: bool, jobs: Jobs | None
) -> Generator[JobProgress, None, dict[str, StagedImage]]:
    """Stage the images of a plan and return them by name; ``strict`` ends at the first portion with a rejected one."""
    items = list(items_of(plan, descriptors))
    staged: dict[str, StagedImage] = {}
    yield JobProgress(0, len(items))
    for portion, found in map_in_processes(partial(stage, folder), portions(items), processes(jobs, len(items))):
        staged.update(zip((item.image for item in portion), found, strict=True))
        if strict and any(one.reason for one in found):
            raise _import_error(plan, _rejected(staged))
        yield JobProgress(len(staged), len(items))
    return staged


def _result(plan: Plan, staged: Mapping[str, StagedImage]) -> tuple[Imported, list[Object]]:
    """Return the result of an import and the objects without their rejected views."""
    wanted = [left for left in (_without_rejected(item, staged) for item in plan.wanted) if left.enrollments]
    result = Imported(
        len(wanted),
        sum(len(enrollment.views) for item in wanted for enrollment in item.enrollments),
        sum(one.size for one in staged.values()),
        plan.skipped,
        plan.replaced,
        (*plan.batch.rejected, *_rejected(staged)),
        plan.batch.gaps,
    )
    return result, wanted


def _rejected(staged: Mapping[str, StagedImage]) -> list[RejectedFile]:
    return [RejectedFile(image, one.reason) for image, one in staged.items() if one.reason]


def _import_error(plan: Plan, rejected: Sequence[RejectedFile]) -> ImportRejected:
    return ImportRejected(
        f"{plan.batch.origin} was not imported: {len(rejected)} of its files cannot be used.",
        next_step="Fix or remove the listed files and import it again.",
        evidence={"rejected": [f"{file.path}: {file.reason}" for file in rejected[:20]]},
    )


def _without_rejected(item: Object, staged: Mapping[str, StagedImage]) -> Object:
    """The object without the views whose images were rejected."""
    if not any(staged[view.image].reason for enrollment in item.enrollments for view in enrollment.views):
        return item
    left = []
    for enrollment in item.enrollments:
        good = [view for view in enrollment.views if not staged[view.image].reason]
        if good:
            views_left = tuple(view.model_copy(update={"index": index}) for index, view in enumerate(good))
            planned = tuple(enrollment.planned_azimuth_deg[view.index] for view in good)
            left.append(enrollment.model_copy(update={"views": views_left, "planned_azimuth_deg": planned}))
    return item.model_copy(update={"enrollments": tuple(left)})
