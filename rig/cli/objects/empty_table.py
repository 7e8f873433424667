"""`rig empty-table`: take the empty-table image; enrollment asks for it once a day."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.jobs import is_interactive
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.bench import Bench

WITHOUT_IMAGE: Final = "without it, objects are found only before a plain background, and less well in other light"
OLD_IMAGE: Final = "the old image is used for the frames that still match it"


@command
def empty_table(
    settings: Settings,
    show: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Only write the stored image to a PNG file.")
    ] = None,
    anyway: Annotated[
        bool,
        typer.Option("--anyway", help="Store the image although something on the table rotates: a pattern or a screw."),
    ] = False,
) -> None:
    """Take an image of the empty table. Do this once a day, and when the light has changed.

    Objects are found by comparing views with this image. First take everything off the table. The table rotates a
    little to check that it is empty. If the check fails, the previous image stays in use.

    Example: rig empty-table --bench sim

    Example: rig empty-table --show empty.png
    """
    from rig.catalog import Action
    from rig.core.errors import UsageError

    if show is not None and anyway:
        raise UsageError("--show takes no image, so --anyway has no effect.", next_step="Remove --anyway.")
    with settings.open_bench() as bench:
        if show is not None:
            _show(settings, bench, show)
            return
        _take(settings, bench, anyway=anyway)
        settings.note(Action.TABLE_PHOTOGRAPHED, anyway=anyway)


def ensure_empty_table_image(settings: Settings, bench: "Bench", *, ask: bool, then: str | None = None) -> None:
    """Ensure that the bench has an empty-table image of today before objects are put on the table.

    An operator that can clear the table by itself does so. Otherwise the operator is asked at the terminal if ``ask``
    is set; ``then`` names the object to put on the table afterwards. If the operator cannot be asked, a note
    says that the work continues with the old image or without one.
    """
    from rig.bench import ObjectAlreadyPlaced, TableClearer
    from rig.core.errors import TableNotEmpty, ViewRejected
    from rig.core.phrases import sentence
    from rig.views.empty_table import COMMAND, empty_table_status

    status = empty_table_status(bench)
    if (status.table is not None and not status.problems) or bench.config.table.carries == "camera":
        return
    if isinstance(bench.operator, TableClearer):
        if bench.operator.clear():
            try:
                _take(settings, bench, within_plan=True)
            except (TableNotEmpty, ViewRejected) as error:  # enrollment can continue without the image
                print(f"Note: {error.what} {error.next_step}", file=sys.stderr)
        return
    consequence = WITHOUT_IMAGE if status.table is None else OLD_IMAGE
    if isinstance(bench.operator, ObjectAlreadyPlaced) and ask and not settings.json and is_interactive():
        question = f"{sentence(status.text)} Take everything off the table."
        if _take_with_operator(settings, bench, question, consequence) and then:
            _answer(f"Put {then} on the table and take your hands away.\n  Enter: continue ")
        return
    print(f"Note: {status.text}; {consequence}. To take a new one: {COMMAND}", file=sys.stderr)


def _show(settings: Settings, bench: "Bench", path: Path) -> None:
    from rig.core.errors import UsageError, os_errors_as
    from rig.core.files import write
    from rig.views import image_files as images
    from rig.views.empty_table import empty_table_status

    status = empty_table_status(bench)
    if status.table is None:
        raise UsageError(f"There is no image to show: {status.text}.", next_step="Take the image with rig empty-table.")
    with os_errors_as(UsageError, f"{path} cannot be written.", next_step="Choose another file with --show."):
        write(path, images.encode(status.table.image_bgr))
    settings.say(f"{path}: {status.text}", {"file": str(path), **status.as_json()})


def _take_with_operator(settings: Settings, bench: "Bench", question: str, consequence: str) -> bool:
    """Ask until the image is taken or the operator continues without it; return whether the table is empty now."""
    from rig.core.errors import TableNotEmpty, ViewRejected

    accept = ""  # offered only after the check has failed
    while True:
        answer = _answer(f"{question}\n  Enter: take the image,{accept} s: continue without\n  ({consequence}) ")
        if answer in ("s", None):
            return False
        if answer not in ("", "k" if accept else ""):
            continue
        try:
            _take(settings, bench, anyway=answer == "k", within_plan=True)
        except ViewRejected as error:
            question = f"{error.what}\n{error.next_step}"
        except TableNotEmpty as error:
            question = f"{error.what} Take it off the table and stand back."
            accept = " k: keep what is there because it always stays on the table (a pattern, a screw),"
        else:
            return True


def _answer(question: str) -> str | None:
    """Return the answer to a question; None at the end of the input."""
    print(question, end="", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not answer:
        print(file=sys.stderr)
        return None
    return answer.strip().lower()


def _take(settings: Settings, bench: "Bench", *, anyway: bool = False, within_plan: bool = False) -> None:
    """Take the image; ``within_plan`` prints to stderr, because stdout belongs to the events of another plan."""
    from rig.events.events import event_dict
    from rig.events.lines import line
    from rig.plans.photograph_table import photograph_table

    for event in photograph_table(bench, anyway=anyway):
        if within_plan:
            print(line(event), file=sys.stderr, flush=True)
        else:
            settings.say(line(event), event_dict(event))
