"""`rig catalog verify`, `redescribe`, `gc`, `copy` and `deliver`: the catalog as a whole.

Decision: docs/decisions/0010.
"""

import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from rig.cli.catalog.catalog import app
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_CATALOG
from rig.cli.ui.jobs import run_job, size_words
from rig.cli.ui.options import ClusterOption, JobsOption, YesOption, jobs_of
from rig.cli.ui.prompts import confirm
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.phrases import counted

_SHOWN: Final = 20
"""Failed objects that are listed; --json has all."""


@app.command("verify")
@command
def verify(settings: Settings) -> None:
    """Check whether everything is as it was stored. The exit code is 7 if it is not. Nothing is changed.

    Example: rig catalog verify --bench sim
    """
    from rig.catalog.verify import verify as job

    with settings.open_catalog(read_only=True) as catalog:
        found = run_job("verifying", job(catalog), interrupted="Interrupted; nothing was changed.")
    checked = ", ".join(
        counted(number, noun)
        for number, noun in ((found.objects, "object"), (found.views, "view"), (found.results, "result"))
    )
    problems = counted(len(found.findings), "problem")
    outcome = problems if found.findings else "everything is as it was stored"
    summary = f"{checked}, {size_words(found.image_bytes)} of images: {outcome}"
    settings.say("\n".join([*(finding.text for finding in found.findings), summary]), found)
    if found.findings:
        raise typer.Exit(EXIT_CATALOG)


