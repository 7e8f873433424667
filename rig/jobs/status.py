"""The job of `rig status`: the state of a bench and of its devices, also if it is served, or some are missing."""

import json
import ssl
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from rig.bench import Bench
from rig.core.errors import BenchBusy, DeviceMismatch, DeviceNotFound, DeviceSilent, RigError
from rig.core.json_form import plain
from rig.core.next_steps import Do, as_steps
from rig.devices.camera import Camera
from rig.devices.imu import Imu, open_imu
from rig.devices.servo import ServoState
from rig.doctor.camera import open_camera
from rig.doctor.examination import DoctorContext
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


def bench_facts(bench: Bench, servo: ServoState | None) -> dict[str, Any]:
    """Return what an open bench says about itself; ``servo`` is its last reading, if there is one."""
    safety = bench.safety
    known = None if safety.doubt else servo  # an angle in doubt is not shown as one
    return {
        "bench": bench.name,
        "state": safety.state,
        "fault": safety.fault,
        "doubt": str(safety.doubt) if safety.doubt else None,
        "table_deg": None if known is None else safety.angle_reference.to_table(known.position_deg),
        "limits_deg": bench.config.table.limits_deg,
        "findings": list(bench.findings),
        "steps": as_steps(safety.next_step or bench.calibration_steps),
    }


def _report_of(bench: Bench) -> dict[str, Any]:
    state = bench.servo.read_state()
    devices = {
        "servo": {**plain(bench.servo.identity), **plain(state), "bus": dict(bench.servo.bus_statistics)},
        "imu": _read(lambda: _imu_values(bench.imu)),
        **({"head": bench.head.report()} if bench.head else {}),
        "camera": _read(lambda: _camera_values(bench.camera)),
    }
    # The facts come last, because opening the camera adds some findings.
    return dict(plain({**devices, **bench_facts(bench, state)}))


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
        "servo": {"error": plain(missing.problem)},
        **({"imu": _read(imu)} if config.imu.connection == "i2c" else {}),
        "camera": _read(camera),
    }


def _report_of_server(server: ServerAddress) -> dict[str, Any]:
    place = urlsplit(server.url)
    # An address that stands for all of this computer's cannot be called.
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
        return {"error": plain(error.problem)}
