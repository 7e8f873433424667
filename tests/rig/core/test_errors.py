"""The registry of errors: codes are distinct, and each one gives a documented exit code."""

from rig.core import errors
from rig.core.json_form import plain


def test_codes_are_distinct_and_give_exit_codes():
    kinds = errors.error_kinds()
    assert len({kind.code for kind in kinds}) == len(kinds)
    assert {kind.code // 100 for kind in kinds} <= {1, 2, 3, 4, 5, 6, 7, 9}


def test_error_has_text_evidence_and_next_step():
    error = errors.DeviceSilent("Servo 1 does not answer.", next_step="Check the cable.", evidence={"baud": 57600})
    assert error.exit_code == 4
    assert plain(error.problem) == {
        "type": "/reference/errors.html#402",
        "title": "device silent",
        "code": 402,
        "detail": "Servo 1 does not answer.",
        "evidence": {"baud": 57600},
        "next_step": "Check the cable.",
        "steps": ["Check the cable."],
    }
