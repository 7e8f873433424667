"""Write all calibrations of a bench to one self-contained page, each with its plots."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup

from calibration.outcome import plain_value, residual_words
from calibration.procedures import PROCEDURES
from rig.calibrations import BenchCalibration, CalibrationResult, CalibrationStatus
from rig.charts.xy import Chart
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do
from rig.core.phrases import filled, in_unit, number, percent
from rig.core.templates import environment

PLOTS = {procedure.result_name: procedure.plots for procedure in PROCEDURES}


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
    count = {status: sum(calibration.status is status for calibration in calibrations) for status in CalibrationStatus}
    page = (
        environment("calibration", "rig.report", "rig.charts")
        .get_template("report.html.j2")
        .render(
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
            shown=[(calibration, calibration.status is CalibrationStatus.IN_FORCE) for calibration in calibrations],
            # newer attempts count in the rejections, too
            latest={result.name: result for result in history},
            # trusted markup: the SVG escapes its texts
            pictures={one.result.name: [Markup(figure.svg()) for figure in plots(one.result)] for one in calibrations},
            device_words=_device_words,
            in_unit=in_unit,
            number=number,
            percent=percent,
            plain_value=plain_value,
            residual_words=residual_words,
        )
    )
    step = ("Give a file in an existing folder that you may write to.", Do.RUN_AGAIN(out="FILE"))
    with os_errors_as(UsageError, f"Cannot write the report {path}.", next_step=step):
        write(path, page.encode())


def _device_words(identity: Mapping[str, Any]) -> str:
    """Return what a device is: "xl430_w250, id 1, firmware 46"."""
    known = {key: value for key, value in identity.items() if value not in (None, "") and key not in _HIDDEN}
    forms = {key: _FORMS.get(key, f"{key.replace('_', ' ')} {{}}") for key in known}
    return ", ".join(filled(forms[key], value) for key, value in known.items())
