"""Errors as RFC 9457 problem details."""

import json
from typing import Any, Final

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
from rig.core.next_steps import SomeSteps, as_steps, in_words, steps_as_json

MEDIA_TYPE: Final = "application/problem+json"

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
    values = error.as_dict()
    return {
        "type": f"urn:hbr-rig:error:{error.code}",
        "title": error.title,
        "status": status_of(error),
        "detail": error.what,
        "code": error.code,
        "next_step": error.next_step,
        "steps": values["steps"],
        "evidence": json.loads(json.dumps(values["evidence"], default=str)),
    }


def problem_body(status: int, what: str, next_step: SomeSteps, **more: Any) -> bytes:
    """Return the JSON text of a problem that is not one of our errors."""
    steps = as_steps(next_step)
    values = {"type": "about:blank", "title": "request", "status": status, "detail": what}
    values |= {"next_step": in_words(steps), "steps": steps_as_json(steps)}
    return json.dumps({**values, **more}, ensure_ascii=False).encode()
