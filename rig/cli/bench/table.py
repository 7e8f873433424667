"""`rig goto`, `rig home` and `rig status`."""

from collections.abc import Callable, Mapping
from contextlib import closing
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from rig.cli.bench.findings import doctor_context
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_DECLINED
from rig.cli.ui.settings import Settings
from rig.core.errors import BenchBusy, DeviceMismatch, DeviceNotFound, DeviceSilent, RigError, UsageError
from rig.core.phrases import angle_words, budget_words

if TYPE_CHECKING:
    from rig.core.errors import RigError
    from rig.safety.saved_state import ServerAddress
    from rig.safety.supervisor import Safety


@command
def goto(
    settings: Settings,
    angle_deg: Annotated[float, typer.Argument(metavar="ANGLE", help="Table angle in degrees, counter-clockwise.")],
) -> None:
    """Rotate the table to an angle, and print the rotation by encoder and IMU.

    Example: rig goto -90 --bench sim
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table import goto as goto_job

    desk = CommandDesk(settings)
    desk.run(goto_job(desk, angle_deg))


@command
def home(
    settings: Settings,
    revolutions: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=-250,
            max=250,
            help="Revolutions by which the cable is wound up; 0 if it hangs free.",
        ),
    ] = None,
    here: Annotated[bool, typer.Option("--here", help="Make the present angle home. Moves nothing.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Rotate more than half a revolution without asking.")
    ] = False,
) -> None:
    """Rotate the table to home (0°). If its revolutions are in doubt, look at the cable and give --revolutions.

    Example: rig home --revolutions 0 --bench sim
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table import home as home_job
    from rig.jobs.table import refer

    if here and revolutions is not None:
        raise UsageError("--here and --revolutions cannot be combined.", next_step="Give one of them.")
    desk = CommandDesk(settings, yes=yes)
    if not desk.run(refer(desk, here=True) if here else home_job(desk, revolutions=revolutions)) and not here:
        raise typer.Exit(EXIT_DECLINED)


@command
def status(settings: Settings) -> None:
    """Show the state of the bench and its devices, even if some of them are missing. Moves nothing.

    Example: rig status --bench sim --json
    """
    from rig.core.json_form import plain
    from rig.safety.bench_lock import server_address

    if server := server_address(settings.load().state_path(settings.bench_name)):
        _served_status(settings, server)
        return
    try:
        bench = settings.open_bench(tell=False, devices=())
    except (DeviceNotFound, DeviceMismatch, DeviceSilent) as missing:
        _status_without_servo(settings, missing)
    with bench:
        state, safety = bench.servo.read_state(), bench.safety
        config = bench.config.table
        table_deg = None if safety.doubt else safety.angle_reference.to_table(state.position_deg)
        report: dict[str, Any] = {
            "bench": bench.name,
            "state": str(safety.state),
            "fault": safety.fault.model_dump() if safety.fault else None,
            "doubt": str(safety.doubt) if safety.doubt else None,
            "table_deg": table_deg,
            "limits_deg": list(config.limits_deg),
            "servo": {**plain(bench.servo.identity), **plain(state), "bus": dict(bench.servo.bus_statistics)},
            "imu": _read(lambda: {**plain(bench.imu.identity), "temperature_c": bench.imu.temperature_c()}),
            **({"head": bench.head.report()} if bench.head else {}),
            "camera": _read(
                lambda: {**plain(bench.camera.identity), "locks": plain(bench.camera.read_locks())},
            ),
        }
        report["findings"] = list(bench.findings)  # opening the camera adds some
    if settings.json:
        settings.print_json(report)
    else:
        print(f"bench    {report['bench']}")
        print(f"state    {_state_text(safety)}")
        print(f"table    {_table_text(table_deg, config.limits_deg)}")
        _print_devices(report)
        for finding in bench.findings:
            print(f"note     {finding}")
    _exit_if_missing(report)


