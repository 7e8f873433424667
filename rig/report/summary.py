"""The numbers at the top of a report, counted from its records."""

from collections.abc import Iterator, Sequence
from statistics import fmean, median
from typing import NamedTuple

from rig.core.phrases import counted, listed, percent_words, signed
from rig.events.events import Identified, SimilarObjects
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
) -> Iterator[SummaryItem]:
    """Yield the headline numbers of a run; the numbers of a single enrollment are beside its views instead."""
    if len(enrollments) + len(identifications) > 1 and enrollments:
        views = counted(sum(len(record.views) for record in enrollments), "view")
        retakes = counted(sum(record.retakes for record in enrollments), "retake")
        finished = sum(record.result is not None for record in enrollments)
        yield SummaryItem("objects enrolled", f"{finished}", f"{views}, {retakes}")
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


def enrollment_items(record: EnrollmentRecord) -> Iterator[SummaryItem]:
    """Yield the numbers of one enrollment."""
    views = record.views
    yield SummaryItem("views", f"{len(views)}", f"of {record.planned} planned")
    yield SummaryItem("retakes", f"{record.retakes}", listed(reason for view in views for reason in view.rejected))
    if views:
        sharpness = [view.evidence.sharpness for view in views]
        levels = [view.evidence.mean_level for view in views]
        yield SummaryItem(
            "sharpness", f"{median(sharpness):.0f}", f"median; {min(sharpness):.0f} to {max(sharpness):.0f}"
        )
        yield SummaryItem("mean level", f"{fmean(levels):.0f}", f"of 255; {min(levels):.0f} to {max(levels):.0f}")
    moves = [view.move for view in views if view.move is not None]
    if moves:
        off = max(abs(move.encoder_deg - move.commanded_deg) for move in moves)
        yield SummaryItem("position error", f"{off:.2f}°", "largest, by the encoder")
    gaps = [
        abs(move.rotation_encoder_deg - move.rotation_imu_deg) for move in moves if move.rotation_imu_deg is not None
    ]
    if gaps:
        agree = f"largest difference; {sum(move.agrees for move in moves)} of {len(moves)} moves agree"
        yield SummaryItem("encoder against gyro", f"{max(gaps):.2f}°", agree)
    if record.similar:
        yield _symmetry(record.similar)
        similar = [similar_object_words(one) for one in record.similar.objects] or ["no other"]
        yield SummaryItem("looks like", similar[0], "; ".join(similar[1:]))
    if record.result:
        yield SummaryItem("bench time", f"{record.result.seconds:.0f} s")


def _symmetry(similar: SimilarObjects) -> SummaryItem:
    if similar.period_deg is None or similar.neighbour_similarity is None or similar.period_similarity is None:
        return SummaryItem("symmetry", "–", "too few views")
    note = f"similarity {similar.period_similarity:.3f}, of neighbouring views {similar.neighbour_similarity:.3f}"
    words = {0.0: "the same from all sides", 360.0: "none"}
    return SummaryItem("symmetry", words.get(similar.period_deg, f"every {similar.period_deg:g}°"), note)


def _answer_items(answer: Identified) -> Iterator[SummaryItem]:
    yield SummaryItem("answer", outcome_words(answer))
    if answer.confidence is not None:
        yield SummaryItem("confidence", percent_words(answer.confidence))
    yield SummaryItem("score", f"{answer.score:.3f}", f"per view; margin {signed(answer.margin, 3)}")
    yield SummaryItem("views", f"{answer.views}")
    yield SummaryItem("rotation", f"{answer.travelled_deg:.0f}°")
    yield SummaryItem("bench time", f"{answer.seconds:.1f} s")
