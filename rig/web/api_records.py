"""The REST API: runs, calibrations, configuration and log."""

import re
from typing import Annotated, Any, Final

from fastapi import Query, Response
from fastapi.responses import HTMLResponse, JSONResponse
from pydantic import Field

from rig.calibrations import CalibrationStore
from rig.catalog.exchange.tables import plain_row
from rig.catalog.log import shown
from rig.catalog.records import Outcome
from rig.catalog.results import ResultFilter, correct, find_result, find_results
from rig.core.errors import JobNotFound
from rig.core.json_form import plain
from rig.core.masking import masked
from rig.events.events import event_dict
from rig.search.replay import Check, check
from rig.search.saved_run import SavedRun, load_run
from rig.web.event_schema import SavedRunBody
from rig.web.server import CorrectionBody, OperatorPerson, Page, Routes, Server, long_work, time_text
from rig.web.work import calibrations

RUN_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def add_records(routes: Routes, server: Server) -> None:
    def load(name: str) -> SavedRun:
        if not RUN_NAME.fullmatch(name) or not (server.runs / name / "run.json").is_file():
            raise JobNotFound("There is no run with that name.", next_step="Choose one of GET /api/v1/runs.")
        return load_run(server.runs / name)

    @routes.watch.get("/runs", tags=["runs"])
    def runs(page: Page) -> Response:
        """List the saved runs, the newest first."""
        names = [path.parent.name for path in server.runs.glob("*/run.json") if RUN_NAME.fullmatch(path.parent.name)]
        return page.of([{"name": name} for name in sorted(names, reverse=True)], "name")

    @routes.watch.get("/runs/{name}", tags=["runs"], responses={200: {"model": SavedRunBody}})
    def run(name: str) -> Response:
        """Return the events of a saved run."""
        from rig.events.lines import page_line

        saved = load(name)
        with saved.damage():
            events = [{**event_dict(event), "text": page_line(event)} for event in saved.events()]
        about = {"started_utc": saved.about["started_utc"], "bench": saved.about["bench"]}
        return JSONResponse({"name": name, **about, "events": events})

    @routes.watch.get("/runs/{name}/report", tags=["runs"], response_class=HTMLResponse)
    async def report(name: str) -> HTMLResponse:
        """Return the report of a saved run as a page."""
        from rig.report.page import run_report

        return HTMLResponse(await long_work(lambda: run_report(load(name))))

    @routes.watch.post("/runs/{name}/check", tags=["runs"])
    async def check_run(name: str) -> dict[str, Any]:
        """Compute every decision of a saved run again from its images."""

        def checked() -> Check:
            saved = load(name)
            with saved.damage():
                return check(saved)

        found = await long_work(checked)
        return {**plain(found), "differences": [str(difference) for difference in found.differences]}

    @routes.watch.get("/results", tags=["results"])
    def results(
        page: Page,
        sample: Annotated[str | None, Query(max_length=100)] = None,
        object_name: Annotated[str | None, Query(alias="object", max_length=100)] = None,
        outcome: Outcome | None = None,
    ) -> Response:
        """List the recorded answers, the newest first. Filters use the corrected values."""
        with server.catalog.open_to_read() as catalog:
            found = find_results(catalog, ResultFilter(sample, object_name, outcome))
        rows = [{**plain_row(one.as_row()), "id": str(one.id)} for one in found]
        return page.of(rows[::-1], "id")

    @routes.operate.post("/results/{result_id}/correct", tags=["results"])
    def correct_result(
        body: CorrectionBody, person: OperatorPerson, result_id: Annotated[int, Field(ge=1, lt=2**62)]
    ) -> dict[str, Any]:
        """Correct the object or the sample of an answer, with the reason. The answer itself stays."""
        with server.catalog.open_to_change() as catalog:
            correct(
                catalog,
                result_id,
                reason=body.reason,
                object_name=body.object,
                unknown=body.unknown,
                sample=body.sample,
                operator=person.name,
            )
            return plain_row(find_result(catalog, result_id).as_row())

    @routes.watch.get("/calibrations", tags=["bench"])
    def calibration_list() -> dict[str, Any]:
        """Return the calibrations in force, and those that a job can run."""
        store = CalibrationStore(server.config.calibration_path(server.bench))
        history = [
            {
                "name": one.name,
                "when_utc": time_text(one.when_utc),
                "passed": one.passed,
                "id": one.id,
                "values": {key: str(value) for key, value in one.estimates.items()},
            }
            for one in store.history()
        ]
        offered = {name: one.title for name, one in calibrations().items()}
        return {"history": history[::-1], "available": offered, "unreadable": [str(one) for one in store.unreadable]}

    @routes.watch.get("/configuration", tags=["bench"])
    def configuration() -> dict[str, Any]:
        """Return the configuration in force, without passwords."""
        values: dict[str, Any] = masked(server.config.model_dump(mode="json"))
        return values

    @routes.watch.get("/log", tags=["bench"])
    def log(page: Page) -> Response:
        """List the catalog's log, the newest first."""
        with server.catalog.open_to_read() as catalog:
            entries = catalog.log()
        rows = [{**shown(entry), "id": str(entry.id), "time_utc": time_text(entry.time_utc)} for entry in entries]
        return page.of(rows[::-1], "id")
