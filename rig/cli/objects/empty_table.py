"""`rig empty-table`: the picture of the bench without an object, and the question for it at the start of a day."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.jobs import is_interactive
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.bench import Bench

WITHOUT = "objects are found before a plain background only, and less surely in other light"
STALE = "the one that is there is used, as far as frames look like it"


@command
def empty_table(
    settings: Settings,
    show: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Only write the picture that is there, as PNG.")
    ] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Keep it although something on the table turns: a pattern, a screw.")
    ] = False,
) -> None:
    """Take the picture of the empty table that objects are found by; once a day, and when the light has changed.

    Take off what stands on the table first. It turns a little, to see that it is empty. A picture that is refused
    leaves the one before in its place.

    Example: rig empty-table --bench sim

    Example: rig empty-table --show empty.png
    """
    from rig.core.errors import UsageError
    from rig.views.empty_table import EmptyTables

    if show is not None and anyway:
        raise UsageError("--show takes no picture.", next_step="Leave --anyway out.")
    with settings.open_bench() as bench:
        if show is None:
            _photograph(settings, bench, anyway=anyway)
            settings.note("photographed the empty table", anyway=anyway)
            return
        standing = EmptyTables.standing(bench)
        if standing.table is None:
            raise UsageError(
                f"There is nothing to show: {standing.words}.", next_step="Take the picture: rig empty-table"
            )
        from rig.core.files import write
        from rig.views import image_files as images

        try:
            write(show, images.encode(standing.table.image_bgr))
        except OSError as error:
            raise UsageError(
                f"{show} cannot be written.",
                next_step="Name another file with --show.",
                evidence={"reason": error.strerror or str(error)},
            ) from error
        words = f"{show}: {standing.words}"
        settings.say(
            words,
            {"file": str(show), "taken_utc": standing.table.taken_utc.isoformat(), "doubts": list(standing.doubts)},
        )


def ensure_empty_table_image(settings: Settings, bench: "Bench", *, ask: bool, then: str | None = None) -> None:
    """Have a picture of the empty table for today, before objects are put on it.

    An operator who can empties the table unasked. A person is asked, where ``ask`` allows it and somebody is there;
    ``then`` is what stands on the table afterwards. Otherwise work goes on with the picture that there is, or without,
    and that is said.
    """
    from rig.bench import ObjectAlreadyPlaced, TableClearer
    from rig.core.errors import TableNotEmpty, ViewRejected
    from rig.events.wording import sentence
    from rig.views.empty_table import COMMAND, EmptyTables

    standing = EmptyTables.standing(bench)
    if (standing.table is not None and not standing.doubts) or bench.config.table.carries == "camera":
        return
    if isinstance(bench.operator, TableClearer):
        if bench.operator.clear():
            try:
                _photograph(settings, bench, aside=True)
            except (TableNotEmpty, ViewRejected) as error:  # nobody is asked, and the work goes on
                print(f"Note: {error.what} {error.next_step}", file=sys.stderr)
        return
    consequence = WITHOUT if standing.table is None else STALE
    person = isinstance(bench.operator, ObjectAlreadyPlaced)
    if person and ask and not settings.json and is_interactive():
        if _asked(settings, bench, f"{sentence(standing.words)} Take everything off the table.", consequence) and then:
            _enter(f"Now put {then} on the table and take your hands away.\n  Enter goes on: ")
        return
    print(f"Note: {standing.words}; {consequence}. {COMMAND} takes one.", file=sys.stderr)


def _asked(settings: Settings, bench: "Bench", question: str, consequence: str) -> bool:
    """Ask until there is a picture or somebody goes on without; return whether the table is empty now."""
    from rig.core.errors import TableNotEmpty, ViewRejected

    keep = ""
    while True:
        said = _enter(f"{question}\n  Enter takes its picture,{keep} s goes on without\n  ({consequence}): ")
        if said in ("s", None):
            return False
        if said not in ("", "k" if keep else ""):
            continue
        try:
            _photograph(settings, bench, anyway=said == "k", aside=True)
        except ViewRejected as error:
            question = f"{error.what}\n{error.next_step}"
        except TableNotEmpty as error:
            question = f"{error.what} Take it off, and stand back."
            keep = " k takes it with what always stays there (a pattern, a screw),"
        else:
            return True


def _enter(question: str) -> str | None:
    """Return what was answered; None at the end of the answers."""
    print(question, end="", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not answer:
        print(file=sys.stderr)
        return None
    return answer.strip().lower()


def _photograph(settings: Settings, bench: "Bench", *, anyway: bool = False, aside: bool = False) -> None:
    """Take the picture; ``aside`` of another plan, whose events begin with its own."""
    from rig.cli.ui.present import line
    from rig.events.events import event_dict
    from rig.plans.photograph_table import photograph_table

    for event in photograph_table(bench, anyway=anyway):
        if aside:
            print(line(event), file=sys.stderr)
        else:
            settings.say(line(event), event_dict(event))
