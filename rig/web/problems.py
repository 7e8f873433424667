"""Errors as RFC 9457 problem details."""

from collections.abc import Mapping
from typing import Any, Final, Self

from fastapi.responses import JSONResponse
from pydantic_core import to_jsonable_python

from rig.core.errors import (
    BenchBusy,
    CatalogBusy,
    ConfigError,
    Forbidden,
    JobNotFound,
    JobRejected,
    LeaseHeld,
    LoginRequired,
    ObjectExists,
    ObjectNotFound,
    RigError,
    TooManyListeners,
)
from rig.core.next_steps import NextSteps, SomeSteps, as_steps, in_words, steps_as_json

_STATUS: Final[dict[type[RigError], int]] = {
    LoginRequired: 401,
    Forbidden: 403,
    TooManyListeners: 503,
    LeaseHeld: 423,
    JobNotFound: 404,
    JobRejected: 409,
    ObjectNotFound: 404,
    ObjectExists: 409,
    BenchBusy: 409,
    CatalogBusy: 503,
    ConfigError: 503,
}
_BY_HUNDRED: Final = {1: 500, 2: 422, 3: 500, 4: 503, 5: 409, 6: 422, 7: 409, 8: 404, 9: 409}


def status_of(error: RigError) -> int:
    """Return the HTTP status of an error."""
    for kind, status in _STATUS.items():
        if isinstance(error, kind):
            return status
    return _BY_HUNDRED.get(error.code // 100, 500)


def problem(error: RigError) -> dict[str, Any]:
    """Return an error as problem details: ``code``, ``next_step``, ``steps`` and ``evidence`` are extensions."""
    more = {"code": error.code, "evidence": to_jsonable_python(error.evidence, fallback=str)}
    return _problem(f"urn:hbr-rig:error:{error.code}", error.title, status_of(error), error.what, error.steps) | more


class ProblemResponse(JSONResponse):
    """An answer that is an error."""

    media_type = "application/problem+json"

    @classmethod
    def of(cls, error: RigError) -> Self:
        return cls(problem(error), status_of(error))

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
