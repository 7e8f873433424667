"""The job that takes the empty-table image, and the question for one at the start of the day."""

from collections.abc import Iterator
from typing import Final

from rig.bench import Bench, Placer
from rig.catalog import Action
from rig.core.errors import TableNotEmpty, ViewRejected
from rig.core.next_steps import Do, SomeSteps
from rig.core.phrases import sentence
from rig.events.wording import line
from rig.jobs.desk import Desk, Remark, Steps
from rig.plans.operator import Choice, Question, Subject
from rig.plans.photograph_table import photograph_table
from rig.views.empty_table import empty_table_status

CLEAR: Final = "Take everything off the table."
WITHOUT_IMAGE: Final = "without it, objects are found only before a plain background, and less well in other light"
OLD_IMAGE: Final = "the old image is used for the frames that still match it"


def take_table_image(desk: Desk, *, anyway: bool = False) -> Steps[None]:
    """Take the empty-table image, as `rig.plans.photograph_table.photograph_table`.

    Before a camera goes around the table, the operator is asked to clear it, because no check finds a forgotten object.
    """
    with desk.open_bench() as bench:
        if bench.config.table.carries == "camera" and bench.placer is None and desk.operator.is_there:
            choices = {Choice.CONTINUE: "take the images", Choice.STOP: "stop"}
            if desk.operator.choose(Question(Subject.EMPTY_TABLE, CLEAR, choices)) is Choice.STOP:
                return
        yield from photograph_table(bench, anyway=anyway)
        yield from desk.log(Action.TABLE_PHOTOGRAPHED, anyway=anyway)


def refresh_table_image(
    desk: Desk, bench: Bench, placer: Placer | None, *, ask: bool, then: str | None = None
) -> Steps[None]:
    """Ensure that the bench has an empty-table image of today before objects are put on the table.

    The ``placer`` of the objects clears the table, if there is one. Otherwise the operator is asked, if ``ask`` is
    set and the operator is there; ``then`` names the object to put on the table afterwards. Without an operator, a
    remark says that the work continues with the old image or without one.
    """
    status = empty_table_status(bench)
    if status.table is not None and not status.problems:
        return
    if placer is not None:
        if placer.clear():
            try:
                yield from _photographed(bench)
            except (TableNotEmpty, ViewRejected) as error:  # enrollment can continue without the image
                yield Remark(error.what, steps=error.steps)
        return
    consequence = WITHOUT_IMAGE if status.table is None else OLD_IMAGE
    if not (ask and desk.operator.is_there):
        yield Remark(f"{status.text}; {consequence}.", steps=Do.EMPTY_TABLE())
        return
    # Ask until the image is taken, or the operator continues without it.
    text = f"{sentence(status.text)} {CLEAR}"
    steps: SomeSteps = ()
    skip = f"continue without\n  ({consequence})"
    keep: dict[Choice, str] = {}  # offered only after the check has failed
    while True:
        choices = {Choice.CONTINUE: "take the image", **keep, Choice.SKIP: skip}
        answer = desk.operator.choose(Question(Subject.EMPTY_TABLE, text, choices, steps=steps))
        if answer is Choice.SKIP:
            return
        try:
            yield from _photographed(bench, anyway=answer is Choice.KEEP)
        except ViewRejected as error:
            text, steps = error.what, error.steps
        except TableNotEmpty as error:
            text, steps = f"{error.what} Take it off the table and stand back.", ()
            keep = {Choice.KEEP: "keep what is there because it always stays on the table (a pattern, a screw)"}
        else:
            break
    if then is not None:
        put = f"Put {then} on the table and take your hands away."
        desk.operator.choose(Question(Subject.OBJECT, put, {Choice.CONTINUE: "continue"}))


def _photographed(bench: Bench, *, anyway: bool = False) -> Iterator[Remark]:
    """Take the image within another job, whose events must not be mixed with those of this one."""
    for event in photograph_table(bench, anyway=anyway):
        yield Remark(line(event), is_warning=False, event=event)
