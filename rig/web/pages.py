"""The pages, and the buttons and links of next steps on them.

A script fills the pages from the REST API, so that pages and integrators use one interface. A next step without a
button or link is done at a terminal of the bench's computer; the page then shows its command.

Decision: docs/decisions/0024.
"""

from functools import cache
from typing import Any, Final

from fastapi import APIRouter, FastAPI
from fastapi.responses import HTMLResponse
from jinja2 import ChainableUndefined
from markupsafe import Markup
from pydantic import BaseModel

from rig.charts.compass import dial
from rig.core.errors import ERRORS, error_kinds
from rig.core.next_steps import Do
from rig.core.templates import environment
from rig.web.requests import AcknowledgeRequest, DoctorRequest, EmptyTableRequest, ReferenceRequest

PAGES: Final = {
    "": "Bench",
    "enroll": "Enroll",
    "identify": "Identify",
    "catalog": "Objects",
    "runs": "History",
    "calibrations": "Calibrate",
    "log": "Log",
    "settings": "Settings",
}
OTHER_PAGES: Final = {"object": ("Object", "catalog")}
"""Pages that no menu names: their title, and the page of the menu to which they belong."""
JOB_OF_STEP: Final[dict[Do, BaseModel]] = {
    Do.ACKNOWLEDGE: AcknowledgeRequest(),
    Do.ACKNOWLEDGE_IN_PROGRAM: AcknowledgeRequest(),
    Do.DOCTOR: DoctorRequest(),
    Do.EMPTY_TABLE: EmptyTableRequest(),
    Do.HOME_HERE: ReferenceRequest(here=True),
    Do.SET_REVOLUTIONS: ReferenceRequest(),
}
"""Requests of jobs, for buttons. The parameters of the step replace fields of the request."""
PAGE_OF_STEP: Final[dict[Do, str]] = {
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
            "job": JOB_OF_STEP[action].model_dump(mode="json") if action in JOB_OF_STEP else None,
            "page": PAGE_OF_STEP.get(action),
        }
        for action in Do
    }


def pages(bench: str, *, with_others: bool) -> APIRouter:
    """Return the routes of the pages of a bench, and of the overview with others."""
    shown = PAGES | ({"benches": "Benches"} if with_others else {})
    templates = environment("rig.web", folder="templates")
    shared = {"bench": bench, "actions": page_actions(), "dial": Markup(dial())}
    router = APIRouter(include_in_schema=False)

    # A page is the same for all people: what they see and may do comes from the API, which knows their token.
    def page(name: str, title: str, current: str) -> None:
        template = templates.get_template(f"{name or 'bench'}.html.j2")

        @router.get(f"/{name}", response_class=HTMLResponse, name=f"page-{name or 'bench'}")
        def show() -> HTMLResponse:
            content = template.render(pages=shown, current=current, title=title, **shared)
            return HTMLResponse(content, headers={"Cache-Control": "no-cache"})

    for name, title in shown.items():
        page(name, title, name)
    for name, (title, current) in OTHER_PAGES.items():
        page(name, title, current)

    @router.get("/login", response_class=HTMLResponse)
    def login() -> HTMLResponse:
        return HTMLResponse(templates.get_template("login.html.j2").render(shared))

    return router


def add_reference(app: FastAPI) -> None:
    """Add the pages of the API and of the errors, for people who write a program; they need no login and no network.

    Both are made once: the document of the API does not change while the server runs.
    """
    # The document has no value for each optional key, so a missing one is left out here.
    template = environment("rig.web", folder="templates").overlay(undefined=ChainableUndefined)
    show = template.get_template("reference.html.j2").render

    @cache
    def api() -> str:
        return show(title="API", errors=ERRORS, document=app.openapi(), source=app.openapi_url)

    @app.get("/reference/api.html", response_class=HTMLResponse, include_in_schema=False)
    def show_api() -> str:
        return api()

    @app.get(ERRORS, response_class=HTMLResponse, include_in_schema=False)
    def show_errors() -> str:
        return show(title="Errors", errors=ERRORS, kinds=error_kinds())
