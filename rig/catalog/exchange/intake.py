"""Into a catalog: images are checked and described aside, then all of it comes in at once."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import partial

from rig.catalog.catalog import Catalog
from rig.catalog.describing import known_descriptor
from rig.catalog.exchange.admit import admit
from rig.catalog.exchange.package import Gap, Object, Package, Refused
from rig.catalog.exchange.plan import Plan
from rig.catalog.exchange.stage import Staged, items_of, stage
from rig.catalog.jobs import Progressed, portions, processes
from rig.catalog.staging import staging
from rig.core.errors import ImportRejected
from rig.core.files import sync_tree
from rig.core.processes import map_in_processes


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


def bring_in(
    catalog: Catalog,
    plan: Plan,
    *,
    label: str | None = None,
    further: Sequence[str] = (),
    strict: bool = False,
    jobs: int | None = None,
) -> Generator[Progressed, None, Imported]:
    """Import what was planned, all of it or nothing.

    Images are copied and described aside by several processes; when every one is on the disk, one transaction takes
    them in. Whatever ends the call before that leaves the catalog as it was.

    Parameters
    ----------
    label
        For the new objects that have none.
    further
        Descriptors besides CEDD (`hbr.descriptors`), of views that come without any; each takes its time.
    strict
        Refuse everything when one image is refused; a bundle is always taken like that.
    jobs
        Processes; one for each core otherwise.

    Raises
    ------
    UsageError
        There is no such descriptor.
    ImportRejected
        Nothing is left to import, or an image was refused and all are wanted.
    ObjectExists
        Another process brought one of the objects in meanwhile.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    for name in further:
        known_descriptor(name)
    package = plan.package
    strict = strict or package.strict
    refused = list(package.refused)
    if strict and refused:
        raise _not_whole(package, refused)
    with catalog.database.in_words(), staging(catalog.path) as folder:
        items = list(items_of(plan, tuple(further)))
        staged: dict[str, Staged] = {}
        yield Progressed(0, len(items))
        work = partial(stage, folder)
        for portion, found in map_in_processes(work, portions(items), processes(jobs, len(items))):
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
        admit(catalog, plan, wanted, staged, folder, label)
    return Imported(
        len(wanted),
        sum(len(enrollment.views) for item in wanted for enrollment in item.enrollments),
        sum(one.size for one in staged.values()),
        plan.skipped,
        plan.replaced,
        tuple(refused),
        package.gaps,
    )


def preview_import(
    plan: Plan, *, strict: bool = False, jobs: int | None = None
) -> Generator[Progressed, None, Imported]:
    """Look at every image that `bring_in` would take, and return what it would; nothing is written.

    Raises
    ------
    ImportRejected
        An image was refused and all are wanted.
    """
    package = plan.package
    refused = list(package.refused)
    items = list(items_of(plan))
    size = done = 0
    yield Progressed(0, len(items))
    for portion, found in map_in_processes(partial(stage, None), portions(items), processes(jobs, len(items))):
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


def _not_whole(package: Package, refused: list[Refused]) -> ImportRejected:
    return ImportRejected(
        f"{package.origin} is not taken: {len(refused)} of its files cannot be used; nothing was imported",
        next_step="mend or remove the files listed and import it again",
        evidence={"refused": [f"{file.path}: {file.reason}" for file in refused[:20]]},
    )


def _without(item: Object, staged: dict[str, Staged]) -> Object:
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
