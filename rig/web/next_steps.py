"""The next step of an error on a page: buttons and links.

An action without either is done at a terminal of the bench's computer; the page then shows its command.
"""

from typing import Any, Final

from pydantic import BaseModel

from rig.core.next_steps import Do
from rig.web.requests import AcknowledgeRequest, DoctorRequest, EmptyTableRequest, ReferenceRequest

JOBS: Final[dict[Do, BaseModel]] = {
    Do.ACKNOWLEDGE: AcknowledgeRequest(),
    Do.ACKNOWLEDGE_IN_PROGRAM: AcknowledgeRequest(),
    Do.DOCTOR: DoctorRequest(),
    Do.EMPTY_TABLE: EmptyTableRequest(),
    Do.HOME_HERE: ReferenceRequest(here=True),
    Do.SET_REVOLUTIONS: ReferenceRequest(),
}
"""Requests of jobs, for buttons. The parameters of the step replace fields of the request."""
PAGES: Final[dict[Do, str]] = {
    Do.STATUS: "/",
    Do.GOTO: "/",
    Do.CALIBRATE: "/calibrations",
    Do.SHOW_CONFIGURATION: "/settings",
    Do.ENROLL: "/enroll",
    Do.ENROLL_AGAIN: "/enroll",
    Do.CONTINUE_ENROLLMENT: "/enroll",
    Do.LIST_OBJECTS: "/catalog",
    Do.LABEL: "/catalog",
    Do.RENAME: "/catalog",
    Do.UNDELETE: "/catalog",
    Do.LIST_RESULTS: "/runs",
}
"""Pages, for links."""
_WORDS: Final[dict[Do, str]] = {
    Do.ACKNOWLEDGE_IN_PROGRAM: Do.ACKNOWLEDGE.words,
    Do.STOP: "press STOP",
}
"""What a page says in other words than a terminal."""


def page_actions() -> dict[str, dict[str, Any]]:
    """Return for each action its ``words``, and the ``job`` of its button or the ``page`` of its link, if any."""
    return {
        str(action): {
            "words": _WORDS.get(action, action.words),
            "job": JOBS[action].model_dump(mode="json") if action in JOBS else None,
            "page": PAGES.get(action),
        }
        for action in Do
    }
