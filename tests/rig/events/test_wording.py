"""Codes of events in words. Other tests assert the codes."""

from dataclasses import replace

import pytest

from hbr import Outcome, StopDecision, StopReason
from hbr.model.symmetry import SimilarObject
from rig.core.errors import NoObject
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.events.events import (
    Candidate,
    Decided,
    Event,
    Failed,
    FrameUsed,
    Identified,
    Moved,
    Note,
    NoteCode,
    ObjectChanged,
    Ranked,
    RotationReason,
    ScanStarted,
    SimilarObjects,
    Unwinding,
    Verified,
    Waiting,
    WaitReason,
    Warned,
    Weighed,
)
from rig.events.wording import (
    answer_words,
    decision_words,
    line,
    move_words,
    note_steps,
    note_words,
    outcome_words,
    reason_words,
    share_words,
    similar_object_words,
    verification_words,
)
from rig.motion.scan_speed import SpeedLimit
from tests.rig.report.report_samples import NAMES, NOTE, identified


def decided(side: str, rotation_deg: float, s_left: float, s_right: float, *names: str) -> Decided:
    reason = RotationReason.LESS_SIMILAR_SIDE if len(names) > 1 else RotationReason.ONE_CANDIDATE
    return Decided(1, side, rotation_deg, -rotation_deg, s_left, s_right, names, reason)


def test_decisions_give_the_rotation_and_its_reason() -> None:
    first = Decided(0, "left", 90.0, -90.0, None, None, (), RotationReason.FIRST_STEP)
    assert decision_words(first) == "left 90.0°: the first rotation is fixed."
    assert decision_words(decided("left", 47.3, 0.41, 0.66, "a", "b")) == (
        "left 47.3°: the two leading candidates look less similar there: S_left 0.41 < S_right 0.66."
    )
    assert decision_words(decided("right", -137.3, 0.66, 0.41, "a", "b", "c")) == (
        "right 137.3°, past earlier views: the leading candidates look less similar there: S_right 0.41 < S_left 0.66."
    )
    tie = decided("left", 90.0, 0.5, 0.5, "a", "b")
    assert "equally similar on both sides: S_left 0.50 = S_right 0.50" in decision_words(tie)
    custom = replace(first, reason=RotationReason.CUSTOM, note="the far side")
    assert decision_words(custom) == "left 90.0°: the far side."


def test_dense_decisions_name_the_two_candidates() -> None:
    weighed = Weighed((-90.0, 90.0), (-8.0, -9.0), (0.1, 0.1), (0.95, 0.5))
    reason = RotationReason.SEPARATES_CANDIDATES
    found = Decided(0, "left", 90.0, -90.0, None, None, ("a", "b"), reason, weighed=weighed)
    assert decision_words(found) == "left 90.0°: distinguishes a from b, similarity 0.50 there (0.50–0.95 all around)."
    alone = replace(found, candidates=(), reason=RotationReason.NEW_SIDE)
    assert decision_words(alone) == "left 90.0°: no other enrolled object is likely, so a new side is viewed."


def test_answers_begin_with_the_result() -> None:
    known, unknown = identified("mug-white").answer, identified(None).answer
    assert isinstance(known, Identified)
    assert isinstance(unknown, Identified)
    assert answer_words(known) == "mug-white, rotated 30° (4 views). The margin 0.100 per view reaches 0.05."
    sure = replace(known, yaw_set_deg=(359.7,), yaw_sigma_deg=1.6, confidence=0.996, views=1)
    assert answer_words(sure).startswith("mug-white, rotated 0° ± 2°, 99 % confident (1 view). ")
    folded = replace(sure, yaw_deg=None, yaw_set_deg=(20.0, 110.0, 200.0, 290.0), period_deg=90.0)
    assert "rotated 20° ± 2° or one of 4 equivalent poses (every 90°), 99 % confident" in answer_words(folded)
    free = replace(sure, yaw_deg=None, yaw_set_deg=(), yaw_sigma_deg=None, period_deg=0.0)
    assert answer_words(free).startswith("mug-white (looks the same from all sides), 99 % confident (1 view). ")
    assert "mug-white, rotation not determined, 99 %" in answer_words(replace(free, period_deg=None))
    assert ">99.9 % confident" in answer_words(replace(known, confidence=0.9999))
    doubtful = replace(known, outcome=Outcome.AMBIGUOUS, possible=NAMES[:2])
    assert answer_words(doubtful).startswith("Ambiguous: mug-white or mug-star (4 views). ")
    assert answer_words(replace(doubtful, possible=tuple("abcdefg"))).startswith(
        "Ambiguous: a, b, c, d, e or 2 more (4"
    )
    assert "mug-white, mug-star or not enrolled (30.0 %)" in answer_words(replace(doubtful, not_enrolled=0.3))
    likely = tuple(replace(one, probability=0.4) for one in doubtful.candidates)
    assert "mug-white (40.0 %) or mug-star (40.0 %)" in answer_words(replace(doubtful, candidates=likely))
    assert outcome_words(doubtful) == "mug-white or mug-star"
    assert outcome_words(replace(doubtful, possible=NAMES)) == "mug-white or 4 others"
    assert (outcome_words(known), outcome_words(unknown)) == ("mug-white", "unknown")
    assert answer_words(unknown).startswith(
        "Unknown object. The most similar enrolled objects are mug-white (score 0.930), mug-star (score 0.830) and "
        "teapot (score 0.730). "
    )


