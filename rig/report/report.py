"""The report: one self-contained HTML file."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from statistics import fmean, median
from typing import Any, Final, NamedTuple

from jinja2 import Template
from markupsafe import Markup

from hbr import Outcome
from hbr.core.angles import wrap360
from rig.charts.candidates import Styles, candidates_chart
from rig.charts.compass import polar_path
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do, in_words
from rig.core.phrases import azimuth_words, counted, percent_words, sentence, signed
from rig.core.templates import environment
from rig.events.events import (
    Accepted,
    Decided,
    Enrolled,
    FrameUsed,
    Identified,
    Moved,
    Ranked,
    Rejected,
    Started,
    Verified,
)
from rig.events.wording import (
    NOT_ENROLLED,
    answer_words,
    decision_words,
    move_words,
    note_steps,
    note_words,
    outcome_words,
    ranking_words,
    share_words,
    verification_words,
)
from rig.report.pictures import data_uri, thumbnail
from rig.report.records import Correctness, Record
from rig.search.saved_run import SavedRun
from rig.views.capture import rejection_text

_STAMP: Final = (56, 56)  # px: it only helps to recognise the object; every picture makes the file of the report larger
_LEADING: Final = 3
"""Candidates in the table of a view."""
_REASONS: Final = 3
"""Reasons of rejected frames that are named before a view."""
_FEW: Final = 3
"""Up to this number of searches or objects are all expanded; of more, only the first and the wrong ones."""

_HEADS: Final = (
    ("#", "number of the search; it leads to its details", "n"),
    ("on the table", "the object that is really on the table", ""),
    ("found as", "the answer of the search", ""),
    ("correct?", "whether the answer is that object, or unknown for one that was never enrolled; or ambiguous", ""),
    ("views", "number of views that the search took", "n"),
    ("rotation", "how far the table rotated in all", "n"),
    ("pose error", "distance of the answered rotation from the true one; – if it is not determined", "n"),
    ("score", "similarity of the views to the enrolled views of the answer, per view; 1 is a perfect match", "n"),
    ("margin", "smallest difference of the score to that of any other enrolled object, per view", "n"),
)
"""Heads of the columns of the results, their meanings and classes."""
_WITH_TRUTH: Final = ("on the table", "correct?", "pose error")


@dataclass(frozen=True, slots=True)
class Meta:
    """Circumstances of a run.

    ``conditions`` determine the run (noise model, seed, versions): equal conditions give equal pages. ``wall_clock``
    has the values that differ between equal runs (duration, host); they are at the foot of the page. A value that is a
    mapping becomes a group of rows. ``date`` is at the top, in the time zone of this computer.
    """

    conditions: Mapping[str, Any] = field(default_factory=dict)
    wall_clock: Mapping[str, Any] = field(default_factory=dict)
    date: datetime | None = None


def render_report(
    title: str,
    summary: str,
    enrollments: Sequence[Record],
    identifications: Sequence[Record],
    *,
    meta: Meta,
) -> str:
    """Return the page, with ``summary`` as a sentence below the title; sections without content are left out."""
    styles = Styles()  # one for the page, so that an object has one colour on it
    with_truth = any(record.truth is not None for record in identifications)
    return _template().render(
        title=title,
        date=meta.date and meta.date.astimezone(),
        summary=summary,
        totals=list(totals(enrollments, identifications)),
        retrievals=[
            _retrieval(number, record, styles, unfold=number == 1 or len(identifications) <= _FEW)
            for number, record in enumerate(identifications, 1)
        ],
        objects=[
            _object(number, record, unfold=number == 1 or len(enrollments) <= _FEW)
            for number, record in enumerate(enrollments, 1)
        ],
        with_truth=with_truth,
        heads=[head for head in _HEADS if with_truth or head[0] not in _WITH_TRUTH],
        conditions=_groups(meta.conditions),
        wall_clock=_groups(meta.wall_clock),
    )


def run_report(saved: SavedRun) -> str:
    """Return the page about a saved run: the answer, the camera's path, the candidates and the decisions.

    Raises `UsageError`: the run is damaged.
    """
    record = Record(region=saved.config.view.roi)
    about = saved.about
    with saved.damage():
        for event in saved.events():
            record.add(event)
        answer = record.answer
        found = "no answer" if answer is None else outcome_words(answer)
        meta = Meta(
            conditions={"bench": about.bench, **saved.started.conditions, "devices": about.devices},
            wall_clock={"software": about.software},
            date=about.started_utc,
        )
        return render_report(f"Search: {found}", _answer(record), [], [record], meta=meta)


def write_report(path: Path, html: str) -> None:
    """Write the page to ``path`` completely or not at all; create missing folders.

    Raises `UsageError`: the file cannot be written there.
    """
    step = ("Choose a folder that you may write to, on a disk with free space.", Do.RUN_AGAIN(out="FILE"))
    with os_errors_as(UsageError, f"The report cannot be written to {path}.", next_step=step):
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, html.encode())


@cache
def _template() -> Template:
    return environment("rig.report", "rig.charts").get_template("report.html.j2")


Shown = dict[str, Any]
"""The values of a part of the page, by their names in the template."""


def _retrieval(number: int, record: Record, styles: Styles, *, unfold: bool) -> Shown:
    answer, views = record.answer, record.views
    error_deg = record.pose_error_deg
    shown = record.shown
    path = candidates = Markup()
    if len(views) > 1:
        path = Markup(polar_path({view.index + 1: _report_azimuth_deg(record, view.azimuth_deg) for view in shown}))
    # The chart of the candidates; the path above needs two views.
    rotated_deg, enough = record.rotated_deg, record.enough
    known = [event for event in record.all(Ranked) if event.index in rotated_deg]  # all, except in a damaged run
    if known:
        chart = candidates_chart(
            known,
            styles,
            answer=answer.name if answer is not None and answer.outcome is Outcome.FOUND else None,
            min_score=answer.min_score if answer else None,
            rotated_deg=rotated_deg if record.in_motion else None,
            enough_deg=rotated_deg[enough.index] if enough else None,
        )
        candidates = Markup(chart.svg())
    return Shown(
        number=number,
        stamp=data_uri(thumbnail(views[0].image_bgr, _STAMP)) if views else "",
        truth=_truth(record),
        answer=outcome_words(answer) if answer else "no answer",
        correctness=record.correctness,
        views=f"{answer.views if answer else len(views)}",
        travelled=f"{answer.travelled_deg:.0f}°" if answer else "–",
        pose_error="–" if error_deg is None else f"{error_deg:.1f}°",
        score=f"{answer.score:.3f}" if answer else "–",
        margin=signed(answer.margin, 3) if answer else "–",
        words=_answer(record),
        path=path,
        path_words="on the table" if record.yaw_deg is None else "as enrolled",
        candidates=candidates,
        motion=_motion_words(record),
        notes=[
            f"{sentence(note_words(note))} {in_words(note_steps(note))}"
            for started in record.all(Started)
            for note in started.notes
        ],
        frames=[_frame(record, view, styles) for view in shown],
        hidden=len(views) - len(shown),
        unfold=unfold or record.correctness is Correctness.WRONG,
    )


def _answer(record: Record) -> str:
    return answer_words(record.answer) if record.answer else "The search ended without an answer."


def _truth(record: Record) -> str:
    if record.truth is None:
        return ""
    if record.truth.name is not None:
        return record.truth.name
    return f"{record.truth.description} (never enrolled)" if record.truth.description else "never enrolled"


def _report_azimuth_deg(record: Record, azimuth_deg: float) -> float:
    """Convert to the azimuth scale of the report: that of the enrollment if the object was found, else the table's."""
    return wrap360(azimuth_deg - (record.yaw_deg or 0.0))