@app.command("redescribe")
@command
def redescribe(
    settings: Settings,
    descriptor: Annotated[str, typer.Option(help="Name of the descriptor.")] = "cedd",
    region: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,WIDTH,HEIGHT|whole",
            help="From now on, describe this part of the images, in pixels, or the whole.",
        ),
    ] = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Describe the enrolled views now: those that no search has described since the program or the region changed.

    A search does this, too. After an interruption, the same command continues.

    Example: rig catalog redescribe --region 40,0,240,240 --bench sim

    Example: rig catalog redescribe --descriptor edges+colours+cedd --bench sim
    """
    from rig.catalog.derived import choose_region
    from rig.catalog.derived import redescribe as job
    from rig.catalog.describing import known_descriptor
    from rig.catalog.exchange.tables import parse_region

    name = known_descriptor(descriptor).name
    try:
        part = None if region in (None, "whole") else parse_region(region)
    except ValueError as error:
        raise UsageError(f"--region: {error}.", next_step="Give X,Y,WIDTH,HEIGHT, or whole.") from error
    with settings.open_catalog() as catalog:
        if region is not None:
            choose_region(catalog, part)
        interrupted = (
            f"Interrupted; the results so far are stored. To continue: rig catalog redescribe --descriptor {name}"
        )
        done = run_job("describing", job(catalog, name, jobs=jobs_of(jobs, cluster)), interrupted=interrupted)
    settings.say(
        f"{done.descriptor} {done.version}: {counted(done.described, 'view')} described, "
        f"{done.unchanged} unchanged, {len(done.failed)} failed",
        done,
    )
    for path, reason in done.failed[:_SHOWN]:
        print(f"  {path}: {reason}", file=sys.stderr)
    if done.failed:
        raise typer.Exit(EXIT_CATALOG)


@app.command("gc")
@command
def gc(
    settings: Settings,
    old: Annotated[bool, typer.Option("--old", help="Also remove replaced and abandoned enrollments.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only report what would be removed.")] = False,
    yes: YesOption = False,
) -> None:
    """Remove deleted objects permanently, and images of interrupted work that are older than a day.

    Example: rig catalog gc --dry-run --bench sim
    """
    from rig.catalog.upkeep import collect_garbage
    from rig.core.json_form import plain

    with settings.open_catalog() as catalog:
        found = collect_garbage(catalog, old=old, dry_run=True)
        names = ", ".join(found.objects[:10]) + (" and others" if len(found.objects) > 10 else "")
        words = (
            f"{counted(len(found.objects), 'deleted object')}{f' ({names})' if names else ''}, "
            f"{counted(found.enrollments, 'enrollment')}, {counted(found.views, 'view')} and "
            f"{counted(found.files, 'file')}, {size_words(found.bytes)}"
        )
        nothing = not (found.enrollments or found.files)
        if not dry_run and not nothing:
            confirm(f"Remove {words} permanently?", yes=yes, settings=settings)
            found = collect_garbage(catalog, old=old)
    text = f"{'Would remove' if dry_run else 'Removed'} {words}."
    settings.say("There is nothing to remove." if nothing else text, {"dry_run": dry_run, **plain(found)})


@app.command("copy")
@command
def copy(
    settings: Settings,
    source: Annotated[str, typer.Argument(metavar="FROM", help="Folder or database URL of the catalog.")],
    target: Annotated[str, typer.Argument(metavar="TO", help="Folder or database URL of a new or empty catalog.")],
) -> None:
    """Copy a whole catalog, for example from this computer to a server, and compare all digests.

    The images of a database are in the store that the setting catalog.images names.

    Example: rig catalog copy ~/catalog postgresql+psycopg://rig@server/rig --set catalog.images=s3://rig/catalog
    """
    from rig.catalog import Catalog
    from rig.catalog.copying import copy_catalog
    from rig.config.catalog_place import CatalogPlace

    def place(text: str) -> CatalogPlace:
        if "://" not in text:
            return CatalogPlace(Path(text))
        config = settings.load()
        return CatalogPlace(config.catalog_path(settings.bench_name), text, config.catalog.images)

    clock = SystemClock()
    with (
        Catalog.open(place(source), clock=clock, create=False, read_only=True) as before,
        Catalog.open(place(target), clock=clock, create=True) as after,
    ):
        interrupted = "Interrupted; the copy is empty. The same command continues with the images."
        done = run_job("copying", copy_catalog(before, after), interrupted=interrupted)
        words = (
            f"Copied {counted(done.objects, 'object')} with {counted(done.views, 'view')}, "
            f"{counted(done.results, 'result')} and {size_words(done.image_bytes)} of images from {before.place} to "
            f"{after.place}. All digests are equal."
        )
    settings.say(words, done._asdict())


@app.command("deliver")
@command
def deliver(
    settings: Settings,
    rename: Annotated[
        tuple[str, str] | None,
        typer.Option("--rename", metavar="NAME NEW", help="Deliver an object of the journal under another name."),
    ] = None,
    replace: Annotated[
        list[str] | None,
        typer.Option("--replace", metavar="NAME", help="Replace the object of the server by that of the journal."),
    ] = None,
    discard: Annotated[
        str | None, typer.Option("--discard", metavar="NAME", help="Remove an object from the journal.")
    ] = None,
) -> None:
    """Deliver what this computer enrolled and answered while the server of the catalog did not answer.

    rig enroll and rig identify do this, too. The options resolve a name that both the journal and the server have.

    Example: rig catalog deliver --rename mug-white mug-white-2
    """
    from rig.catalog.journal import Journal, deliver_journal, delivery_words
    from rig.catalog.journal import discard as remove

    place = settings.place
    if place.url is None:
        raise UsageError(
            "The catalog is in a folder of this computer.",
            next_step="Enroll and identify as usual: there is nothing to deliver.",
        )
    if rename is not None or discard is not None or replace:
        with Journal.of(place, SystemClock()) as journal:
            for name in replace or ():
                journal.summary(name)  # there must be one
            if rename is not None:
                journal.rename(*rename)
            if discard is not None:
                remove(journal, discard)
    done = deliver_journal(place, SystemClock(), replacing=replace or ())
    for one in done:
        print(f"{'' if one.conflict is None else 'Note: '}{delivery_words(one, place)}", file=sys.stderr)
    conflicts = [one for one in done if one.conflict is not None]
    if settings.json:
        rows = [{"name": one.name, "views": one.views, "conflict": one.conflict and one.conflict.what} for one in done]
        settings.print_json({"delivered": len(done) - len(conflicts), "objects": rows})
    elif not done:
        print("No object was delivered.")
    if conflicts:
        raise typer.Exit(EXIT_CATALOG)
