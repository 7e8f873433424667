"""The servo: who answers, as what, in what state; reads only."""

from collections.abc import Iterator
from contextlib import ExitStack

from rig.config import ServoConfig
from rig.core.clock import seconds_between
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.devices.dynamixel.opening import open_servo
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.dynamixel.register_servo import RegisterServo
from rig.devices.dynamixel.registers import control_table, protocol_of
from rig.doctor.bus_scan import BAUD_RATES, BAUD_RATES_1, BaudScan, FoundServo, scan_servos, without_echoes
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, bad, fine, of_error, warning

READS = 100
REPEATED = 2
"""How many of them a good line may spoil."""
SLOW = 1 / 3
"""Share of the control loop's period that a reading may take; where it takes more it mostly is the latency timer."""
IMPOSSIBLE_C = 150
POWER = "Check the servo's cable and switch on its 12 V supply (its LED blinks once), then: "


def servo(context: DoctorContext) -> Iterator[Finding | str]:
    """Find the configured servo, whoever else is on its bus, and look at its settings, supply and temperature."""
    if context.holder is not None:
        yield warning("servo", "not asked: the bench is in use", context.rig("stop"))
        return
    config = context.config.servo
    if context.config.imu.connection == "head" and context.config.head.power:
        text = "not asked: its supply goes through the rig head's relay, which is closed only while a program works"
        yield warning("servo", text, context.rig("status"))
        return
    with ExitStack() as opened:
        try:
            wire = context.computer.open_serial(config.port, config.baud)
        except DeviceNotFound as error:
            yield of_error("servo", error)
            return
        opened.callback(wire.close)
        try:
            found = open_servo(wire, config, context.computer.clock, context.config.table.mode)
        except DeviceNotFound:
            yield from _elsewhere(context, wire)
            return
        except DeviceMismatch as error:
            yield of_error("servo", error, context.set("servo.model", error.evidence["got"]))
            return
        except DeviceSilent as error:
            yield from _alone(context, wire)
            yield of_error("servo", error)
            return
        identity = found.identity
        context.identities["servo"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
        name = identity.model.replace("_", "-").upper()
        yield fine(
            "servo", f"{name}, firmware {identity.firmware}, id {config.id} at {config.baud} baud, {config.port}"
        )
        for remark in found.remarks:
            yield warning("servo", remark.removeprefix("servo: "), "Stay beside it, or use a servo of the X series")
        yield from _alone(context, wire)
        yield from _settings(context, found)
        yield from _condition(context, found)
        yield from _line(context, found)


def _elsewhere(context: DoctorContext, wire: SerialConnection) -> Iterator[Finding | str]:
    """Nobody answers where the configuration says: look at the other baud rates, and say who is there instead."""
    config = context.config.servo
    protocol = protocol_of(config.model)
    rates = BAUD_RATES if protocol == 2 else BAUD_RATES_1
    answered: list[BaudScan] = []
    for rate in [config.baud, *(rate for rate in rates if rate != config.baud)]:
        yield f"{config.port}: nobody at id {config.id}; asking at {rate} baud ..."
        for heard in scan_servos(wire, context.computer.clock, [rate], protocol=protocol):
            if heard.duplicate_ids:
                yield _duplicate(context, heard)
                return
            answered.append(heard)
    there = [found for heard in without_echoes(answered, config.baud) for found in heard.servos]
    wanted = f"no servo answers at id {config.id}, {config.baud} baud, {config.port}"
    if not there:
        yield bad("servo", f"{wanted}, nor any other at any baud rate", POWER + context.rig("doctor"))
        return
    if len(there) > 1:
        listed = "; ".join(map(str, there))
        yield bad("servo", f"{wanted}; {len(there)} others do: {listed}", context.rig("setup"))
        return
    yield bad("servo", f"{wanted}; there is {there[0]}", _follow(context, config, there[0]))


def _follow(context: DoctorContext, config: ServoConfig, there: FoundServo) -> str:
    """Return the command that makes the configuration say what there is."""
    differing = {
        "servo.id": (config.id, there.bus_id),
        "servo.baud": (config.baud, there.baud),
        "servo.model": (config.model, there.model or config.model),
    }
    changes = [context.set(key, now) for key, (was, now) in differing.items() if was != now]
    return changes[0] if len(changes) == 1 else context.rig("setup")


def _alone(context: DoctorContext, wire: SerialConnection) -> Iterator[Finding]:
    """Say who else answers at this baud rate, and whether two answer at once."""
    config = context.config.servo
    if protocol_of(config.model) == 1:
        return  # has no broadcast ping: `rig find` asks each id
    for heard in scan_servos(wire, context.computer.clock, [config.baud]):
        others = [servo for servo in heard.servos if servo.bus_id != config.id]
        if heard.duplicate_ids:
            yield _duplicate(context, heard)
        elif heard.noise:
            text = "bytes arrive that are no servo's: another program or adapter on the line, or a loose contact"
            yield warning("servo", text, "Take everything but the servo off the bus, then: " + context.rig("doctor"))
        elif others:
            listed = "; ".join(map(str, others))
            yield fine("servo", f"also on the bus, left alone: {listed}")
        else:
            yield fine("servo", "alone on its bus, no id twice")


def _duplicate(context: DoctorContext, heard: BaudScan) -> Finding:
    ids = ", ".join(map(str, heard.duplicate_ids))
    return bad(
        "servo",
        f"two servos answer at once to id {ids} at {heard.baud} baud (or the line is very bad)",
        f"Unplug one of the two, then: {context.rig(f'servo set-id {_free_id(heard)}')}",
        ids=list(heard.duplicate_ids),
        baud=heard.baud,
    )


def _free_id(heard: BaudScan) -> int:
    taken = {servo.bus_id for servo in heard.servos} | set(heard.duplicate_ids)
    return next(bus_id for bus_id in range(1, 253) if bus_id not in taken)


def _settings(context: DoctorContext, found: RegisterServo) -> Iterator[Finding]:
    differences = found.setting_differences()
    if not differences:
        yield fine("servo", "its permanent settings (EEPROM) are as the rig needs them")
    for difference in differences:
        yield bad(
            "servo",
            f"EEPROM {difference}",
            context.rig("servo settings --write"),
            register=difference.register,
            found=difference.found,
            wanted=difference.wanted,
        )


def _condition(context: DoctorContext, found: RegisterServo) -> Iterator[Finding]:
    state, limits, safety = found.read_state(), found.limits, context.config.safety
    condition = found.read_condition()
    if condition.hardware_errors:
        text = f"reports a hardware error: {', '.join(condition.hardware_errors)}; torque stays off until it restarts"
        yield bad("servo", text, context.rig("acknowledge --reboot"), hardware_errors=list(condition.hardware_errors))
    if condition.watchdog_tripped:
        yield warning("servo", "its watchdog tripped: a program died while the table moved", context.rig("status"))
    if condition.torque:
        yield warning("servo", "its torque is on although nobody works with it", context.rig("stop"))
    low, high = limits.voltage_v
    if state.voltage_v > 2 * high or state.temperature_c > IMPOSSIBLE_C:
        text = f"tells what cannot be: {state.voltage_v:.1f} V and {state.temperature_c:.0f} °C"
        yield bad("servo", text, "Replace the servo, or its cable if another one tells the same")
        return
    margin = safety.voltage_margin_v
    text = f"supply {state.voltage_v:.1f} V (the servo shuts down outside {low:.1f}..{high:.1f} V)"
    if not low <= state.voltage_v <= high:
        yield bad("servo", text, "Check the power supply and its plug", voltage_v=state.voltage_v)
    elif not low + margin <= state.voltage_v <= high - margin:
        yield warning("servo", text, "Check the power supply and its plug", voltage_v=state.voltage_v)
    else:
        yield fine("servo", text, voltage_v=state.voltage_v)
    text = f"temperature {state.temperature_c:.0f} °C (the servo shuts down above {limits.temperature_c:.0f} °C)"
    if state.temperature_c >= limits.temperature_c - safety.temperature_margin_c:
        fix = "Let it cool, and look for what makes the table hard to turn"
        yield bad("servo", text, fix, temperature_c=state.temperature_c)
    else:
        yield fine("servo", text, temperature_c=state.temperature_c)


def _line(context: DoctorContext, found: RegisterServo) -> Iterator[Finding]:
    clock = context.computer.clock
    before = found.bus_statistics
    ticks = _ticks(found)
    start_ns = clock.now_ns()
    for _ in range(READS):
        found.read_state()
    each_ms = seconds_between(start_ns, clock.now_ns()) * 1e3 / READS
    after = found.bus_statistics
    if ticks is not None and ticks == _ticks(found):
        text = f"frozen: its own clock stood at {ticks} ms during {READS} readings, so no reading of it can be believed"
        yield bad("servo", text, "Switch the servo's supply off and on, then: " + context.rig("doctor"), tick_ms=ticks)
        return
    again = after["retries"] - before["retries"]
    text = f"{READS} readings of {each_ms:.1f} ms each, {again or 'none'} repeated"
    if again > REPEATED:
        yield warning("servo", text, "Check the plugs of the servo's cable", retries=again, reading_ms=each_ms)
    elif each_ms > SLOW * 1e3 * context.config.table.poll_s:
        port = next(
            (
                p
                for p in context.computer.serial_ports()
                if context.computer.same_file(p.path, context.config.servo.port)
            ),
            None,
        )
        fix = f"echo 1 | sudo tee {port.latency_file}" if port and (port.latency_ms or 0) > 1 else ""
        fix = fix or context.rig("servo set-baud 1000000")
        yield warning("servo", text + ": slow", fix, retries=again, reading_ms=each_ms)
    else:
        yield fine("servo", text, retries=again, reading_ms=each_ms)


def _ticks(found: RegisterServo) -> int | None:
    """Return the servo's own clock, in milliseconds; None for a model without."""
    table = control_table(found.identity.model, found.identity.firmware)
    if "Realtime Tick" not in table:
        return None
    return found.bus.read(found.identity.bus_id, table["Realtime Tick"])
