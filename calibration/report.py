"""Write all calibrations of a bench to one self-contained page, each with its plots."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from markupsafe import Markup

from calibration.outcome import plain_value, residual_words
from calibration.procedures import PROCEDURES
from rig.calibrations import BenchCalibration, CalibrationResult, CalibrationStatus, Estimate
from rig.charts.xy import Chart
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do
from rig.core.phrases import filled, in_unit, number, percent
from rig.core.templates import environment

PLOTS = {name: procedure.plots for procedure in PROCEDURES for name in procedure.names}


_FORMS: Final = {
    "model": "{}",
    "name": "{}",
    "device": "{}",
    "bus_id": "id {}",
    "bus_address": "address 0x{:02x}",
    "range_dps": "range {:g} °/s",
    "width": "{} pixels wide",
    "height": "{} pixels high",
    "fps": "{:g} frames/s",
}
_HIDDEN: Final = ("model_number", "who_am_i", "gyro_noise_dps_rthz")
"""How the values of a device are written, and values that its model implies."""


class _ShownResult(NamedTuple):
    result: CalibrationResult
    good: bool
    status: str
    text: str
    command: str
    rejections: Sequence[str]
    pictures: Sequence[Markup]
    devices: Sequence[tuple[str, str]]
    residual: str
    settings: Sequence[str]
    budgets: Sequence[tuple[str, Estimate, Sequence[Sequence[str]]]]
    """Name, estimate, and the rows of its uncertainty budget."""


def plots(result: CalibrationResult) -> list[Chart]:
    """Return the plots of a result, the main one first; none if there is nothing to draw."""
    return [figure for figure in (draw(result) for draw in PLOTS.get(result.name, ())) if figure]


def write_page(
    path: Path,
    calibrations: Sequence[BenchCalibration],
    history: Sequence[CalibrationResult],
    *,
    bench: str,
    now_utc: datetime,
    notes: Sequence[str] = (),
) -> None:
    """Write the page: the status of each calibration, and the rejections of newer attempts.

    ``history`` are all stored results, oldest first, and ``notes`` further ones for the reader.

    Raises `UsageError`: the file cannot be written.
    """
    shown = [_shown(calibration, history) for calibration in calibrations]
    count = {status: sum(calibration.status is status for calibration in calibrations) for status in CalibrationStatus}
    template = environment("calibration", "rig.report", "rig.charts").get_template("report.html.j2")
    page = template.render(
        title=f"Calibration of {bench}",
        date=now_utc.astimezone(),
        summary="The errors of the bench itself, with standard uncertainties (1 σ), expanded uncertainties "
        "U (k = 2, about 95 %), and their budgets by JCGM 100:2008. A source of type A is the scatter of the "
        "measurements, one of type B is known otherwise.",
        totals=[
            {"label": str(status), "value": n, "note": ""}
            for status, n in count.items()
            if n or status is CalibrationStatus.IN_FORCE
        ],
        notes=notes,
        shown=shown,
    )
    step = ("Give a file in an existing folder that you may write to.", Do.RUN_AGAIN(out="FILE"))
    with os_errors_as(UsageError, f"Cannot write the report {path}.", next_step=step):
        write(path, page.encode())


def _shown(calibration: BenchCalibration, history: Sequence[CalibrationResult]) -> _ShownResult:
    result = calibration.result
    latest = [stored for stored in history if stored.name == result.name][-1]
    return _ShownResult(
        result,
        calibration.status is CalibrationStatus.IN_FORCE,
        str(calibration.status),
        str(calibration),
        calibration.repetition.command or "",
        [f"Rejected on {latest.when_utc:%Y-%m-%d %H:%M} UTC: {rejection}" for rejection in latest.rejections],
        # Trusted markup: the SVG escapes its texts.
        [Markup(figure.svg()) for figure in plots(result)],
        [(part, _words(identity)) for part, identity in result.device.items() if part in ("servo", "imu", "camera")],
        residual_words(result),
        [f"{key} = {plain_value(value)}" for key, value in result.settings.items()],
        [(name, estimate, _budget(estimate)) for name, estimate in result.estimates.items()],
    )


def _budget(estimate: Estimate) -> list[tuple[str, ...]]:
    """Return the rows of an uncertainty budget: source, type, u, sensitivity, contribution, and its share.

    The contribution is in the unit of the quantity.
    """
    return [
        (
            one.source,
            one.kind,
            in_unit(f"{one.uncertainty:.2g}", one.unit),
            number(one.sensitivity, ".2g"),
            f"{one.part:.2g}",
            percent(estimate.share(one), 0),
        )
        for one in estimate.budget
    ]


def _words(identity: Mapping[str, Any]) -> str:
    """Return what a device is: "xl430_w250, id 1, firmware 46"."""
    known = {key: value for key, value in identity.items() if value not in (None, "") and key not in _HIDDEN}
    forms = {key: _FORMS.get(key, f"{key.replace('_', ' ')} {{}}") for key in known}
    return ", ".join(filled(forms[key], value) for key, value in known.items())
