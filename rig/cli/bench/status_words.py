"""What `rig status` reports, in words."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from rig.core.next_steps import in_words, steps_from_json
from rig.core.phrases import angle_words, budget_words, filled
from rig.devices.camera import CameraLocks
from rig.doctor.camera import lock_words


def report_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield a report in lines; of a bench that a server uses, without its devices."""
    page, is_open = report.get("page"), "state" in report
    yield f"bench    {report['bench']}{f', served at {page}' if page else '' if is_open else ': not open'}"
    if is_open or page:
        yield f"state    {_state_words(report)}"
    if problem := report.get("error"):
        yield f"error    {problem['code']}: {problem['what']}"
        yield f"         Next step: {problem['next_step']}"
    if limits_deg := report.get("limits_deg"):
        angle_deg = report.get("table_deg")
        angle = "angle in doubt" if angle_deg is None else angle_words(angle_deg, 2)
        yield f"table    {angle}; cable budget {budget_words(tuple(limits_deg))}"
    if page:
        yield f"job      {report.get('job') or 'none'}"
        return
    for device, lines in _LINES.items():
        if values := report.get(device):
            error = values.get("error")
            failed = error and [f"error {error['code']}: {error['what']}", f"Next step: {error['next_step']}"]
            shown = failed or lines(values)
            yield from (f"{'' if n else device:8s} {line}" for n, line in enumerate(shown))
    yield from (f"note     {finding}" for finding in report.get("findings", ()))
    if not report.get("fault") and not report.get("doubt") and (steps := report.get("steps")):
        yield f"         {in_words(steps_from_json(steps))}"


def _state_words(report: Mapping[str, Any]) -> str:
    state, fault, doubt = report.get("state", "not open"), report.get("fault"), report.get("doubt")
    if fault is not None:
        return f"{state} {fault['code']} since {fault['utc']}: {fault['what']} {fault['next_step']}"
    return f"{state}: {doubt} (`rig home --help`)" if doubt else str(state)


def _servo(values: Mapping[str, Any]) -> list[str]:
    model = values["model"].replace("_", "-").upper()
    motion = filled("moving at {:.0f} °/s", values["velocity_dps"]) if values["moving"] else "at rest"
    state = "shaft at {:.1f}°, {}, load {:.0f} %, {:.1f} V, {:.0f} °C, hardware errors: {}"
    keys = ("load_percent", "voltage_v", "temperature_c")
    errors = ", ".join(values["hardware_errors"]) or "none"
    return [
        f"{model}, id {values['bus_id']}, firmware {values['firmware']}",
        filled(state, values["position_deg"], motion, *(values[key] for key in keys), errors),
        f"bus: {_counts(values['bus'])}",
    ]


def _imu(values: Mapping[str, Any]) -> list[str]:
    return [
        filled("{} at address 0x{:02x}, {:.0f} °C", values["model"], values["bus_address"], values["temperature_c"])
    ]


def _head(values: Mapping[str, Any]) -> list[str]:
    state = (
        f"state {values['state']}",
        f"faults: {', '.join(values['faults']) or 'none'}",
        f"emergency stop {'pressed or unplugged' if values['estop_open'] else 'released'}",
        f"servo supply {'on' if values['relay_closed'] else 'off'}",
        f"sensor {values['sensor']}",
    )
    timing = "clock drift {:.1f} ppm, time uncertainty {:.1f} µs"
    counts = dict(values["connection"])
    timed = filled(timing, counts.pop("drift_ppm"), counts.pop("time_uncertainty_us"))
    return [", ".join(state), f"connection: {_counts(counts)}, {timed}"]


def _camera(values: Mapping[str, Any]) -> list[str]:
    device = f" ({values['device']})" if values["device"] else ""
    mode = filled("{}x{} at {:.3g} frames/s", values["width"], values["height"], values["fps"])
    locks = [f"{name} {value}" for name, value in lock_words(CameraLocks(**values["locks"])).items()]
    return [f"{values['name']}{device}, {mode}", *([", ".join(locks)] if locks else [])]


def _counts(counts: Mapping[str, int]) -> str:
    """Return the counts that are not 0: "19 transactions, 2 timeouts"."""
    found = [f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count]
    return ", ".join(found) or "no traffic yet"


_LINES: Final[dict[str, Callable[[Mapping[str, Any]], list[str]]]] = {
    "servo": _servo,
    "imu": _imu,
    "head": _head,
    "camera": _camera,
}
