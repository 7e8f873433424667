"""The REST API: saved runs, calibrations and the configuration."""

import re
from typing import Any, Final

from fastapi import Response
from fastapi.responses import HTMLResponse, JSONResponse

from rig.calibrations import CalibrationStore
from rig.core.errors import JobNotFound
from rig.core.json_form import plain
from rig.core.masking import masked
from rig.events.events import event_dict
from rig.search.replay import ReplayCheck, check
from rig.search.saved_run import SavedRun, load_run
from rig.web.answers import ListOf, RunName, SavedRunBody, time_text
from rig.web.server import Page, Routes, Server, long_work
from rig.web.work import calibrations

RUN_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def add_records(routes: Routes, server: Server) -> None:
    def load(name: str) -> SavedRun:
        if not RUN_NAME.fullmatch(name) or not (server.setup.runs / name / "run.json").is_file():
            raise JobNotFound("There is no run with that name.", next_step="Choose one of GET /api/v1/runs.")
        return load_run(server.setup.runs / name)

    @routes.watch.get("/runs", tags=["runs"], response_model=ListOf[RunName])
    def list_runs(page: Page) -> Response:
        """List the saved runs, the newest first."""
        names = sorted((path.parent.name for path in server.setup.runs.glob("*/run.json")), reverse=True)
        return page.of([{"name": name} for name in names if RUN_NAME.fullmatch(name)], "name")

    @routes.watch.get("/runs/{name}", tags=["runs"], responses={200: {"model": SavedRunBody}})
    def get_run(name: str) -> Response:
        """Return the events of a saved run."""
        from rig.events.wording import page_line

        saved = load(name)
        with saved.damage():
            events = [{**event_dict(event), "text": page_line(event)} for event in saved.events()]
        about = {"started_utc": saved.about["started_utc"], "bench": saved.about["bench"]}
        return JSONResponse({"name": name, **about, "events": events})

    @routes.watch.get("/runs/{name}/report", tags=["runs"], response_class=HTMLResponse)
    async def get_run_report(name: str) -> HTMLResponse:
        """Return the report of a saved run as a page."""
        from rig.report.report import run_report

        return HTMLResponse(await long_work(lambda: run_report(load(name))))

    @routes.watch.post("/runs/{name}/check", tags=["runs"])
    async def check_run(name: str) -> dict[str, Any]:
        """Compute every decision of a saved run again from its images."""

        def checked() -> ReplayCheck:
            saved = load(name)
            with saved.damage():
                return check(saved)

        found = await long_work(checked)
        return {**plain(found), "differences": [str(difference) for difference in found.differences]}

    @routes.watch.get("/calibrations", tags=["bench"])
    def list_calibrations() -> dict[str, Any]:
        """Return the calibrations in force, and those that a job can run."""
        store = CalibrationStore(server.setup.config.calibration_path(server.setup.bench))
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
    def get_configuration() -> dict[str, Any]:
        """Return the configuration in force, without passwords."""
        values: dict[str, Any] = masked(server.setup.config.model_dump(mode="json"))
        return values