def _motion_words(record: Record) -> str:
    """Return which frames of a search in motion were used; empty for runs that do not contain this."""
    frames, enough = record.all(FrameUsed), record.enough
    if not frames:
        return ""
    last = frames[-1]
    used = f"{counted(len(frames), 'frame')} of the rotation used (views {frames[0].index + 1} to {last.index + 1})"
    used += f", {last.rejected} rejected."
    if enough is None:
        return f"{used} Their evidence was not enough for an answer before the search ended."
    when = f"{enough.seconds:.1f} s after the start"
    where = f"azimuth {azimuth_words(enough.azimuth_deg)}°, after {record.rotated_deg[enough.index]:.0f}° of rotation"
    return (
        f"{used} The evidence was enough for an answer from view {enough.index + 1} on: {when}, at {where}. "
        f"The last frame came after {last.seconds:.1f} s."
    )


def _frame(record: Record, view: Accepted, styles: Styles) -> Shown:
    thought, decided = record.last(Ranked, view.index), record.last(Decided, view.index)
    moved, verified = record.last(Moved, view.index), record.last(Verified)
    leading = []
    if thought:
        leading = [
            (one.name, styles[one.name], f"{one.score:.3f}", share_words(one)) for one in thought.candidates[:_LEADING]
        ]
        if thought.decision is not None:
            leading.append((NOT_ENROLLED, styles[NOT_ENROLLED], "", percent_words(thought.decision.not_enrolled)))
    # What a search decides at its end follows from all of these, so the last card says all of them.
    words = [ranking_words(thought)]
    if view is record.views[-1] and verified is not None:
        words.append(verification_words(verified))
    return Shown(
        number=view.index + 1,
        picture=data_uri(view.image_bgr),
        where=f"{azimuth_words(_report_azimuth_deg(record, view.azimuth_deg))}°",
        rejected=_rejections(record, view),
        leading=leading,
        margin=signed(thought.margin, 3) if thought else "",
        decided=" ".join(sentence(one) for one in words if one),
        moved=sentence(move_words(moved)) if moved and view.index else "",
        decision=decision_words(decided) if decided else "",
    )


