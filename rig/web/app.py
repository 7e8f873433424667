"""The web application: the REST API of version 1, its events, and the pages."""

from importlib.metadata import version
from typing import Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from rig.core.errors import RigError
from rig.web.api_access import add_access
from rig.web.api_bench import add_bench, add_jobs
from rig.web.api_catalog import add_catalog
from rig.web.api_records import add_records
from rig.web.metrics import metrics_text
from rig.web.pages import pages
from rig.web.problems import MEDIA_TYPE, problem, problem_body, status_of
from rig.web.server import API, Problem, Routes, Server, Watcher

_ERRORS: Final[dict[int | str, dict[str, Any]]] = {
    code: {"model": Problem, "description": text}
    for code, text in (
        (400, "Bad request"),
        (401, "Login required"),
        (403, "Forbidden"),
        (404, "Not found"),
        (409, "Conflict"),
        (413, "Too large"),
        (415, "Not JSON"),
        (421, "Wrong host name"),
        (422, "Not valid"),
        (423, "Another operator has the lease"),
        (503, "The bench or the catalog is not available"),
    )
}


def create_app(server: Server) -> FastAPI:
    """Return the application of a server."""
    app = FastAPI(
        title="hbr-rig",
        version=version("hbr-rig"),
        summary="A turntable bench: enroll objects, and identify them.",
        docs_url=None,
        redoc_url=None,
        openapi_url=f"{API}/openapi.json",
    )
    app.state.server = server
    routes = Routes()
    for add in (add_access, add_bench, add_jobs, add_catalog, add_records):
        add(routes, server)
    for router in (routes.anybody, routes.watch, routes.operate):
        app.include_router(router, prefix=API, responses=_ERRORS)
    app.include_router(pages(server))
    app.mount("/static", StaticFiles(packages=[("rig.web", "static")]), name="static")

    @app.get("/metrics", include_in_schema=False)
    def metrics(_person: Watcher) -> Response:
        return Response(metrics_text(server), media_type="text/plain; version=0.0.4")

    @app.exception_handler(RigError)
    async def rig_error(_request: Request, error: RigError) -> JSONResponse:
        return JSONResponse(problem(error), status_of(error), media_type=MEDIA_TYPE)

    @app.exception_handler(RequestValidationError)
    async def not_valid(_request: Request, error: RequestValidationError) -> Response:
        mistakes = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
        body = problem_body(422, "The request is not valid.", "Correct these values.", evidence={"mistakes": mistakes})
        return Response(body, 422, media_type=MEDIA_TYPE)

    @app.exception_handler(HTTPException)
    async def http_error(_request: Request, error: HTTPException) -> Response:
        step = f"See {API}/openapi.json."
        body = problem_body(error.status_code, str(error.detail), step)
        return Response(body, error.status_code, headers=error.headers, media_type=MEDIA_TYPE)

    return app
