"""The web application: the REST API of version 1, its events, the pages, and the numbers for Prometheus."""

from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from rig.core.errors import Problem, RigError, UsageError
from rig.web.api_bench import add_access, add_bench, add_jobs, add_shelf
from rig.web.api_catalog import add_bundles, add_objects, add_results
from rig.web.api_pictures import add_pictures
from rig.web.api_records import add_records
from rig.web.pages import add_reference, pages
from rig.web.problems import ProblemResponse
from rig.web.requests import JobState
from rig.web.server import API, Routes, Server, Watcher

# With `model`, FastAPI would document errors with the media type of the answer: a JPEG, for a picture.
_PROBLEM: Final = {ProblemResponse.media_type: {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}}
_ERRORS: Final[dict[int | str, dict[str, Any]]] = {
    "4XX": {
        "description": "The request cannot be carried out; `code` and `next_step` say why",
        "content": _PROBLEM,
    },
    "5XX": {"description": "The bench or the catalog is not available", "content": _PROBLEM},
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
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.server = server
    routes = Routes()
    for add in (
        add_access,
        add_bench,
        add_jobs,
        add_shelf,
        add_objects,
        add_results,
        add_bundles,
        add_pictures,
        add_records,
    ):
        add(routes, server)
    # One router for each right, so that no route can forget to ask for it.
    for router in vars(routes).values():
        app.include_router(router, prefix=API, responses=_ERRORS)
    others = server.setup.config.serve
    app.include_router(pages(server.setup.bench, with_others=bool(others.benches) or others.find))
    add_reference(app)
    app.mount("/static", StaticFiles(packages=[("rig.web", "static"), ("rig.charts", "static")]), name="static")

    @app.get("/metrics", include_in_schema=False)
    def metrics(_person: Watcher) -> Response:
        text = "".join(f"{line}\n" for line in _numbers(server))
        return Response(text, media_type="text/plain; version=0.0.4")

    # Every error has the same body: code, evidence and next step.
    @app.exception_handler(RigError)
    async def rig_error(_request: Request, error: RigError) -> Response:
        return ProblemResponse(error)

    @app.exception_handler(RequestValidationError)
    async def not_valid(_request: Request, error: RequestValidationError) -> Response:
        mistakes = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
        what, step = "The request is not valid.", "Correct these values."
        return ProblemResponse(UsageError(what, next_step=step, evidence={"mistakes": mistakes}), 422)

    @app.exception_handler(HTTPException)
    async def http_error(_request: Request, error: HTTPException) -> Response:
        found = UsageError(str(error.detail), next_step=f"See {API}/openapi.json.")
        return ProblemResponse(found, error.status_code, error.headers)

    return app


def _numbers(server: Server) -> Iterator[str]:
    """Yield the numbers of the server as lines of the text format of Prometheus; what is not known is left out."""
    status, numbers = server.status, server.bench.call("numbers")
    servo = status.get("servo") or {}
    for name, kind, values in (
        ("bench_open", "gauge", {"": bool(status.get("open"))}),
        ("fault_latched", "gauge", {"": bool(status.get("fault"))}),
        ("table_degrees", "gauge", {"": status.get("table_deg")}),
        ("servo_temperature_celsius", "gauge", {"": servo.get("temperature_c")}),
        ("servo_volts", "gauge", {"": servo.get("voltage_v")}),
        ("event_listeners", "gauge", {"": server.hub.listeners}),
        ("jobs", "gauge", _by_state(dict.fromkeys(JobState, 0) | numbers["jobs"])),
        ("jobs_ended_total", "counter", _by_state(numbers["jobs_ended"])),
        ("stops_total", "counter", {"": numbers["stops"]}),
    ):
        lines = [f"rig_{name}{label} {float(value)}" for label, value in values.items() if value is not None]
        if lines:
            yield from (f"# TYPE rig_{name} {kind}", *lines)


def _by_state(numbers: Mapping[str, int]) -> dict[str, int]:
    return {f'{{state="{state}"}}': number for state, number in numbers.items()}
