"""`rig status`."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.config.wording import unit
from rig.core.next_steps import in_words, steps_from_json
from rig.core.phrases import angle_words, budget_words, in_unit, number
from rig.jobs.status import bench_report

_UNSHOWN: Final = ("_ns", "_number", "who_am_i", "_rthz", "trajectory_deg", "trajectory_dps")
"""Ends of the keys that `rig status` prints with --json only."""


@command
def status(settings: Settings) -> None:
    """Show the state of the bench and its devices, even if some of them are missing. Moves nothing.

    Example: rig status --bench sim --json
    """
    report = bench_report(
        settings.load().state_path(settings.bench_name),
        partial(settings.open_bench, tell=False, devices=()),
        settings.open_parts,
    )
    settings.say("\n".join(_report_lines(report)), report)
    for device in ("servo", "imu", "camera"):  # the exit code is that of the first device that does not work
        if error := report.get(device, {}).get("error"):
            raise typer.Exit(error["code"] // 100)


def _report_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield a report in lines; of a bench that a server uses, without its devices."""
    page, is_open = report.get("page"), "state" in report
    yield f"bench    {report['bench']}{f', served at {page}' if page else '' if is_open else ': not open'}"
    if is_open or page:
        yield f"state    {_state_words(report)}"
    if problem := report.get("error"):
        yield f"error    {problem['code']}: {problem['detail']}"
        yield f"         Next step: {problem['next_step']}"
    if limits_deg := report.get("limits_deg"):
        angle_deg = report.get("table_deg")
        angle = "angle in doubt" if angle_deg is None else angle_words(angle_deg, 2)
        yield f"table    {angle}; cable budget {budget_words(tuple(limits_deg))}"
    if page:
        yield f"job      {report.get('job') or 'none'}"
        return
    # The devices: of one that fails, the error takes the place of its values.
    for device in ("servo", "imu", "head", "camera"):
        if values := report.get(device):
            error = values.get("error")
            failed = error and [f"error {error['code']}: {error['detail']}", f"Next step: {error['next_step']}"]
            yield from (f"{'' if n else device:8s} {line}" for n, line in enumerate(failed or _device_lines(values)))
    yield from (f"note     {finding}" for finding in report.get("findings", ()))
    if not report.get("fault") and not report.get("doubt") and (steps := report.get("steps")):
        yield f"         {in_words(steps_from_json(steps))}"


def _state_words(report: Mapping[str, Any]) -> str:
    state, fault, doubt = report.get("state", "not open"), report.get("fault"), report.get("doubt")
    if fault is not None:
        return f"{state} {fault['code']} since {fault['utc']}: {fault['detail']} {fault['next_step']}"
    return f"{state}: {doubt} (`rig home --help`)" if doubt else str(state)


def _device_lines(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield the values of a device, and in further lines those of its parts: "load 3 %, voltage 12 V"."""
    parts = {name: part for name, part in values.items() if isinstance(part, dict)}
    for name, part in ({"": {key: value for key, value in values.items() if key not in parts}} | parts).items():
        shown = []
        for key, value in part.items():
            if (
                key.endswith(_UNSHOWN)
                or value is None
                or value is False
                or (value == 0 and name in ("bus", "connection"))
            ):
                continue
            of, suffix = unit(key), f"_{key.rpartition('_')[2]}"
            words = key.removesuffix(suffix if of else "").replace("_", " ")
            if isinstance(value, list):
                words += f" {', '.join(map(str, value)) or 'none'}"
            elif isinstance(value, float):
                words += f" {in_unit(number(value, '.5g'), of)}"
            elif key.endswith("address"):
                words += f" {value:#04x}"
            elif value is not True:
                words += f" {in_unit(str(value), of)}"
            shown.append(words)
        yield f"{name}: {', '.join(shown) or 'none yet'}" if name else ", ".join(shown)
