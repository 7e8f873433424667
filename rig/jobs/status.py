"""The job of `rig status`: the state of a bench and of its devices, also if it is served, or some are missing.

The report is JSON values; its lines are for a terminal.
"""

import json
import ssl
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from rig.bench import Bench
from rig.core.errors import BenchBusy, DeviceMismatch, DeviceNotFound, DeviceSilent, RigError
from rig.core.json_form import plain
from rig.core.next_steps import Do, in_words, steps_as_json, steps_from_json
from rig.core.phrases import angle_words, budget_words, filled
from rig.devices.camera import Camera, CameraLocks
from rig.devices.imu import Imu, open_imu
from rig.doctor.camera import lock_words, open_camera
from rig.doctor.context import DoctorContext
from rig.safety.saved_state import ServerAddress, server_address


def bench_report(
    state_path: Path, open_bench: Callable[[], Bench], open_parts: Callable[[], AbstractContextManager[DoctorContext]]
) -> dict[str, Any]:
    """Return the state of a bench, as JSON values; nothing moves.

    ``state_path`` tells whether a server uses it. ``open_bench`` opens it, but none of its devices except the servo;
    ``open_parts`` opens its other devices, if the servo does not work.

    Raises `RigError`: the server does not answer, or the bench cannot be opened for another reason than a missing
    servo.
    """
    if server := server_address(state_path):
        return _report_of_server(server)
    try:
        bench = open_bench()
    except (DeviceNotFound, DeviceMismatch, DeviceSilent) as missing:
        with open_parts() as context:
            return _report_without_servo(context, missing)
    with bench:
        return _report_of(bench)


def _report_of(bench: Bench) -> dict[str, Any]:
    state, safety = bench.servo.read_state(), bench.safety
    report: dict[str, Any] = {
        "bench": bench.name,
        "state": str(safety.state),
        "fault": safety.fault.as_dict() if safety.fault else None,
        "doubt": str(safety.doubt) if safety.doubt else None,
        "table_deg": None if safety.doubt else safety.angle_reference.to_table(state.position_deg),
        "limits_deg": list(bench.config.table.limits_deg),
        "servo": {**plain(bench.servo.identity), **plain(state), "bus": dict(bench.servo.bus_statistics)},
        "imu": _read(lambda: _imu_values(bench.imu)),
        **({"head": bench.head.report()} if bench.head else {}),
        "camera": _read(lambda: _camera_values(bench.camera)),
    }
    steps = steps_as_json(safety.next_step or bench.calibration_steps)
    return {**report, "findings": list(bench.findings), "steps": steps}  # opening the camera adds some findings


def _report_without_servo(context: DoctorContext, missing: RigError) -> dict[str, Any]:
    config, computer = context.config, context.computer

    def imu() -> dict[str, Any]:
        with closing(open_imu(config.imu, computer.i2c_path(config.imu.bus), computer.clock)) as sensor:
            return _imu_values(sensor)

    def camera() -> dict[str, Any]:
        with closing(open_camera(context)) as opened:
            return _camera_values(opened)

    return {
        "bench": context.bench,
        "servo": {"error": missing.as_dict()},
        **({"imu": _read(imu)} if config.imu.connection == "i2c" else {}),
        "camera": _read(camera),
    }


def _report_of_server(server: ServerAddress) -> dict[str, Any]:
    place = urlsplit(server.url)
    everywhere = place.hostname in ("0.0.0.0", "::")
    url = f"{place.scheme}://{f'127.0.0.1:{place.port}' if everywhere else place.netloc}/api/v1/status"
    context = ssl.create_default_context(cafile=server.certificate) if server.certificate else None
    if context is not None:
        context.check_hostname = False  # the certificate is the one in the file, with any name
    request = Request(url, headers={"Authorization": f"Bearer {server.token}"})
    try:
        with urlopen(request, timeout=5, context=context) as answer:
            return {**json.load(answer), "page": server.url}
    except (OSError, ValueError) as error:
        raise BenchBusy(
            f"The server at {server.url} uses the bench and does not answer.",
            next_step=("If it hangs,", Do.STOP(), f"Or end process {server.pid}."),
            evidence={"reason": str(error)},
        ) from error


def _imu_values(imu: Imu) -> dict[str, Any]:
    return {**plain(imu.identity), "temperature_c": imu.temperature_c()}


def _camera_values(camera: Camera) -> dict[str, Any]:
    return {**plain(camera.identity), "locks": plain(camera.read_locks())}


def _read(values: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the values of a device; if it does not work, its error."""
    try:
        return values()
    except RigError as error:
        return {"error": error.as_dict()}


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