def test_end_of_a_search_has_a_reason() -> None:
    known = identified("mug-white").answer
    assert isinstance(known, Identified)
    assert reason_words(replace(known, reason=StopReason.MAX_VIEWS)) == "the search took all 4 views that are allowed"
    by_probability = replace(known, reason=StopReason.MAX_VIEWS, min_confidence=0.98)  # a hidden Markov model
    assert reason_words(by_probability) == "the search took all 4 views that are allowed"
    assert reason_words(replace(known, reason=StopReason.NO_ROTATION_LEFT)) == "the cable allows no other view"
    assert reason_words(replace(known, reason=StopReason.CUSTOM, note="enough")) == "enough"
    dense = replace(known, confidence=0.6, min_confidence=0.95, not_enrolled=0.3)
    assert reason_words(replace(dense, reason=StopReason.MAX_VIEWS)).startswith("the best candidate after 4 views")
    assert reason_words(replace(dense, reason=StopReason.CONFIDENT)) == "the confidence 60.0 % reaches 95.0 %"
    likely = tuple(replace(one, probability=0.4) for one in dense.candidates)
    doubtful = replace(
        dense, outcome=Outcome.AMBIGUOUS, reason=StopReason.MAX_VIEWS, confidence=None, candidates=likely
    )
    assert reason_words(doubtful).endswith("with a probability of 40.0 % below 95.0 %")


def test_unknown_object_has_the_probability_that_it_is_not_enrolled() -> None:
    unknown = identified(None).answer
    assert isinstance(unknown, Identified)
    assert "Percentages" not in answer_words(unknown)  # the paper's search has none
    likely = tuple(replace(one, probability=0.997) for one in unknown.candidates)
    by_probability = replace(unknown, candidates=likely)  # a hidden Markov model
    assert answer_words(by_probability).endswith("Percentages of candidates are shares among the enrolled objects.")
    ended = replace(by_probability, reason=StopReason.CONFIDENT, score=0.41, min_score=0.6, min_confidence=0.98)
    assert "The score 0.410 of the likeliest object is below 0.600. Percentages" in answer_words(ended)
    assert "confiden" not in answer_words(ended)  # 99.7 % is the share of a wrong object among the enrolled ones
    dense = replace(by_probability, not_enrolled=0.97, reason=StopReason.NOT_ENROLLED)
    assert answer_words(dense).endswith("(score 0.730). Not enrolled with 97.0 %.")
    frame = FrameUsed(3, 30.0, 1.0, 0, "mug-white", 0.997, Outcome.UNKNOWN)
    assert line(replace(frame, probability=0.001)).startswith("  in motion: mug-white 0.1 %, not enrolled; view 4")
    assert "mug-white 99.7 %, enough" in line(replace(frame, outcome=Outcome.FOUND))


def test_verification_is_put_into_words() -> None:
    found = Verified(3, "mug", 0.7, 0.4, 0.3, 0.8, 0.02, Outcome.FOUND, 0.99, 0.005)
    words = (
        "its enrolled views explain 70.0 % of the contrast (of each other 80.0 %), those of the second candidate 40.0 %"
    )
    assert words in verification_words(found)
    assert line(found).endswith("it is mug with 99.0 %, and not enrolled with 0.5 %.")


def test_similar_objects_are_put_into_words() -> None:
    cup = SimilarObject("cup", ((120.0, 200.0), (300.0, 300.0)), ((210.0, 290.0), (310.0, 110.0)), (), 0.2, 0.99)
    mug = SimilarObjects("mug", 180.0, 0.95, 0.96, (cup,))
    same, like = line(mug).splitlines()
    assert same.startswith("  looks the same every 180° (similarity 0.960, of neighbouring views 0.950): its pose is ")
    assert like == "  looks like cup from 120–200° and 300° (similarity up to 0.990)"
    vase = replace(mug, period_deg=0.0, objects=())
    assert line(vase).startswith("  looks the same from all sides")
    assert line(replace(vase, period_deg=None)) == "  looks like no other enrolled object"


NO_OBJECT = NoObject("The table is empty.", next_step="Put the object on it.")
AT_HOME, ALL, MANY = ((359.7, 0.3),), ((0.0, 360.0),), tuple((float(a), a + 10.0) for a in (0, 30, 60, 90))


