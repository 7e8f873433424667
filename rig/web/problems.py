"""Errors as answers of the server: RFC 9457 problem details, with the status of HTTP."""

from collections.abc import Mapping
from typing import Final

from fastapi.responses import JSONResponse

from rig.core import errors
from rig.core.errors import RigError
from rig.core.json_form import plain

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
_BY_HUNDRED: Final = {1: 500, 2: 422, 3: 503, 4: 503, 5: 409, 6: 422, 7: 409, 8: 404, 9: 409}
"""Of the other errors, by the hundreds of their codes."""


class ProblemResponse(JSONResponse):
    """An answer that is an error; ``status`` is for one that HTTP itself finds."""

    media_type = "application/problem+json"

    def __init__(self, error: RigError, status: int | None = None, headers: Mapping[str, str] | None = None) -> None:
        usual = _STATUS.get(error.code) or _BY_HUNDRED[error.code // 100]
        super().__init__(plain(error.problem), status or usual, headers)
