"""`rig goto`, `rig home` and `rig status`."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.motion.turntable import Turntable
    from rig.safety.supervisor import Safety


@command
def goto(
    settings: Settings,
    angle_deg: Annotated[float, typer.Argument(metavar="ANGLE", help="Table angle in degrees, counter-clockwise.")],
) -> None:
    """Turn the table to an angle and say where encoder and IMU think it is.

    Example: rig goto -90 --bench sim
    """
    from rig.motion.turntable import Turntable

    with settings.open_bench() as bench, Turntable(bench) as table:
        _turn(settings, table, angle_deg)


@command
def home(
    settings: Settings,
    turns: Annotated[
        int | None,
        typer.Option(metavar="N", help="I have looked: the cable is wound up by N whole turns; 0 if it hangs free."),
    ] = None,
    here: Annotated[
        bool, typer.Option("--here", help="I have looked: zero is where the table stands now. Moves nothing.")
    ] = False,
) -> None:
    """Turn the table back to zero; where its turns are in doubt, say first how its cable lies.

    Example: rig home --turns 0 --bench sim
    """
    from rig.core.errors import UsageError
    from rig.motion.turntable import Turntable

    if here and turns is not None:
        raise UsageError("--here and --turns exclude each other.", next_step="Give one of them.")
    with settings.open_bench() as bench:
        if here:
            bench.safety.set_angle(0.0)
            settings.say("Zero is where the table stands now.", {"table_deg": 0.0})
            return
        if turns is not None:
            bench.safety.set_revolutions(turns)
        with Turntable(bench) as table:
            _turn(settings, table, 0.0)


def _turn(settings: Settings, table: "Turntable", angle_deg: float) -> None:
    """Turn the table, and tell what is told of any move."""
    from rig.cli.ui.present import line
    from rig.core.errors import RigError
    from rig.events.events import Event, event_dict
    from rig.plans.capture import announced, moved

    def steps() -> Iterator[Event]:
        yield moved(0, (yield from announced(0, table, angle_deg)))

    try:
        for event in steps():
            settings.say(line(event), event_dict(event))
    except RigError as error:
        settings.note("moved", to_deg=angle_deg, ended=error.what)
        raise
    settings.note("moved", to_deg=angle_deg)


@command
def status(settings: Settings) -> None:
    """Say which devices answer and in what state they are; moves nothing.

    Example: rig status --bench sim --json
    """
    from rig.events.events import plain

    with settings.open_bench(tell=False) as bench:
        state, safety = bench.servo.read_state(), bench.safety
        config = bench.config.table
        table_deg = None if safety.doubt else safety.angle_reference.to_table(state.position_deg)
        report = {
            "bench": bench.name,
            "state": str(safety.state),
            "fault": safety.fault.model_dump() if safety.fault else None,
            "doubt": str(safety.doubt) if safety.doubt else None,
            "table_deg": table_deg,
            "limits_deg": list(config.limits_deg),
            "servo": {**plain(bench.servo.identity), **plain(state), "line": dict(bench.servo.bus_statistics)},
            "imu": {**plain(bench.imu.identity), "temperature_c": bench.imu.temperature_c()},
            **({"head": bench.head.report()} if bench.head else {}),
            "camera": {**plain(bench.camera.identity), "locks": plain(bench.camera.read_locks())},
            "findings": list(bench.findings),
        }
    if settings.json:
        settings.print_json(report)
        return
    print(f"bench    {report['bench']}")
    print(f"state    {_state_words(safety)}")
    print(f"table    {_table_words(table_deg, config.limits_deg)}")
    for device in ("servo", "imu", "head", "camera"):
        if device not in report:
            continue
        facts = report[device]
        assert isinstance(facts, dict)
        print(f"{device:8s} " + ", ".join(f"{key} {_short(value)}" for key, value in facts.items() if key != "time_ns"))
    for finding in bench.findings:
        print(f"note     {finding}")


def _table_words(angle_deg: float | None, limits_deg: tuple[float, float]) -> str:
    low, high = limits_deg
    reach = f"the cable reaches from {low:g}° to {high:g}°, {low / 360:+.2f} to {high / 360:+.2f} turns"
    return f"in doubt; {reach}" if angle_deg is None else f"{angle_deg:.2f}° ({angle_deg / 360:+.2f} turns); {reach}"


def _state_words(safety: "Safety") -> str:
    if safety.fault is not None:
        fault = safety.fault
        return f"{safety.state} {fault.code} since {fault.utc}: {fault.what} {fault.next_step}"
    return f"{safety.state}: {safety.doubt} (`rig home --help`)" if safety.doubt else str(safety.state)


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
