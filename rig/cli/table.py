"""`rig goto` and `rig status`."""

from typing import Annotated

import typer

from rig.cli.command import Settings, command


@command
def goto(
    settings: Settings,
    angle_deg: Annotated[float, typer.Argument(metavar="ANGLE", help="Table angle in degrees, counter-clockwise.")],
) -> None:
    """Turn the table to an angle and say where encoder and IMU think it is.

    Example: rig goto -90 --bench sim
    """
    from rig.cli.present import line
    from rig.plans.capture import moved
    from rig.plans.events import event_dict
    from rig.turntable import Turntable

    with settings.open_bench() as bench, Turntable(bench) as table:
        event = moved(0, table.goto(angle_deg))
    if settings.json:
        settings.print_json(event_dict(event))
    else:
        print(line(event))


@command
def status(settings: Settings) -> None:
    """Say which devices answer and in what state they are; moves nothing.

    Example: rig status --bench sim --json
    """
    from rig.plans.events import plain

    with settings.open_bench() as bench:
        state = bench.servo.read_state()
        config = bench.config.table
        report = {
            "bench": bench.name,
            "table_deg": config.direction * (state.position_deg - config.zero_deg),
            "limits_deg": list(config.limits_deg),
            "servo": {**plain(bench.servo.identity), **plain(state)},
            "imu": {**plain(bench.imu.identity), "temperature_c": bench.imu.temperature_c()},
            "camera": {**plain(bench.camera.identity), "locks": plain(bench.camera.read_locks())},
            "findings": list(bench.findings),
        }
    if settings.json:
        settings.print_json(report)
        return
    print(f"bench    {report['bench']}")
    print(f"table    {report['table_deg']:.2f}° (limits {config.limits_deg[0]:g}°..{config.limits_deg[1]:g}°)")
    for device in ("servo", "imu", "camera"):
        facts = report[device]
        assert isinstance(facts, dict)
        print(f"{device:8s} " + ", ".join(f"{key} {_short(value)}" for key, value in facts.items() if key != "time_ns"))
    for finding in bench.findings:
        print(f"note     {finding}")


def _short(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return "(" + ", ".join(f"{key} {_short(inner)}" for key, inner in value.items()) + ")"
    return str(value) if value not in ((), []) else "none"