@pytest.mark.parametrize(
    ("differs", "other_differs", "share", "words"),
    [
        ((), (), 1.0, "cup from all sides"),
        (AT_HOME, (), 0.9, "cup from all sides but 0°"),
        (((350.0, 10.0), (90.0, 90.0)), AT_HOME, 0.9, "cup from all sides but 350–10° and 90°"),
        (MANY, (), 0.9, "cup from most sides"),
        ((), AT_HOME, 1.0, "cup, which looks different at 0°"),
        ((), MANY, 1.0, "cup, which looks different from some sides"),
        (MANY, (), 0.5, "cup from some sides"),
    ],
)
def test_only_objects_without_a_different_side_look_the_same_from_all_sides(
    differs: tuple, other_differs: tuple, share: float, words: str
) -> None:
    arcs = MANY if share == 0.5 else ALL
    assert similar_object_words(SimilarObject("cup", arcs, differs, other_differs, share, 0.99)) == words


def test_move_is_put_into_words() -> None:
    move = Moved(1, -90.0, -90.1, -90.1, -89.99, 0.12, 0.6, True, 1.0)
    assert move_words(move) == "rotation −90.10° (encoder), −89.99 ± 0.12° (gyro)"
    slipped = replace(move, agrees=False, rotation_imu_deg=-80.0)
    assert move_words(slipped).endswith("they differ by more than 0.60°, so the gyro value counts")
    assert move_words(replace(move, rotation_imu_deg=None)).endswith("no gyro value")


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (ScanStarted(90.0, SpeedLimit.SMEAR, 4.0, 0.0, 360.0), "from 0.0° to 360.0°: 4 ms exposure allows 90 °/s"),
        (Unwinding(0, 330.0, -30.0, 1, (-400.0, 400.0)), "from 330.0° back to −30.0° (the cable allows −400° to 400°)"),
        (ObjectChanged(3, 3, 7.5, 3.0), "begins again with view 4 (evidence 7.5, needed 3.0)."),
        (ObjectChanged(3, 2, 7.5, 3.0), "begins again with views from 3 on (evidence"),
        (Waiting(WaitReason.NEXT_OBJECT), "Waiting for the next object; Ctrl+C ends."),
        (
            Warned(3, Note(NoteCode.TABLE_DIFFERS, {"taken_utc": "noon"})),
            "may be on it.\nNext step: Check that the table",
        ),
        (Failed(NO_OBJECT.problem), "Error 606 (no object): The table is empty.\nNext step: Put the object on it."),
    ],
)
def test_each_event_is_a_line(event: Event, words: str) -> None:
    assert words in line(event)


def test_not_enrolled_is_one_more_candidate() -> None:
    candidate = Candidate("mug", 0.9, 0.0, 0.9999)
    assert share_words(candidate) == ">99.9 %"
    assert share_words(replace(candidate, probability=None)) == ""
    decision = StopDecision(Outcome.CONTINUE, StopReason.NOT_CONFIDENT, 0, 0.6, 0.25, 0.98)
    ranked = Ranked(0, (replace(candidate, probability=0.6), Candidate("cup", 0.8, 0.0, 0.15)), 0.1, decision)
    assert "mug 0.900 (60.0 %) at 0.0°, cup 0.800 (15.0 %) at 0.0°, not enrolled (25.0 %) (margin" in line(ranked)
    assert "not enrolled" not in line(replace(ranked, decision=None))


@pytest.mark.parametrize(
    ("code", "values", "words"),
    [
        (NoteCode.MIXED_EMPTY_TABLE, {"objects": ["a"], "with_image": False}, "a was enrolled without an empty-table"),
        (NoteCode.MIXED_EMPTY_TABLE, {"objects": list("abcde"), "with_image": True}, "a, b, c and 2 more were"),
        (NoteCode.EMPTY_TABLE_DOUBTED, {"problems": [{"code": "old", "hours": 72}]}, "(it is 3 days old)"),
        (NoteCode.EMPTY_TABLE_CHANGED, {"problem": {"code": "missing"}}, "image: there is no"),
    ],
)
def test_note_is_put_into_words(code: NoteCode, values: dict[str, object], words: str) -> None:
    assert words in note_words(Note(code, values))


def test_warnings_have_a_next_step() -> None:
    assert note_words(NOTE).startswith("most objects were enrolled without an empty-table image")
    for code in (NoteCode.EMPTY_TABLE_CHANGED, NoteCode.TABLE_DIFFERS):
        assert note_steps(Note(code))[-1] == Do.EMPTY_TABLE()
    for steps in (("Wait.",), (Do.FREE_DISK(), Do.ENROLL(name="cup"))):
        assert note_steps(Note(NoteCode.NOT_RECORDED, {"steps": plain(steps)})) == steps
