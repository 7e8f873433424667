"""The pages. A script fills them from the REST API, so that pages and integrators use one interface."""

from typing import TYPE_CHECKING, Final

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from markupsafe import Markup

from rig.charts.compass import dial
from rig.core.templates import environment
from rig.web.next_steps import page_actions

if TYPE_CHECKING:
    from rig.web.server import Server

PAGES: Final = {
    "": "Bench",
    "enroll": "Enroll",
    "identify": "Identify",
    "catalog": "Catalog",
    "calibrations": "Calibrations",
    "runs": "Runs",
    "log": "Log",
    "settings": "Settings",
}


def pages(server: "Server") -> APIRouter:
    """Return the routes of the pages."""
    templates = environment("rig.web", folder="templates")
    shared = {"bench": server.bench, "actions": page_actions(), "dial": Markup(dial())}
    router = APIRouter(include_in_schema=False)

    def page(name: str) -> None:
        template = templates.get_template(f"{name or 'bench'}.html.j2")

        @router.get(f"/{name}", response_class=HTMLResponse, name=f"page-{name or 'bench'}")
        def show(request: Request) -> HTMLResponse:  # noqa: ARG001
            content = template.render(pages=PAGES, current=name, title=PAGES[name], **shared)
            return HTMLResponse(content, headers={"Cache-Control": "no-cache"})

    for name in PAGES:
        page(name)

    @router.get("/login", response_class=HTMLResponse)
    def login() -> HTMLResponse:
        return HTMLResponse(templates.get_template("login.html.j2").render(shared))

    return router
