"""The report: one self-contained HTML file."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
from jinja2 import Template
from markupsafe import Markup

from hbr.core.angles import wrap360
from rig.charts.azimuth_ring import RingView, azimuth_ring
from rig.charts.decision_chart import decision_chart
from rig.charts.polar_path import polar_path
from rig.charts.score_chart import score_chart
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do, in_words
from rig.core.phrases import azimuth_words, counted, listed, sentence, signed
from rig.core.templates import environment
from rig.events.events import Candidate, Ranked
from rig.events.wording import (
    answer_words,
    comparison_words,
    decision_words,
    move_words,
    note_steps,
    note_words,
    outcome_words,
    ranking_words,
    share_words,
    verification_words,
)
from rig.report.arc_figure import ArcFigure, arc_figure
from rig.report.contact_sheet import Image, contact_sheet, thumbnail
from rig.report.records import TILE, Correctness, EnrollmentRecord, IdentificationRecord
from rig.report.summary import SummaryItem, enrollment_items, totals

JPEG_QUALITY: Final = 84
COLUMNS: Final = 12
_STAMP: Final = (56, 56)
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
    mapping becomes a group of rows. ``date`` is at the top.
    """

    conditions: Mapping[str, Any] = field(default_factory=dict)
    wall_clock: Mapping[str, Any] = field(default_factory=dict)
    date: datetime | None = None


