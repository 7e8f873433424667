"""One line of text for each event: for terminals, web pages and logs."""

from typing import Final

from hbr import Outcome
from rig.core.next_steps import NextStep, NextSteps, in_words, steps_from_json
from rig.core.phrases import (
    angle_words,
    azimuth_words,
    counted,
    duration_words,
    percent,
    percent_words,
    sentence,
    signed,
)
from rig.events.events import (
    Accepted,
    Candidate,
    Decided,
    EmptyTableImage,
    Enrolled,
    Event,
    Failed,
    FrameUsed,
    Identified,
    Item,
    Moved,
    ObjectChanged,
    Ranked,
    Recorded,
    Rejected,
    ScanStarted,
    SimilarObjects,
    SkipReason,
    Started,
    Unwinding,
    Verified,
    Waiting,
    Warned,
)
from rig.events.wording import (
    NOT_ENROLLED,
    answer_lines,
    change_words,
    decision_words,
    move_words,
    note_steps,
    note_words,
    scan_words,
    share_words,
    similar_objects_words,
    unwinding_words,
    verification_words,
    wait_words,
)
from rig.views.capture import rejection_text
from rig.views.description import BENCH_DESCRIPTOR

SHOWN = 3
"""Candidates in the line of a ranking."""
_ENOUGH: Final = {
    Outcome.CONTINUE: "",
    Outcome.FOUND: ", enough to end the search",
    Outcome.UNKNOWN: ", not enrolled",
    Outcome.AMBIGUOUS: ", ambiguous",
}


def next_steps(event: Event) -> NextSteps:
    """Return what the operator should do about an event; empty if nothing."""
    match event:
        case Started():
            found: list[str | NextStep] = []
            for note in event.notes:
                found += (step for step in note_steps(note) if step not in found)
            return tuple(found)
        case Warned():
            return note_steps(event.note)
        case Failed():
            return steps_from_json(event.steps)
        case _:
            return ()


def line(event: Event) -> str:
    """Return the text of an event for a terminal; empty if it has none."""
    match event:
        case Started():
            paper = " (the paper's AHBR by CEDD: --strategy ahbr)" if event.descriptor == BENCH_DESCRIPTOR else ""
            method = [f"{_method(event)}{paper}"] if event.strategy else []
            notes = [(f"Note: {note_words(note)}.", in_words(note_steps(note))) for note in event.notes]
            return "\n".join([*method, *(" ".join(filter(None, note)) for note in notes)])
        case Waiting():
            return f"{page_line(event)[:-1]}; Ctrl+C ends."
        case Warned() | Failed():
            return f"{page_line(event)}\nNext step: {in_words(next_steps(event))}"
        case _:
            return page_line(event)


def _method(event: Started) -> str:
    return f"Method: {event.strategy}, by {event.descriptor}"


def page_line(event: Event) -> str:
    """Return the text of an event for a page or a file, which show its next steps in their own way."""
    match event:
        case Started():
            method = [_method(event)] if event.strategy else []
            return "\n".join([*method, *(f"Note: {note_words(note)}." for note in event.notes)])
        case Moved():
            encoder, asked = (angle_words(angle, 2) for angle in (event.encoder_deg, event.commanded_deg))
            return f"  table at {encoder} (asked {asked}): {move_words(event)}"
        case ScanStarted():
            return f"  {scan_words(event)}"
        case Unwinding():
            return f"  {unwinding_words(event)}"
        case Rejected():
            texts = "; ".join(rejection_text(reason, event.evidence) for reason in event.reasons)
            return f"view {event.index + 1}, attempt {event.attempt}: rejected, {texts}"
        case Accepted():
            return f"view {event.index + 1}, azimuth {azimuth_words(event.azimuth_deg)}°"
        case Ranked():
            leaders = [_leader(one) for one in event.candidates[:SHOWN]]
            if event.decision is not None:
                leaders.append(f"{NOT_ENROLLED} ({percent_words(event.decision.not_enrolled)})")
            return f"  candidates: {', '.join(leaders)} (margin {signed(event.margin, 3)})"
        case FrameUsed():
            return f"  {_frame_words(event)}"
        case ObjectChanged():
            return f"  {change_words(event)}"
        case Decided():
            return f"  {decision_words(event)} The table rotates to {angle_words(event.target_deg)}."
        case Enrolled():
            retakes = f", {counted(event.retakes, 'rejected image')}" if event.retakes else ""
            took = duration_words(event.seconds)
            return f"{event.name}: {counted(event.views, 'view')} enrolled in {took}{retakes}"
        case Verified():
            return f"  {sentence(verification_words(event))}"
        case Identified():
            least = "" if event.min_score is None else f" (unknown below {event.min_score:.3f})"
            numbers = (
                f"Score {event.score:.3f} per view{least}, "
                f"margin {signed(event.margin, 3)}, {event.travelled_deg:.0f}° of rotation, "
                f"{duration_words(event.seconds)}."
            )
            return "\n  ".join([*answer_lines(event), numbers])
        case Item(action="skip"):
            return f"{event.number} of {event.of}  {event.name}: skipped, {_skip_words(event)}"
        case Item():
            return ""
        case SimilarObjects():
            return "\n".join(f"  {words}" for words in similar_objects_words(event))
        case EmptyTableImage():
            share = "" if event.turning_share is None else f", {percent(event.turning_share)} rotates with the table"
            each = "" if event.images == 1 else f"{event.images} azimuths, each "
            return f"Empty-table image: {each}{event.width} × {event.height} pixels{share}"
        case Warned():
            return f"Warning: {note_words(event.note)}."
        case Waiting():
            return f"Waiting for {wait_words(event.reason)}."
        case Recorded():
            return f"Recorded as result {event.result}{f', sample {event.sample}' if event.sample else ''}."
        case Failed():
            return f"Error {event.code} ({event.error}): {event.what}"


def _leader(one: Candidate) -> str:
    share = share_words(one)
    return f"{one.name} {one.score:.3f}{f' ({share})' if share else ''} at {azimuth_words(one.pose_deg)}°"


def _frame_words(used: FrameUsed) -> str:
    """Return the state of a search in motion after a frame, in words."""
    best = f"{used.name} {percent_words(used.probability)}{_ENOUGH[used.outcome]}"
    where = f"azimuth {azimuth_words(used.azimuth_deg)}°, {used.seconds:.1f} s"
    rejected = f" ({counted(used.rejected, 'frame')} rejected)" if used.rejected else ""
    return f"in motion: {best}; view {used.index + 1}, {where}{rejected}"


def _skip_words(item: Item) -> str:
    match item.reason:
        case SkipReason.OPERATOR:
            return "as the operator asked"
        case SkipReason.ERROR:
            return f"because of error {item.error_code}"
        case _:
            return "it is already enrolled"
