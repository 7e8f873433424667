"""All calibrations of a bench on one self-contained page, each with its plot."""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from calibration import (
    backlash,
    camera_light,
    camera_model,
    encoder,
    gyro_noise,
    gyro_rotation,
    gyro_scale,
    imu_mounting,
    motion_model,
    repeatability,
    table_axis,
)
from rig.calibrations import CalibrationResult, Standing, State
from rig.charts.xy import Chart
from rig.core.errors import UsageError
from rig.core.files import write

PLOTS: Mapping[str, Callable[[CalibrationResult], Chart | None]] = {
    **{
        module.NAME: module.plot
        for module in (
            backlash,
            encoder,
            motion_model,
            gyro_scale,
            imu_mounting,
            gyro_noise,
            gyro_rotation,
            camera_model,
            table_axis,
            repeatability,
        )
    },
    **dict.fromkeys(
        (camera_light.SHARPNESS, camera_light.NOISE, camera_light.FLAT_FIELD, camera_light.DRIFT), camera_light.plot
    ),
}

FURTHER: Mapping[str, Sequence[Callable[[CalibrationResult], Chart | None]]] = {
    camera_model.NAME: (camera_model.plot_views, camera_model.plot_residuals),
    table_axis.NAME: (table_axis.plot_views,),
}


class _Shown(NamedTuple):
    fact: CalibrationResult
    good: bool
    state: str
    words: str
    command: str
    refusals: Sequence[str]
    pictures: Sequence[Markup]
    devices: Sequence[tuple[str, str]]


def plots(fact: CalibrationResult) -> list[Chart]:
    """Return the plots of a fact, the main one first; none where its kind has none, or nothing could be estimated."""
    draw = [*([PLOTS[fact.name]] if fact.name in PLOTS else []), *FURTHER.get(fact.name, ())]
    return [figure for figure in (one(fact) for one in draw) if figure]


def write_page(
    path: Path,
    standings: Sequence[Standing],
    history: Sequence[CalibrationResult],
    *,
    bench: str,
    now_utc: datetime,
    findings: Sequence[str] = (),
) -> None:
    """Write the page: how the bench stands with each calibration, and what came of those that were refused since.

    Parameters
    ----------
    path
        Where to.
    standings
        See `rig.calibrations.CalibrationStore.standings`.
    history
        All facts that were kept, oldest first.
    bench, now_utc
        For the title.
    findings
        What else a person should know.

    Raises
    ------
    UsageError
        The file cannot be written.
    """
    shown = [_shown(standing, history) for standing in standings]
    count = {state: sum(standing.state is state for standing in standings) for state in State}
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("calibration", "."), PackageLoader("rig.report", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    page = environment.get_template("report.html.j2").render(
        bench=bench,
        when=f"{now_utc:%Y-%m-%d %H:%M}",
        totals=[{"label": str(state), "value": n} for state, n in count.items() if n or state is State.IN_FORCE],
        findings=findings,
        shown=shown,
    )
    try:
        write(path, page.encode())
    except OSError as error:
        raise UsageError(
            f"Cannot write the report {path}.",
            next_step="Give --out a file in an existing folder that you may write to.",
            evidence={"reason": error.strerror or str(error)},
        ) from error


def _shown(standing: Standing, history: Sequence[CalibrationResult]) -> _Shown:
    fact = standing.fact
    latest = [kept for kept in history if kept.name == fact.name][-1]
    refused = (
        [] if latest.passed else [f"Refused on {latest.when_utc:%Y-%m-%d %H:%M} UTC: {r}" for r in latest.refusals]
    )
    return _Shown(
        fact,
        standing.state is State.IN_FORCE,
        str(standing.state),
        standing.words,
        standing.command,
        refused,
        # Markup of our own making: its words are escaped where it is made.
        [Markup(figure.svg(themed=True)) for figure in plots(fact)],
        [(part, _words(identity)) for part, identity in fact.device.items() if part in ("servo", "imu", "camera")],
    )


def _words(identity: Any) -> str:
    return ", ".join(f"{key} {value}" for key, value in identity.items() if value not in (None, ""))
