"""Errors as RFC 9457 problem details."""

from collections.abc import Mapping
from typing import Any, Final, Self

from fastapi.responses import JSONResponse
from pydantic import BaseModel
from pydantic_core import to_jsonable_python

from rig.core import errors
from rig.core.errors import RigError
from rig.core.next_steps import NextSteps, SomeSteps, as_steps, in_words, steps_as_json

# Errors about a request; all others get their status from the hundred of their code.
_STATUS: Final = {
    errors.LoginRequired.code: 401,
    errors.Forbidden.code: 403,
    errors.JobNotFound.code: 404,
    errors.ObjectNotFound.code: 404,
    errors.LeaseHeld.code: 423,
    errors.CatalogBusy.code: 503,
    errors.TooManyListeners.code: 503,
}
ERRORS: Final = "/reference/errors.html"
"""The page of all errors, with an anchor for each code: in the documentation, and of each server without a network."""
_BY_HUNDRED: Final = {1: 500, 2: 422, 3: 503, 4: 503, 5: 409, 6: 422, 7: 409, 8: 404, 9: 409}
"""Of the other errors, by the hundreds of their codes."""


def _status(error: RigError) -> int:
    return _STATUS.get(error.code) or _BY_HUNDRED[error.code // 100]


class Problem(BaseModel):
    """An error (RFC 9457). ``type`` is the address of its description, on the server and in the documentation."""

    type: str
    title: str
    status: int
    detail: str
    code: int | None = None
    next_step: str | None = None
    steps: list[str | dict[str, Any]] = []
    evidence: dict[str, Any] | None = None


def problem(error: RigError) -> dict[str, Any]:
    """Return an error as problem details: ``code``, ``next_step``, ``steps`` and ``evidence`` are extensions."""
    more = {"code": error.code, "evidence": to_jsonable_python(error.evidence, fallback=str)}
    return _problem(f"{ERRORS}#{error.code}", error.title, _status(error), error.what, error.steps) | more


class ProblemResponse(JSONResponse):
    """An answer that is an error."""

    media_type = "application/problem+json"

    @classmethod
    def of(cls, error: RigError) -> Self:
        return cls(problem(error), _status(error))

    @classmethod
    def of_request(
        cls, status: int, what: str, next_step: SomeSteps, headers: Mapping[str, str] | None = None, **more: Any
    ) -> Self:
        """Return the answer to a request that HTTP itself does not allow."""
        values = _problem("about:blank", "request", status, what, as_steps(next_step))
        return cls({**values, **more}, status, headers)


def _problem(kind: str, title: str, status: int, what: str, steps: NextSteps) -> dict[str, Any]:
    values = {"type": kind, "title": title, "status": status, "detail": what}
    return {**values, "next_step": in_words(steps), "steps": steps_as_json(steps)}