def render_report(
    title: str,
    summary: str,
    enrollments: Sequence[EnrollmentRecord],
    identifications: Sequence[IdentificationRecord],
    *,
    meta: Meta,
) -> str:
    """Return the page; sections without content are left out.

    Parameters
    ----------
    title, summary
        The headline and a sentence below it, plain text.
    enrollments, identifications
        In the order of the page.
    meta
        Conditions and wall-clock times.
    """
    with_truth = any(record.truth is not None for record in identifications)
    return _template().render(
        title=title,
        date="" if meta.date is None else f"{meta.date.astimezone(UTC):%Y-%m-%d %H:%M} UTC",
        summary=summary,
        totals=totals(enrollments, identifications),
        retrievals=[
            _retrieval(number, record, unfold=number == 1 or len(identifications) <= _FEW)
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


def write_report(path: Path, html: str) -> None:
    """Write the page to ``path`` completely or not at all; create missing folders.

    Raises
    ------
    UsageError
        The file cannot be written there.
    """
    step = ("Choose a folder that you may write to, on a disk with free space.", Do.RUN_AGAIN(out="FILE"))
    with os_errors_as(UsageError, f"The report cannot be written to {path}.", next_step=step):
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, html.encode())


@cache
def _template() -> Template:
    return environment("rig.report").get_template("page.html.j2")


class _Frame(NamedTuple):
    number: int
    picture: str
    where: str
    rejected: str
    leading: list[tuple[str, str, str]]
    margin: str
    decided: str
    moved: str
    decision: str


class _Retrieval(NamedTuple):
    number: int
    stamp: str
    truth: str
    answer: str
    correctness: Correctness | None
    views: str
    travelled: str
    pose_error: str
    score: str
    margin: str
    words: str
    path: Markup
    compared: bool
    scores: Markup
    arc: ArcFigure
    notes: list[str]
    decisions: list[Markup]
    differs: str
    verification: str
    comparison: str
    frames: list[_Frame]
    unfold: bool


class _Object(NamedTuple):
    number: int
    stamp: str
    name: str
    line: str
    retakes: int
    sheet: str
    ring: Markup
    items_: list[SummaryItem]
    unfold: bool


def _retrieval(number: int, record: IdentificationRecord, *, unfold: bool) -> _Retrieval:
    answer, views, compared = record.answer, record.views, record.compared
    error_deg = record.pose_error_deg
    path = scores = Markup()
    if views:
        start_deg = _report_azimuth_deg(record, views[0].azimuth_deg)
        scale = "azimuth on the table" if record.yaw_deg is None else "azimuth as enrolled"
        path = Markup(polar_path(start_deg, record.steps, scale=scale))
    if record.ranked:
        rounds = [{c.name: c.score for c in ranked.candidates} for ranked in record.ranked]
        truth = record.truth.name if record.truth else None
        scores = Markup(
            score_chart(
                rounds,
                winner=answer.name if answer else None,
                truth=truth,
                min_score=answer.min_score if answer else None,
            )
        )
    return _Retrieval(
        number=number,
        stamp=_data_uri(thumbnail(views[0].picture_bgr, _STAMP)) if views else "",
        truth=_truth(record),
        answer=outcome_words(answer) if answer else "no answer",
        correctness=record.correctness,
        views=f"{answer.views if answer else len(views)}",
        travelled=f"{answer.travelled_deg:.0f}°" if answer else "–",
        pose_error="–" if error_deg is None else f"{error_deg:.1f}°",
        score=f"{answer.score:.3f}" if answer else "–",
        margin=signed(answer.margin, 3) if answer else "–",
        words=answer_words(answer) if answer else "The search ended without an answer.",
        path=path,
        compared=any(event.s_left is not None for event in record.decided),
        scores=scores,
        arc=arc_figure(record),
        notes=[f"{sentence(note_words(note))} {in_words(note_steps(note))}" for note in record.notes],
        decisions=_decisions(record),
        differs="" if compared is None or compared.picture_bgr is None else _data_uri(compared.picture_bgr),
        verification="" if record.verified is None else sentence(verification_words(record.verified)),
        comparison="" if compared is None else sentence(comparison_words(compared)),
        frames=_frames(record),
        unfold=unfold or record.correctness is Correctness.WRONG,
    )


def _truth(record: IdentificationRecord) -> str:
    if record.truth is None:
        return ""
    if record.truth.name is not None:
        return record.truth.name
    return f"{record.truth.description} (never enrolled)" if record.truth.description else "never enrolled"


def _report_azimuth_deg(record: IdentificationRecord, azimuth_deg: float) -> float:
    """Convert to the azimuth scale of the report: that of the enrollment if the object was found, else the table's."""
    return wrap360(azimuth_deg - (record.yaw_deg or 0.0))


def _leading(one: Candidate, ranked: Ranked) -> tuple[str, str, str]:
    return one.name, f"{one.score:.3f}", share_words(one, ranked.decision)


def _decisions(record: IdentificationRecord) -> list[Markup]:
    """Return a chart for each decision that compared all possible rotations."""
    seen_deg = {view.index: _report_azimuth_deg(record, view.azimuth_deg) for view in record.views}
    return [
        Markup(
            decision_chart(
                seen_deg[event.index],
                event.weighed,
                event.rotation_deg,
                reason=event.reason,
                candidates=event.candidates,
                seen_deg=[azimuth_deg for index, azimuth_deg in seen_deg.items() if index <= event.index],
                number=event.index + 1,
            )
        )
        for event in record.decided
        if event.weighed is not None and event.weighed.rotations_deg and event.index in seen_deg
    ]


def _frames(record: IdentificationRecord) -> list[_Frame]:
    ranked = {event.index: event for event in record.ranked}
    decided = {event.index: event for event in record.decided}
    frames = []
    for view in record.views:
        thought = ranked.get(view.index)
        decision = decided.get(view.index)
        frames.append(
            _Frame(
                number=view.index + 1,
                picture=_data_uri(view.picture_bgr),
                where=f"{azimuth_words(_report_azimuth_deg(record, view.azimuth_deg))}°",
                rejected=listed(view.rejected),
                leading=[_leading(c, thought) for c in thought.candidates[:3]] if thought else [],
                decided=sentence(words) if (words := ranking_words(thought)) else "",
                margin=signed(thought.margin, 3) if thought else "",
                moved=sentence(move_words(view.move)) if view.move and view.index else "",
                decision=decision_words(decision) if decision else "",
            )
        )
    return frames


def _object(number: int, record: EnrollmentRecord, *, unfold: bool) -> _Object:
    views = record.views
    sheet = stamp = ""
    ring = Markup()
    if views:
        pictures = [view.picture_bgr for view in views]
        sheet = _data_uri(
            contact_sheet(
                pictures, [view.azimuth_deg for view in views], columns=min(COLUMNS, len(pictures)), tile=TILE
            )
        )
        stamp = _data_uri(thumbnail(pictures[0], _STAMP))
        ring = Markup(azimuth_ring([RingView(v.azimuth_deg, v.evidence.sharpness, len(v.rejected)) for v in views]))
    retakes = record.retakes
    line = counted(len(views), "view")
    if record.result is None:
        line += f" of {record.planned}: not finished"
    if retakes:
        line += f", {counted(retakes, 'retake')}"
    return _Object(number, stamp, record.name, line, retakes, sheet, ring, enrollment_items(record), unfold)


def _data_uri(image_bgr: Image) -> str:
    encoded, jpeg = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert encoded  # uint8 (H, W, 3) with pixels: `thumbnail` has made it
    return f"data:image/jpeg;base64,{b64encode(jpeg.tobytes()).decode('ascii')}"


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
        return ", ".join(_text(item) for item in value)
    return str(value)
