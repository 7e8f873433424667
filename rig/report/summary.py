"""The numbers at the top of a report, counted from its records."""

from collections.abc import Sequence
from statistics import fmean, median
from typing import NamedTuple

from rig.core.phrases import counted, listed, percent_words, signed
from rig.events.events import SimilarObjects
from rig.events.wording import outcome_words, similar_object_words
from rig.report.records import Correctness, EnrollmentRecord, IdentificationRecord


class SummaryItem(NamedTuple):
    """A number with its label and a note."""

    label: str
    value: str
    note: str = ""


def count_of(correctness: Correctness, records: Sequence[IdentificationRecord]) -> int:
    """Return the number of searches with this correctness."""
    return sum(record.correctness is correctness for record in records)


def totals(
    enrollments: Sequence[EnrollmentRecord], identifications: Sequence[IdentificationRecord]
) -> list[SummaryItem]:
    """Return the headline numbers of a run; the numbers of a single enrollment are beside its views instead."""
    items = []
    if len(enrollments) + len(identifications) > 1 and enrollments:
        views = sum(len(record.views) for record in enrollments)
        retakes = sum(record.retakes for record in enrollments)
        finished = sum(record.result is not None for record in enrollments)
        items.append(
            SummaryItem("objects enrolled", f"{finished}", f"{counted(views, 'view')}, {counted(retakes, 'retake')}")
        )
    answered = [record for record in identifications if record.answer is not None]
    if len(identifications) == 1 and not identifications[0].truth:
        return items + (_answer_items(answered[0]) if answered else [])
    known = [record for record in answered if record.truth and record.truth.name is not None]
    unknown = [record for record in answered if record.truth and record.truth.name is None]
    if known:
        right, ambiguous = (count_of(one, known) for one in (Correctness.RIGHT, Correctness.AMBIGUOUS))
        items.append(SummaryItem("found", f"{right}/{len(known)}", "enrolled objects identified correctly"))
        items.append(SummaryItem("ambiguous", f"{ambiguous}/{len(known)}", "may be one of several enrolled objects"))
    if unknown:
        right = count_of(Correctness.RIGHT, unknown)
        items.append(SummaryItem("unknown objects recognised", f"{right}/{len(unknown)}", "objects never enrolled"))
    if answered:
        views_taken = [record.answer.views for record in answered if record.answer]
        travelled = [record.answer.travelled_deg for record in answered if record.answer]
        items.append(
            SummaryItem(
                "views to an answer", f"{fmean(views_taken):.1f}", f"mean; {min(views_taken)} to {max(views_taken)}"
            )
        )
        items.append(
            SummaryItem("rotation", f"{fmean(travelled):.0f}°", f"mean of a search; {sum(travelled):.0f}° in all")
        )
    errors = [record.pose_error_deg for record in answered if record.pose_error_deg is not None]
    if errors:
        items.append(
            SummaryItem("pose error", f"{median(errors):.1f}°", f"median of {len(errors)}; largest {max(errors):.1f}°")
        )
    return items


def enrollment_items(record: EnrollmentRecord) -> list[SummaryItem]:
    """Return the numbers of one enrollment."""
    views = record.views
    items = [SummaryItem("views", f"{len(views)}", f"of {record.planned} planned")]
    reasons = listed(reason for view in views for reason in view.rejected)
    items.append(SummaryItem("retakes", f"{record.retakes}", reasons))
    if views:
        sharpness = [view.evidence.sharpness for view in views]
        levels = [view.evidence.mean_level for view in views]
        items.append(
            SummaryItem(
                "sharpness", f"{median(sharpness):.0f}", f"median; {min(sharpness):.0f} to {max(sharpness):.0f}"
            )
        )
        items.append(
            SummaryItem("mean level", f"{fmean(levels):.0f}", f"of 255; {min(levels):.0f} to {max(levels):.0f}")
        )
    moves = [view.move for view in views if view.move is not None]
    if moves:
        off = max(abs(move.encoder_deg - move.commanded_deg) for move in moves)
        items.append(SummaryItem("position error", f"{off:.2f}°", "largest, by the encoder"))
    gaps = [
        abs(move.rotation_encoder_deg - move.rotation_imu_deg) for move in moves if move.rotation_imu_deg is not None
    ]
    if gaps:
        agree = sum(move.agrees for move in moves)
        items.append(
            SummaryItem(
                "encoder against gyro", f"{max(gaps):.2f}°", f"largest difference; {agree} of {len(moves)} moves agree"
            )
        )
    if record.similar:
        items.append(_symmetry(record.similar))
        similar = [similar_object_words(one) for one in record.similar.objects]
        items.append(SummaryItem("looks like", similar[0] if similar else "no other", "; ".join(similar[1:])))
    if record.result:
        items.append(SummaryItem("bench time", f"{record.result.seconds:.0f} s"))
    return items


def _symmetry(similar: SimilarObjects) -> SummaryItem:
    if similar.period_deg is None or similar.neighbour_similarity is None or similar.period_similarity is None:
        return SummaryItem("symmetry", "–", "too few views")
    note = f"similarity {similar.period_similarity:.3f}, of neighbouring views {similar.neighbour_similarity:.3f}"
    if similar.period_deg == 360:
        return SummaryItem("symmetry", "none", note)
    return SummaryItem(
        "symmetry", f"every {similar.period_deg:g}°" if similar.period_deg else "the same from all sides", note
    )


def _answer_items(record: IdentificationRecord) -> list[SummaryItem]:
    answer = record.answer
    if answer is None:
        return []
    return [
        SummaryItem("answer", outcome_words(answer)),
        *([] if answer.confidence is None else [SummaryItem("confidence", percent_words(answer.confidence))]),
        SummaryItem("score", f"{answer.score:.3f}", f"per view; margin {signed(answer.margin, 3)}"),
        SummaryItem("views", f"{answer.views}"),
        SummaryItem("rotation", f"{answer.travelled_deg:.0f}°"),
        SummaryItem("bench time", f"{answer.seconds:.1f} s"),
    ]
