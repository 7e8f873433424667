"""The web application: the REST API of version 1, its events, the pages, and the numbers for Prometheus."""

from collections.abc import Iterator
from importlib.metadata import version
from typing import Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.exceptions import HTTPException

from rig.core.errors import RigError
from rig.web.api_access import add_access
from rig.web.api_bench import add_bench, add_jobs
from rig.web.api_catalog import add_catalog
from rig.web.api_records import add_records
from rig.web.pages import pages
from rig.web.problems import MEDIA_TYPE, problem, problem_body, status_of
from rig.web.requests import JobState
from rig.web.server import API, Problem, Routes, Server, Watcher

QUANTILES: Final = (0.5, 0.99, 0.999)
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
    for router in (routes.public, routes.watch, routes.operate):
        app.include_router(router, prefix=API, responses=_ERRORS)
    app.include_router(pages(server))
    app.mount("/static", StaticFiles(packages=[("rig.web", "static"), ("rig.charts", "static")]), name="static")

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


# -- the numbers of the server, in the text format of Prometheus -------------------------------------------------------


class _Numbers(Collector):
    def __init__(self, server: Server) -> None:
        self._server = server

    def collect(self) -> Iterator[Metric]:
        server, status, numbers = self._server, self._server.remote.status, self._server.remote.ask("numbers")
        yield GaugeMetricFamily("rig_bench_open", "Whether the bench is open.", float(bool(status.get("open"))))
        yield GaugeMetricFamily("rig_fault_latched", "Whether a fault is latched.", float(bool(status.get("fault"))))
        if (angle_deg := status.get("table_deg")) is not None:
            yield GaugeMetricFamily("rig_table_degrees", "Angle of the table.", angle_deg)
        if servo := status.get("servo"):
            yield GaugeMetricFamily("rig_servo_temperature_celsius", "Temperature.", servo["temperature_c"])
            yield GaugeMetricFamily("rig_servo_volts", "Supply voltage.", servo["voltage_v"])
        yield GaugeMetricFamily("rig_viewers", "Open live pictures.", server.remote.viewers)
        yield GaugeMetricFamily("rig_event_listeners", "Open streams of events.", server.hub.listeners)
        jobs = server.remote.ask("jobs")
        waiting = GaugeMetricFamily("rig_jobs", "Jobs by state.", labels=["state"])
        for state in JobState:
            waiting.add_metric([state.value], sum(job["state"] == state for job in jobs))
        yield waiting
        ended = CounterMetricFamily("rig_jobs_ended", "Jobs ended since the server started.", labels=["state"])
        for name, number in numbers["jobs_ended"].items():
            ended.add_metric([name], number)
        yield ended
        yield CounterMetricFamily("rig_stops", "Presses of STOP since the server started.", numbers["stops"])
        intervals = sorted(numbers["intervals_s"])
        if intervals:
            polls = GaugeMetricFamily(
                "rig_servo_poll_seconds", "Time between two readings of the servo in motion.", labels=["quantile"]
            )
            for quantile in QUANTILES:
                polls.add_metric([str(quantile)], intervals[min(int(quantile * len(intervals)), len(intervals) - 1)])
            yield polls


def metrics_text(server: Server) -> bytes:
    """Return the numbers of a server."""
    registry = CollectorRegistry()
    registry.register(_Numbers(server))
    return generate_latest(registry)