def _read(values: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the values of a device; if it does not work, its error."""
    try:
        return values()
    except RigError as error:
        return {"error": error.as_dict()}


def _status_without_servo(settings: Settings, missing: "RigError") -> NoReturn:
    """Print what works of a bench that cannot be opened, and exit with the error's code."""
    from rig.core.json_form import plain
    from rig.devices.open_imu import open_imu
    from rig.doctor.camera import open_camera

    with doctor_context(settings) as context:
        config, computer = context.config, context.computer

        def imu() -> dict[str, Any]:
            with closing(open_imu(config.imu, computer.i2c_path(config.imu.bus), computer.clock)) as sensor:
                return {**plain(sensor.identity), "temperature_c": sensor.temperature_c()}

        def camera() -> dict[str, Any]:
            with closing(open_camera(context)) as opened:
                return {**plain(opened.identity), "locks": plain(opened.read_locks())}

        report: dict[str, Any] = {"bench": settings.bench_name, "servo": {"error": missing.as_dict()}}
        report |= {"imu": _read(imu)} if config.imu.connection == "i2c" else {}
        report["camera"] = _read(camera)
    if settings.json:
        settings.print_json(report)
    else:
        print(f"bench    {report['bench']}: not open")
        _print_devices(report)
    _exit_if_missing(report)
    raise missing


def _print_devices(report: Mapping[str, Any]) -> None:
    from rig.cli.bench.device_words import device_lines

    for device in ("servo", "imu", "head", "camera"):
        if values := report.get(device, {}):
            for n, line in enumerate(device_lines(device, values)):
                print(f"{'' if n else device:8s} {line}")


def _exit_if_missing(report: Mapping[str, Any]) -> None:
    """Exit with the code of the first device that does not work."""
    for device in ("servo", "imu", "camera"):
        if error := report.get(device, {}).get("error"):
            raise typer.Exit(error["code"] // 100)


def _served_status(settings: Settings, server: "ServerAddress") -> None:
    """Print the state of a bench that `rig serve` uses, as the server reports it."""
    import json
    import ssl
    from urllib.parse import urlsplit
    from urllib.request import Request, urlopen

    place = urlsplit(server.url)
    everywhere = place.hostname in ("0.0.0.0", "::")
    url = f"{place.scheme}://{f'127.0.0.1:{place.port}' if everywhere else place.netloc}/api/v1/status"
    context = ssl.create_default_context(cafile=server.certificate) if server.certificate else None
    if context is not None:
        context.check_hostname = False  # the certificate is the one in the file, with any name
    request = Request(url, headers={"Authorization": f"Bearer {server.token}"})
    try:
        with urlopen(request, timeout=5, context=context) as answer:
            report = json.load(answer)
    except (OSError, ValueError) as error:
        raise BenchBusy(
            f"The server at {server.url} uses the bench and does not answer.",
            next_step=f"If it hangs: `rig stop`, or end process {server.pid}.",
            evidence={"reason": str(error)},
        ) from error
    if settings.json:
        settings.print_json({**report, "page": server.url})
        return
    fault, problem = report.get("fault"), report.get("error")
    print(f"bench    {report['bench']}, served at {server.url}")
    print(f"state    {report.get('state', 'not open')}" + (f" {fault['code']}: {fault['what']}" if fault else ""))
    if problem:
        print(f"error    {problem['code']}: {problem['what']} {problem['next_step']}")
    if limits := report.get("limits_deg"):
        print(f"table    {_table_text(report.get('table_deg'), tuple(limits))}")
    print(f"job      {report.get('job') or 'none'}")


def _table_text(angle_deg: float | None, limits_deg: tuple[float, float]) -> str:
    budget = f"cable budget {budget_words(limits_deg)}"
    return f"angle in doubt; {budget}" if angle_deg is None else f"{angle_words(angle_deg, 2)}; {budget}"


def _state_text(safety: "Safety") -> str:
    if safety.fault is not None:
        fault = safety.fault
        return f"{safety.state} {fault.code} since {fault.utc}: {fault.what} {fault.next_step}"
    return f"{safety.state}: {safety.doubt} (`rig home --help`)" if safety.doubt else str(safety.state)