def _rejections(record: Record, view: Accepted | None = None) -> str:
    """Return why frames were rejected, all or those before a view. A search in motion may reject dozens."""
    rejected = [one for one in record.all(Rejected) if view is None or one.index == view.index]
    texts = dict.fromkeys(", ".join(rejection_text(reason, one.evidence) for reason in one.reasons) for one in rejected)
    more = len(texts) - _REASONS
    return "; ".join(list(texts)[:_REASONS]) + (f"; and {more} more" if more > 0 else "")


def _object(number: int, record: Record, *, unfold: bool) -> Shown:
    views, retakes, started = record.views, record.retakes, record.last(Started)
    line = counted(len(views), "view")
    if retakes:
        line += f", {counted(retakes, 'retake')}"
    return Shown(
        number=number,
        name=started.name if started and started.name else "",
        line=line,
        unfold=unfold,
        items=enrollment_items(record),
        stamp=data_uri(thumbnail(views[0].image_bgr, _STAMP)) if views else "",
        tiles=[(data_uri(view.image_bgr), f"{azimuth_words(view.azimuth_deg)}°") for view in views],
    )


def _groups(values: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return rows of text in groups: single values first, then each mapping under its name."""
    plain = [(key, _text(value)) for key, value in values.items() if not isinstance(value, Mapping)]
    groups = [("", plain)] if plain else []
    for key, value in values.items():
        if isinstance(value, Mapping):
            groups.extend((f"{key} {name}".strip(), rows) for name, rows in _groups(value))
    return groups


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value) or "–"
    return str(value)


# -- the numbers at the top, and beside the views of an object ---------------------------------------------------------


class SummaryItem(NamedTuple):
    """A number with its label and a note."""

    label: str
    value: str
    note: str = ""


def count_of(correctness: Correctness, records: Sequence[Record]) -> int:
    """Return the number of searches with this correctness."""
    return sum(record.correctness is correctness for record in records)


def totals(enrollments: Sequence[Record], identifications: Sequence[Record]) -> Iterator[SummaryItem]:
    """Yield the headline numbers of a run; the numbers of a single enrollment are beside its views instead."""
    if len(enrollments) + len(identifications) > 1 and enrollments:
        views = counted(sum(len(record.views) for record in enrollments), "view")
        retakes = counted(sum(record.retakes for record in enrollments), "retake")
        yield SummaryItem("objects enrolled", f"{len(enrollments)}", f"{views}, {retakes}")
    answers = [record.answer for record in identifications if record.answer is not None]
    if len(identifications) == 1 and not identifications[0].truth:
        for answer in answers:
            yield from _answer_items(answer)
        return
    # Right and wrong answers, of the objects whose names are known and of those without one.
    with_truth = [record for record in identifications if record.answer and record.truth]
    known = [record for record in with_truth if record.truth and record.truth.name is not None]
    unknown = [record for record in with_truth if record.truth and record.truth.name is None]
    if known:
        right, ambiguous = (count_of(one, known) for one in (Correctness.RIGHT, Correctness.AMBIGUOUS))
        yield SummaryItem("found", f"{right}/{len(known)}", "enrolled objects identified correctly")
        yield SummaryItem("ambiguous", f"{ambiguous}/{len(known)}", "may be one of several enrolled objects")
    if unknown:
        right = count_of(Correctness.RIGHT, unknown)
        yield SummaryItem("unknown objects recognised", f"{right}/{len(unknown)}", "objects never enrolled")
    # What the searches took.
    if answers:
        taken = [answer.views for answer in answers]
        travelled = [answer.travelled_deg for answer in answers]
        yield SummaryItem("views to an answer", f"{fmean(taken):.1f}", f"mean; {min(taken)} to {max(taken)}")
        yield SummaryItem("rotation", f"{fmean(travelled):.0f}°", f"mean of a search; {sum(travelled):.0f}° in all")
    errors = [error for record in identifications if (error := record.pose_error_deg) is not None]
    if errors:
        yield SummaryItem(
            "pose error", f"{median(errors):.1f}°", f"median of {len(errors)}; largest {max(errors):.1f}°"
        )


def enrollment_items(record: Record) -> Iterator[SummaryItem]:
    """Yield the numbers of one enrollment."""
    yield SummaryItem("views", f"{len(record.views)}")
    yield SummaryItem("retakes", f"{record.retakes}", _rejections(record))
    if (done := record.last(Enrolled)) is not None:
        yield SummaryItem("bench time", f"{done.seconds:.0f} s")


def _answer_items(answer: Identified) -> Iterator[SummaryItem]:
    yield SummaryItem("answer", outcome_words(answer))
    if answer.confidence is not None:
        yield SummaryItem("confidence", percent_words(answer.confidence))
    yield SummaryItem("score", f"{answer.score:.3f}", f"per view; margin {signed(answer.margin, 3)}")
    yield SummaryItem("views", f"{answer.views}")
    yield SummaryItem("rotation", f"{answer.travelled_deg:.0f}°")
    yield SummaryItem("bench time", f"{answer.seconds:.1f} s")
