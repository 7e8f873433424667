"""The REST API: saved runs, calibrations and the configuration."""

import re
from typing import Annotated, Any, Final

from fastapi import Response
from fastapi.responses import HTMLResponse, JSONResponse
from pydantic import AwareDatetime, BaseModel, Field

from rig.bench.bench import set_key
from rig.calibrations import CalibrationStore
from rig.calibrations.result import CalibrationResult, Contribution
from rig.config import RigConfig
from rig.config.toml_file import NONE, toml
from rig.config.values import read_values
from rig.config.wording import key_info
from rig.core.errors import ConfigError, Forbidden, JobNotFound, UsageError
from rig.core.json_form import plain
from rig.core.masking import masked
from rig.core.next_steps import Do
from rig.events.events import DESCRIBED, JsonEvent, event_dict
from rig.search.replay import ReplayCheck, confirm
from rig.search.saved_run import SavedRun, load_run
from rig.web.answers import ListOf
from rig.web.requests import RequestBody
from rig.web.server import Page, Routes, Server, long_work
from rig.web.work import calibrations

CHANGED_BY_PAGES: Final = ("camera", "view", "enroll", "identify", "mark")
"""Sections that a page may change. A wrong value of another one can harm the bench or reach other files."""
NOT_BY_PAGES: Final = ("camera.source",)
RUN_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


class SavedRunBody(BaseModel):
    """The events of a saved run. Each also has ``text``: the event in words, empty if it has none."""

    model_config = DESCRIBED

    name: str
    started_utc: str
    bench: str
    events: list[JsonEvent]


class Quantity(BaseModel):
    """A calibrated quantity with its standard ``uncertainty``, the root of the sum of the squared contributions.

    A contribution of the ``budget`` is the uncertainty of its source times the sensitivity. ``text`` is value and
    standard uncertainty in words, ``expanded`` the expanded uncertainty (k = 2).
    """

    value: float
    unit: str
    uncertainty: float
    text: str
    expanded: str
    budget: list[Contribution]


class CalibrationRow(BaseModel):
    """A calibration that was run, with its worst ``residual`` and the ``limit`` for it.

    ``id`` is the name by which a stored view refers to it. It was compared with the ``reference``. If ``valid_until``
    is null, it is valid until a device changes.
    """

    id: str
    name: str
    when_utc: AwareDatetime
    passed: bool
    residual: float | None
    limit: float | None
    residual_unit: str
    valid_until: AwareDatetime | None
    reference: str
    operator: str
    software: str
    rejections: list[str]
    quantities: dict[str, Quantity]


class Calibrations(BaseModel):
    """The calibrations that were run, the newest first.

    ``available`` are those that a job can run, with their titles; ``unreadable`` says which files cannot be read.
    """

    history: list[CalibrationRow]
    available: dict[str, str]
    unreadable: list[str]


class Setting(BaseModel):
    """A key of the configuration: ``value`` is in force, ``saved`` is that of the file; null if it has none.

    ``editable`` says whether a page may change it. ``choices`` are its values as text if they are few, else empty.
    """

    key: str
    value: Any
    saved: Any
    default: Any
    allowed: str
    choices: list[str]
    unit: str
    description: str
    editable: bool


class Settings(BaseModel):
    """The keys of the configuration, and its ``file``, which pages change."""

    keys: list[Setting]
    file: str | None


class SettingBody(RequestBody):
    """A new value of a key of the configuration; null clears a key that can be without one."""

    value: bool | int | float | str | list[float] | None


def add_records(routes: Routes, server: Server) -> None:
    def load(name: str) -> SavedRun:
        if not RUN_NAME.fullmatch(name) or not (server.setup.runs / name / "run.json").is_file():
            raise JobNotFound("There is no run with that name.", next_step="Choose one of GET /api/v1/runs.")
        return load_run(server.setup.runs / name)

    @routes.watch.get("/runs", tags=["runs"], response_model=ListOf[str])
    def list_runs(page: Page) -> Response:
        """List the names of the saved runs, the newest first."""
        names = sorted((path.parent.name for path in server.setup.runs.glob("*/run.json")), reverse=True)
        return page.of([name for name in names if RUN_NAME.fullmatch(name)], str)

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
    async def check_run(name: str) -> ReplayCheck:
        """Compute every decision of a saved run again from its images; a difference is an error."""
        return await long_work(lambda: confirm(load(name)))

    @routes.watch.get("/calibrations", tags=["bench"])
    def list_calibrations() -> Calibrations:
        """Return the calibrations in force, and those that a job can run."""
        store = CalibrationStore(server.setup.config.calibration_path(server.setup.bench))
        history = [_calibration_row(one) for one in store.history()]
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
    def change_setting(key: Annotated[str, Field(max_length=60)], body: SettingBody) -> list[str]:
        """Write a key into the configuration file; it is in force when the server starts again.

        The answer has the lines of the file that were changed: removed ones with `-`, added ones with `+`.
        """
        file = server.setup.config_file
        if file is None or not _is_for_pages(key):
            raise Forbidden(
                f"A page cannot change {key}.",
                next_step=("At a terminal of the bench's computer:", Do.SET_KEY(key=key, value="VALUE")),
            )
        try:
            return set_key(file, key, NONE if body.value is None else toml(body.value))
        except ConfigError as error:  # of this request, not of the server
            raise UsageError(error.what, next_step=error.steps, evidence=error.evidence) from error


def _calibration_row(one: CalibrationResult) -> CalibrationRow:
    estimates = one.estimates.items()
    quantities = {key: Quantity(text=str(found), **_same(Quantity, found)) for key, found in estimates}
    worded = {"rejections": [str(reason) for reason in one.rejections], "quantities": quantities}
    return CalibrationRow(**_same(CalibrationRow, one) | worded)


def _same(model: type[BaseModel], source: object) -> dict[str, Any]:
    """Return the fields of a model that have the same name in the source."""
    return {name: getattr(source, name) for name in model.model_fields if hasattr(source, name)}


def _is_for_pages(key: str) -> bool:
    """Return whether a page may change a key."""
    return key.partition(".")[0] in CHANGED_BY_PAGES and key not in NOT_BY_PAGES
