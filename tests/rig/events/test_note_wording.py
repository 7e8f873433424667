"""Codes of notes and limitations in words. Other tests assert the codes."""

import pytest

from hbr.dense.stopping import Limitation, LimitationCode
from rig.core.next_steps import Do, steps_as_json
from rig.events.events import Note, NoteCode, WaitReason
from rig.events.wording import limitation_words, note_steps, note_words, wait_words
from tests.rig.report.report_samples import NOTE


@pytest.mark.parametrize(
    ("code", "values", "words"),
    [
        (NoteCode.MIXED_EMPTY_TABLE, {"objects": ["a"], "with_image": False}, "a was enrolled without an empty-table"),
        (NoteCode.MIXED_EMPTY_TABLE, {"objects": list("abcde"), "with_image": True}, "a, b, c and 2 more were"),
        (NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE, {}, "most objects were enrolled without"),
        (NoteCode.EMPTY_TABLE_DOUBTED, {"problems": [{"code": "old", "hours": 72}]}, "(it is 3 days old)"),
        (NoteCode.EMPTY_TABLE_MISSING, {"problems": [{"code": "missing"}]}, "no empty-table image (there is no"),
        (NoteCode.EMPTY_TABLE_OF_ENROLLMENT, {"problems": [{"code": "missing"}]}, "enrollment is used (there is no"),
        (NoteCode.EMPTY_TABLE_CHANGED, {"problem": {"code": "missing"}}, "image: there is no"),
        (NoteCode.TABLE_DIFFERS, {"taken_utc": "2026-01-02"}, "does not look as it did at 2026-01-02"),
        (NoteCode.STOPPING_RULE_UNREADABLE, {"reason": "no JSON"}, "(no JSON)"),
        (NoteCode.STOPPING_RULE_OUTDATED, {"made": "2026-01-02", "added": 1, "removed": 2}, "1 object added, 2 obj"),
        (NoteCode.STOPPING_RULE_OUTDATED, {"made": "2026-01-02", "added": 0, "removed": 0}, "(other views, or"),
        (NoteCode.NOT_COMPARED, {"what": "no image"}, "are not compared pixel by pixel: no image"),
    ],
)
def test_note_is_put_into_words(code: NoteCode, values: dict[str, object], words: str) -> None:
    assert words in note_words(Note(code, values))


def test_warnings_have_a_next_step() -> None:
    assert note_words(NOTE).startswith(
        "24 leave-one-out searches cannot guarantee at most 1.0 % wrong answers and 2.0 %"
    )
    for code in (NoteCode.EMPTY_TABLE_CHANGED, NoteCode.TABLE_DIFFERS):
        assert note_steps(Note(code))[-1] == Do.EMPTY_TABLE()
    for steps in (("Wait.",), (Do.FREE_DISK(), Do.ENROLL(name="cup"))):
        assert note_steps(Note(NoteCode.NOT_RECORDED, {"steps": steps_as_json(steps)})) == steps
    assert wait_words(WaitReason.NEXT_OBJECT) != wait_words(WaitReason.FIRST_OBJECT)


NUMBERS = {"rate": 0.01, "searches": 24, "needed": 100, "min_confidence": 0.98, "wrong": 1, "ended": 20}


@pytest.mark.parametrize(
    ("code", "values", "words"),
    [
        (LimitationCode.SAMPLED, {"searched": 20, "objects": 400}, "only 20 of 400 objects were searched for"),
        (LimitationCode.FALSE_REJECT_RATE, {**NUMBERS, "reached": 0.04}, "1.0 % needs 100 leave-one-out searches, and"),
        (LimitationCode.ERROR_RATE, NUMBERS, "a confidence of 98 %, at which 1 of 20 were wrong"),
        (LimitationCode.SIMILAR_OBJECTS, NUMBERS, "because enrolled objects are too similar"),
        (
            LimitationCode.FALSE_ACCEPT_RATE,
            {"rate": 0.02, "accepted": 6, "searches": 120},
            "left-out objects were (5.0 %)",
        ),
        (LimitationCode.UNKNOWN_NOT_MEASURED, {}, "fewer than three objects"),
        (LimitationCode.ONE_OBJECT, {}, "with one object there is no other candidate"),
        (LimitationCode.SINGLE_VIEWS, {}, "a single view"),
    ],
)
def test_limitation_is_put_into_words(code: LimitationCode, values: dict[str, object], words: str) -> None:
    assert words in limitation_words(Limitation(code, values))
