"""The REST API: saved runs, calibrations and the configuration."""

import re
from typing import Annotated, Final

from fastapi import Response
from fastapi.responses import HTMLResponse, JSONResponse
from pydantic import Field

from rig.bench.changes import set_key
from rig.calibrations import CalibrationStore, Estimate
from rig.calibrations.result import COVERAGE_FACTOR
from rig.config import RigConfig
from rig.config.toml_file import NONE, toml
from rig.config.values import read_values
from rig.config.wording import key_info
from rig.core.errors import ConfigError, Forbidden, JobNotFound, UsageError
from rig.core.json_form import plain
from rig.core.masking import masked
from rig.core.next_steps import Do
from rig.events.events import event_dict
from rig.search.replay import ReplayCheck, check
from rig.search.saved_run import SavedRun, load_run
from rig.web.answers import (
    BudgetRow,
    CalibrationRow,
    Calibrations,
    ListOf,
    Quantity,
    RunCheck,
    RunName,
    SavedRunBody,
    Setting,
    SettingChange,
    Settings,
)
from rig.web.requests import SettingBody
from rig.web.server import Page, Routes, Server, long_work
from rig.web.work import calibrations

CHANGED_BY_PAGES: Final = ("camera", "view", "enroll", "identify", "mark")
"""Sections that a page may change. A wrong value of another one can harm the bench or reach other files."""
NOT_BY_PAGES: Final = ("camera.source",)
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
        about = {"started_utc": saved.about.started_utc.isoformat(), "bench": saved.about.bench}
        return JSONResponse({"name": name, **about, "events": events})

    @routes.watch.get("/runs/{name}/report", tags=["runs"], response_class=HTMLResponse)
    async def get_run_report(name: str) -> HTMLResponse:
        """Return the report of a saved run as a page."""
        from rig.report.report import run_report

        return HTMLResponse(await long_work(lambda: run_report(load(name))))

    @routes.watch.post("/runs/{name}/check", tags=["runs"])
    async def check_run(name: str) -> RunCheck:
        """Compute every decision of a saved run again from its images."""

        def checked() -> ReplayCheck:
            saved = load(name)
            with saved.damage():
                return check(saved)

        found = await long_work(checked)
        differences = [str(difference) for difference in found.differences]
        return RunCheck(
            views=found.views, decisions=found.decisions, is_complete=found.is_complete, differences=differences
        )

    @routes.watch.get("/calibrations", tags=["bench"])
    def list_calibrations() -> Calibrations:
        """Return the calibrations in force, and those that a job can run."""
        store = CalibrationStore(server.setup.config.calibration_path(server.setup.bench))
        history = [
            CalibrationRow(
                id=one.id,
                name=one.name,
                when_utc=one.when_utc,
                passed=one.passed,
                residual=one.residual,
                limit=one.limit,
                unit=one.residual_unit,
                valid_until=one.valid_until,
                reference=one.reference,
                operator=one.operator,
                software=one.software,
                rejections=[str(reason) for reason in one.rejections],
                quantities={key: _quantity(value) for key, value in one.estimates.items()},
            )
            for one in store.history()
        ]
        offered = {name: one.title for name, one in calibrations().items()}
        unreadable = [str(one) for one in store.unreadable]
        return Calibrations(history=history[::-1], available=offered, unreadable=unreadable)

    # It is not checked as a configuration again: a hidden password is none.
    @routes.watch.get("/configuration", tags=["bench"], responses={200: {"model": RigConfig}})
    def get_configuration() -> Response:
        """Return the configuration in force, without passwords."""
        return JSONResponse(masked(server.setup.config.model_dump(mode="json")))

    @routes.watch.get("/settings", tags=["bench"])
    def list_settings() -> Settings:
        """Return the keys of the configuration: value in force, value in the file, default, range, unit, meaning."""
        config, file = server.setup.config.model_dump(mode="json"), server.setup.config_file
        written = read_values(file).values if file is not None and file.exists() else {}
        keys = [
            Setting(
                key=info.name,
                **masked({"value": info.value(config), "saved": info.value(written), "default": plain(info.default)}),
                allowed=info.allowed,
                choices=[str(one) for one in info.choices],
                unit=info.unit,
                description=info.description,
                editable=file is not None and _is_for_pages(info.name),
            )
            for info in key_info(RigConfig)
            if info.name != "bench"  # options of other benches
        ]
        return Settings(keys=keys, file=None if file is None else str(file))

    @routes.operate.put("/settings/{key}", tags=["bench"])
    def change_setting(key: Annotated[str, Field(max_length=60)], body: SettingBody) -> SettingChange:
        """Write a key into the configuration file; it is in force when the server starts again."""
        file = server.setup.config_file
        if file is None or not _is_for_pages(key):
            raise Forbidden(
                f"A page cannot change {key}.",
                next_step=("At a terminal of the bench's computer:", Do.SET_KEY(key=key, value="VALUE")),
            )
        try:
            return SettingChange(changed=set_key(file, key, NONE if body.value is None else toml(body.value)))
        except ConfigError as error:  # of this request, not of the server
            raise UsageError(error.what, next_step=error.steps, evidence=error.evidence) from error


def _quantity(one: Estimate) -> Quantity:
    return Quantity(
        value=one.value,
        unit=one.unit,
        text=str(one),
        uncertainty=one.uncertainty,
        k=COVERAGE_FACTOR,
        expanded=COVERAGE_FACTOR * one.uncertainty,
        budget=[BudgetRow(**plain(source), contribution=source.part) for source in one.budget],
    )


def _is_for_pages(key: str) -> bool:
    """Return whether a page may change a key."""
    return key.partition(".")[0] in CHANGED_BY_PAGES and key not in NOT_BY_PAGES
