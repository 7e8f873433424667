"""The events of a plan in words: a line for each, and its parts, for terminals, pages, logs and reports."""

from collections.abc import Sequence
from math import ceil, nan
from typing import Final

from hbr import Outcome, StopDecision, StopReason
from hbr.model.symmetry import SimilarObject
from rig.core.errors import Problem
from rig.core.next_steps import Do, NextStep, NextSteps, in_words, steps_from_json
from rig.core.phrases import (
    angle_range,
    angle_words,
    azimuth_words,
    counted,
    distinct,
    duration_words,
    filled,
    joined,
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
    Note,
    NoteCode,
    ObjectChanged,
    Ranked,
    Recorded,
    Rejected,
    RotationReason,
    ScanStarted,
    SimilarObjects,
    Started,
    Unwinding,
    Verified,
    Waiting,
    Warned,
)
from rig.motion.scan_speed import SpeedLimit
from rig.views.capture import rejection_text
from rig.views.description import BENCH_DESCRIPTOR
from rig.views.table_problems import problem_text

NOT_ENROLLED: Final = "not enrolled"
"""What the object on the table may be, beside the candidates."""
SHOWN: Final = 3
"""Candidates in the line of a ranking."""
NAMED: Final = 5
"""Objects that an ambiguous answer names."""
ARCS_NAMED: Final = 3
"""Ranges of azimuth that are named."""
_ENOUGH: Final = {
    Outcome.CONTINUE: "",
    Outcome.FOUND: ", enough to end the search",
    Outcome.UNKNOWN: ", not enrolled",
    Outcome.AMBIGUOUS: ", ambiguous",
}
_SPEED_LIMITS: Final = {
    SpeedLimit.SMEAR: "{value:g} ms exposure allows {speed:.0f} °/s",
    SpeedLimit.FRAME_RATE: "{value:g} frames/s allow {speed:.0f} °/s",
    SpeedLimit.TABLE: "table.velocity_dps allows {speed:.0f} °/s",
    SpeedLimit.GYRO: "the gyro's range of {value:g} °/s allows {speed:.0f} °/s",
    SpeedLimit.TIME: "frame times that are uncertain by {value:.1f} ms allow {speed:.0f} °/s",
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
            return event.error.steps
        case _:
            return ()


def line(event: Event) -> str:
    """Return the text of an event for a terminal; empty if it has none."""
    match event:
        case Started():
            paper = " (the paper's AHBR by CEDD: --strategy ahbr)" if event.descriptor == BENCH_DESCRIPTOR else ""
            method = [f"Method: {event.strategy}, by {event.descriptor}{paper}"] if event.strategy else []
            notes = [(f"Note: {note_words(note)}.", in_words(note_steps(note))) for note in event.notes]
            return "\n".join([*method, *(" ".join(filter(None, note)) for note in notes)])
        case Waiting():
            return f"{page_line(event)[:-1]}; Ctrl+C ends."
        case Warned() | Failed():
            return f"{page_line(event)}\nNext step: {in_words(next_steps(event))}"
        case _:
            return page_line(event)


def page_line(event: Event) -> str:
    """Return the text of an event for a page or a file, which show its next steps in their own way."""
    match event:
        case Started():
            method = [f"Method: {event.strategy}, by {event.descriptor}"] if event.strategy else []
            return "\n".join([*method, *(f"Note: {note_words(note)}." for note in event.notes)])
        case Moved():
            encoder, asked = (angle_words(angle, 2) for angle in (event.encoder_deg, event.commanded_deg))
            return f"  table at {encoder} (asked {asked}): {move_words(event)}"
        case ScanStarted():
            limit = _SPEED_LIMITS[event.limit].format(value=event.value, speed=event.speed_dps)
            return f"  one revolution from {angle_words(event.from_deg)} to {angle_words(event.to_deg)}: {limit}"
        case Unwinding():
            way = f"from {angle_words(event.from_deg)} back to {angle_words(event.to_deg)}"
            return f"  Unwinding the cable: the table rotates {way} (the cable allows {angle_range(event.limits_deg)})"
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
            best = f"{event.name} {percent_words(event.probability)}{_ENOUGH[event.outcome]}"
            where = f"azimuth {azimuth_words(event.azimuth_deg)}°, {event.seconds:.1f} s"
            rejected = f" ({counted(event.rejected, 'frame')} rejected)" if event.rejected else ""
            return f"  in motion: {best}; view {event.index + 1}, {where}{rejected}"
        case ObjectChanged():
            since = f"view {event.first + 1}" if event.first == event.index else f"views from {event.first + 1} on"
            return (
                f"  The object on the table was changed or rotated by hand. The search begins again with {since} "
                f"(evidence {event.evidence:.1f}, needed {event.needed:.1f})."
            )
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
        case Item():
            if event.reason is None:
                return ""
            why = filled(event.reason.words, event.error_code)
            return f"{event.number} of {event.of}  {event.name}: skipped, {why}"
        case SimilarObjects():
            like = [f"{similar_object_words(one)} (similarity up to {one.similarity:.3f})" for one in event.objects]
            found = [_symmetry_words(event), *(f"looks like {one}" for one in like or ["no other enrolled object"])]
            return "\n".join(f"  {words}" for words in filter(None, found))
        case EmptyTableImage():
            share = "" if event.turning_share is None else f", {percent(event.turning_share)} rotates with the table"
            each = "" if event.images == 1 else f"{event.images} azimuths, each "
            return f"Empty-table image: {each}{event.width} × {event.height} pixels{share}"
        case Warned():
            return f"Warning: {note_words(event.note)}."
        case Waiting():
            return f"Waiting for {event.reason.words}."
        case Recorded():
            return f"Recorded as result {event.result}{f', sample {event.sample}' if event.sample else ''}."
        case Failed():
            return problem_line(event.error)


def problem_line(problem: Problem) -> str:
    """Return an error in a line, without its next step."""
    return f"Error {problem.code} ({problem.title}): {problem.detail}"


def _leader(one: Candidate) -> str:
    share = share_words(one)
    return f"{one.name} {one.score:.3f}{f' ({share})' if share else ''} at {azimuth_words(one.pose_deg)}°"


# -- the parts of the lines --------------------------------------------------------------------------------------------


def decision_words(decided: Decided) -> str:
    """Return the camera's rotation and its reason: "left 47.3°: the leading candidates look less similar there …."."""
    # A rotation of AHBR is at most 90°; a larger one leads past views that were taken before (`hbr.next_view`).
    past = decided.s_left is not None and round(abs(decided.rotation_deg), 1) > 90
    rotation = f"{decided.side} {abs(decided.rotation_deg):.1f}°{', past earlier views' if past else ''}"
    return f"{rotation}: {_rotation_words(decided)}."


def _rotation_words(decided: Decided) -> str:
    match decided.reason:
        case RotationReason.LESS_SIMILAR_SIDE if decided.s_left is not None and decided.s_right is not None:
            return _side_words(decided.side, decided.s_left, decided.s_right, len(decided.candidates))
        case RotationReason.SEPARATES_CANDIDATES if decided.weighed is not None and decided.weighed.similarity:
            similarity = decided.weighed.similarity
            here = similarity[decided.weighed.rotations_deg.index(decided.rotation_deg)]
            first, second = decided.candidates[:2]
            return (
                f"distinguishes {first} from {second}, similarity {here:.2f} there "
                f"({min(similarity):.2f}–{max(similarity):.2f} all around)"
            )
        case RotationReason.SEPARATES_CANDIDATES if len(decided.candidates) >= 2:
            return f"the frames on the way distinguish {decided.candidates[0]} from {decided.candidates[1]}"
        case _:
            return decided.reason.words or decided.note


def _side_words(side: str, s_left: float, s_right: float, candidates: int) -> str:
    left, right = distinct(s_left, s_right)
    leading = "the two leading candidates" if candidates == 2 else "the leading candidates"
    if s_left == s_right:
        return f"{leading} look equally similar on both sides: S_left {left} = S_right {right}"
    smaller, larger = (
        (f"S_left {left}", f"S_right {right}") if side == "left" else (f"S_right {right}", f"S_left {left}")
    )
    return f"{leading} look less similar there: {smaller} < {larger}"


def stop_words(decision: StopDecision, views: int) -> str:
    """Return what the search decided after ``views`` views, and why."""
    share, least = percent_words(decision.probability), percent_words(decision.min_confidence)
    match decision.reason:
        case StopReason.CONFIDENT:
            return f"the confidence {share} reaches {least}"
        case StopReason.NOT_ENROLLED:
            return f"not enrolled with {percent_words(decision.not_enrolled)}"
        case StopReason.BADLY_SEGMENTED:
            return "the background is not known yet; another view shows it"
        case StopReason.NOT_CONFIDENT:
            return f"not confident yet: {share}, and {least} ends the search"
        case _:
            return f"the best candidate after {counted(views, 'view')}, with a probability of {share} below {least}"


def ranking_words(ranked: Ranked | None) -> str:
    """Return what the search decided with a ranking, and why; empty in the paper's search."""
    return "" if ranked is None or ranked.decision is None else stop_words(ranked.decision, ranked.index + 1)


def verification_words(verified: Verified) -> str:
    """Return what the comparison of the leading candidate with the views found, as a sentence without its full stop."""
    own, second, expected = map(percent_words, (verified.fit, verified.second, verified.expected))
    return (
        f"compared with {verified.name} pixel by pixel: its enrolled views explain {own} of the contrast (of each "
        f"other {expected}), those of the second candidate {second}; it is {verified.name} with "
        f"{percent_words(verified.probability)}, and not enrolled with {percent_words(verified.not_enrolled)}"
    )


def reason_words(answer: Identified) -> str:
    """Return why a search ended."""
    match answer.reason:
        case StopReason.MARGIN:
            return f"the margin {answer.margin:.3f} per view reaches {answer.min_margin:g}"
        case StopReason.NO_ROTATION_LEFT:
            return "the cable allows no other view"
        case StopReason.CUSTOM:
            return answer.note
        case StopReason.MAX_VIEWS if answer.not_enrolled is None:
            return f"the search took all {counted(answer.views, 'view')} that are allowed"
        case StopReason.CONFIDENT if answer.outcome is Outcome.UNKNOWN and answer.min_score is not None:
            # The share is that among the enrolled objects: it says nothing about an object that is not enrolled.
            return f"the score {answer.score:.3f} of the likeliest object is below {answer.min_score:.3f}"
    share = answer.candidates[0].probability if answer.confidence is None else answer.confidence
    numbers = (share, answer.not_enrolled, answer.min_confidence)
    share, not_enrolled, least = (nan if number is None else number for number in numbers)
    return stop_words(StopDecision(answer.outcome, answer.reason, 0, share, not_enrolled, least), answer.views)


def share_words(one: Candidate) -> str:
    """Return a candidate's probability; empty in the paper's search."""
    return "" if one.probability is None else percent_words(one.probability)


def move_words(moved: Moved) -> str:
    """Return the table's rotation as encoder and gyro measured it, and whether they agree."""
    words = f"rotation {signed(moved.rotation_encoder_deg, 2)}° (encoder)"
    if moved.rotation_imu_deg is None:
        return f"{words}, no gyro value"
    sigma = "" if moved.imu_sigma_deg is None else f" ± {moved.imu_sigma_deg:.2f}"
    words += f", {signed(moved.rotation_imu_deg, 2)}{sigma}° (gyro)"
    if moved.agrees:
        return words
    bound = "" if moved.bound_deg is None else f" by more than {moved.bound_deg:.2f}°"
    return f"{words}; they differ{bound}, so the gyro value counts"


def result_words(answer: Identified) -> str:
    """Return the result alone: "mug-white, rotated 70°, 99 % confident (2 views)".

    An ambiguous object is given with the objects that it may be, an unknown one with its three most similar objects.
    """
    if answer.outcome is Outcome.AMBIGUOUS:
        return f"Ambiguous: {_one_of(answer)} ({counted(answer.views, 'view')})"
    if answer.name is None:
        similar = [f"{candidate.name} (score {candidate.score:.3f})" for candidate in answer.candidates[:3]]
        verb = "objects are" if len(similar) > 1 else "object is"
        return f"Unknown object. The most similar enrolled {verb} {joined(similar)}."
    words = f"{answer.name}{_pose_words(answer)}"
    if answer.confidence is not None:
        percent = ">99.9" if answer.confidence > 0.999 else min(round(answer.confidence * 100), 99)
        words += f", {percent} % confident"
    return f"{words} ({counted(answer.views, 'view')})"


def _pose_words(answer: Identified) -> str:
    """Return the rotation of a found object, as far as it is known: ", rotated 70° ± 2°"."""
    if not answer.yaw_set_deg:
        return " (looks the same from all sides)" if answer.period_deg == 0 else ", rotation not determined"
    words = f", rotated {round(answer.yaw_set_deg[0]) % 360}°"
    if answer.yaw_sigma_deg is not None:
        words += f" ± {max(1, ceil(answer.yaw_sigma_deg))}°"
    others = len(answer.yaw_set_deg) - 1
    if others:
        words += f" or one of {others + 1} equivalent poses (every {answer.period_deg:.3g}°)"
    return words


def outcome_words(answer: Identified) -> str:
    """Return the answer in a few words for a heading or a table: "mug-white", "mug-white or mug-star", "unknown"."""
    if answer.outcome is Outcome.UNKNOWN:
        return "unknown"
    names = list(answer.possible)
    return joined(names, "or") if len(names) <= 2 else f"{names[0]} or {len(names) - 1} others"


def _one_of(answer: Identified) -> str:
    """Return what an ambiguous object may be, with the probabilities if there are some."""
    probability = {one.name: one.probability for one in answer.candidates}
    items = [
        name if (share := probability.get(name)) is None else f"{name} ({percent_words(share)})"
        for name in answer.possible[:NAMED]
    ]
    more = len(answer.possible) - NAMED
    items += [f"{more} more"] if more > 0 else []
    if answer.not_enrolled is not None:
        items.append(f"{NOT_ENROLLED} ({percent_words(answer.not_enrolled)})")
    return joined(items, "or")


def answer_lines(answer: Identified) -> tuple[str, str]:
    """Return the result, and why the search ended."""
    reason = sentence(reason_words(answer))
    has_shares = answer.candidates[0].probability is not None and answer.not_enrolled is None
    if answer.outcome is Outcome.UNKNOWN and has_shares:
        reason += " Percentages of candidates are shares among the enrolled objects."
    if answer.left_out:
        reason += f" The object changed, so {counted(len(answer.left_out), 'earlier view')} did not count."
    return result_words(answer), reason


def answer_words(answer: Identified) -> str:
    """Return the answer in sentences: the result first, then why the search ended."""
    result, reason = answer_lines(answer)
    return f"{result.removesuffix('.')}. {reason}"


def _symmetry_words(similar: SimilarObjects) -> str:
    """Return what an object's views show about its symmetry; empty if they show nothing."""
    if similar.neighbour_similarity is None or similar.period_similarity is None or similar.period_deg in (None, 360):
        return ""
    numbers = f"similarity {similar.period_similarity:.3f}, of neighbouring views {similar.neighbour_similarity:.3f}"
    if similar.period_deg == 0:
        return f"looks the same from all sides (smallest {numbers}): its pose cannot be determined"
    return f"looks the same every {similar.period_deg:g}° ({numbers}): its pose is known up to that angle"


def similar_object_words(one: SimilarObject) -> str:
    """Return a similar object and the azimuths of the similar views: "mug-03 from 120–200°", "... from all sides"."""
    own, theirs, same = map(_arcs_words, (one.differs_deg, one.other_differs_deg, one.arcs_deg))
    if not one.differs_deg and not one.other_differs_deg:
        return f"{one.name} from all sides"
    if not one.differs_deg:
        return f"{one.name}, which looks different {f'at {theirs}' if theirs else 'from some sides'}"
    if one.share > 0.5:
        return f"{one.name} from {f'all sides but {own}' if own else 'most sides'}"
    return f"{one.name} from {same or 'some sides'}"


def _arcs_words(arcs_deg: Sequence[tuple[float, float]]) -> str:
    """Return ranges of azimuth: "120–200° and 300°"; empty for more ranges than a reader can use."""
    ends = [(f"{round(a) % 360}", f"{round(b) % 360}") for a, b in arcs_deg]
    return joined([f"{a}°" if a == b else f"{a}–{b}°" for a, b in ends]) if len(ends) <= ARCS_NAMED else ""


def note_words(note: Note) -> str:
    """Return a note as a sentence without its full stop."""
    values = note.values
    problems = [*values.get("problems", ()), *([values["problem"]] if "problem" in values else ())]
    named = {**values, "problems": "; ".join(map(problem_text, problems))}
    if note.code is NoteCode.MIXED_EMPTY_TABLE:
        names = values["objects"]
        more = [f"{len(names) - 3} more"] if len(names) > 3 else []
        named["objects"] = joined([*names[:3], *more])
        named |= {"were": "was" if len(names) == 1 else "were", "how": "with" if values["with_image"] else "without"}
    return filled(note.code.words, **named).rstrip(".")


def note_steps(note: Note) -> NextSteps:
    """Return what the operator should do about a note; empty if nothing."""
    match note.code:
        case NoteCode.MIXED_EMPTY_TABLE | NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE:
            return (Do.ENROLL_AGAIN(),)
        case NoteCode.EMPTY_TABLE_DOUBTED | NoteCode.EMPTY_TABLE_MISSING | NoteCode.EMPTY_TABLE_OF_ENROLLMENT:
            return (Do.EMPTY_TABLE(),)
        case NoteCode.EMPTY_TABLE_CHANGED:
            return ("Continue; these views do not use the image.", Do.EMPTY_TABLE())
        case NoteCode.TABLE_DIFFERS:
            return ("Check that the table is empty. If it is not, remove the object, and", Do.EMPTY_TABLE())
        case _:
            return steps_from_json(note.values.get("steps", ()))
