"""Check the servo: its identity, settings and state; reads only."""

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
REPEATED = 2  # number of repeated readings on a good bus
SLOW = 1 / 3  # share of the control loop's period that a reading may take; the usual cause of more is the latency timer
IMPOSSIBLE_C = 150
POWER = "Check the servo's cable and switch on its 12 V supply (its LED blinks once), then: "


def servo(context: DoctorContext) -> Iterator[Finding | str]:
    """Find the configured servo and others on its bus, and check its settings, supply and temperature."""
    if context.holder is not None:
        yield warning("servo", "not checked: the bench is in use", context.rig("stop"))
        return
    config = context.config.servo
    if context.config.imu.connection == "head" and context.config.head.power:
        text = "not checked: the rig head's relay switches its supply on only while a program runs"
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
            yield from _scan_rates(context, wire)
            return
        except DeviceMismatch as error:
            yield of_error("servo", error, context.set("servo.model", error.evidence["got"]))
            return
        except DeviceSilent as error:
            yield from _others_on_bus(context, wire)
            yield of_error("servo", error)
            return
        identity = found.identity
        context.identities["servo"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
        name = identity.model.replace("_", "-").upper()
        yield fine(
            "servo", f"{name}, firmware {identity.firmware}, id {config.id} at {config.baud} baud, {config.port}"
        )
        for remark in found.remarks:
            yield warning("servo", remark.removeprefix("servo: "), "Stay at the bench, or use a servo of the X series")
        yield from _others_on_bus(context, wire)
        yield from _settings(context, found)
        yield from _condition(context, found)
        yield from _bus_quality(context, found)


def _scan_rates(context: DoctorContext, wire: SerialConnection) -> Iterator[Finding | str]:
    """Scan the other baud rates, because the configured servo does not answer."""
    config = context.config.servo
    protocol = protocol_of(config.model)
    rates = BAUD_RATES if protocol == 2 else BAUD_RATES_1
    answered: list[BaudScan] = []
    for rate in [config.baud, *(rate for rate in rates if rate != config.baud)]:
        yield f"{config.port}: no servo at id {config.id}; scanning at {rate} baud ..."
        for scan in scan_servos(wire, context.computer.clock, [rate], protocol=protocol):
            if scan.duplicate_ids:
                yield _duplicate(context, scan)
                return
            answered.append(scan)
    there = [found for scan in without_echoes(answered, config.baud) for found in scan.servos]
    wanted = f"no servo answers at id {config.id}, {config.baud} baud, {config.port}"
    if not there:
        yield bad("servo", f"{wanted}, nor any other at any baud rate", POWER + context.rig("doctor"))
        return
    if len(there) > 1:
        listed = "; ".join(map(str, there))
        yield bad("servo", f"{wanted}; {len(there)} others do: {listed}", context.rig("setup"))
        return
    yield bad("servo", f"{wanted}; there is {there[0]}", _change_config(context, config, there[0]))


def _change_config(context: DoctorContext, config: ServoConfig, there: FoundServo) -> str:
    """Return the command that changes the configuration to the servo found."""
    differing = {
        "servo.id": (config.id, there.bus_id),
        "servo.baud": (config.baud, there.baud),
        "servo.model": (config.model, there.model or config.model),
    }
    changes = [context.set(key, now) for key, (was, now) in differing.items() if was != now]
    return changes[0] if len(changes) == 1 else context.rig("setup")


def _others_on_bus(context: DoctorContext, wire: SerialConnection) -> Iterator[Finding]:
    """Find other servos at this baud rate, and servos with the same id."""
    config = context.config.servo
    if protocol_of(config.model) == 1:
        return  # Protocol 1.0 has no broadcast ping: `rig find` asks each id
    for scan in scan_servos(wire, context.computer.clock, [config.baud]):
        others = [servo for servo in scan.servos if servo.bus_id != config.id]
        if scan.duplicate_ids:
            yield _duplicate(context, scan)
        elif scan.noise:
            text = (
                "bytes arrive that do not belong to a servo: another program or adapter on the bus, or a loose contact"
            )
            yield warning("servo", text, "Remove everything but the servo from the bus, then: " + context.rig("doctor"))
        elif others:
            listed = "; ".join(map(str, others))
            yield fine("servo", f"also on the bus, not checked: {listed}")
        else:
            yield fine("servo", "the only servo on its bus")


def _duplicate(context: DoctorContext, scan: BaudScan) -> Finding:
    ids = ", ".join(map(str, scan.duplicate_ids))
    taken = {servo.bus_id for servo in scan.servos} | set(scan.duplicate_ids)
    free_id = next(bus_id for bus_id in range(1, 253) if bus_id not in taken)
    return bad(
        "servo",
        f"two servos answer at once to id {ids} at {scan.baud} baud (or the connection is very bad)",
        f"Unplug one of the two, then: {context.rig(f'servo set-id {free_id}')}",
        ids=list(scan.duplicate_ids),
        baud=scan.baud,
    )


def _settings(context: DoctorContext, found: RegisterServo) -> Iterator[Finding]:
    differences = found.setting_differences()
    if not differences:
        yield fine("servo", "its permanent settings (EEPROM) are as required")
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
        yield warning("servo", "its watchdog tripped: a program ended during a rotation", context.rig("status"))
    if condition.torque:
        yield warning("servo", "its torque is on although no program uses it", context.rig("stop"))
    low, high = limits.voltage_v
    if state.voltage_v > 2 * high or state.temperature_c > IMPOSSIBLE_C:
        text = f"reports impossible values: {state.voltage_v:.1f} V and {state.temperature_c:.0f} °C"
        yield bad("servo", text, "Replace the servo, or its cable if another servo reports the same")
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
        fix = "Let it cool, and find out why the table is hard to rotate"
        yield bad("servo", text, fix, temperature_c=state.temperature_c)
    else:
        yield fine("servo", text, temperature_c=state.temperature_c)


def _bus_quality(context: DoctorContext, found: RegisterServo) -> Iterator[Finding]:
    clock = context.computer.clock
    before = found.bus_statistics
    ticks = _ticks(found)
    start_ns = clock.now_ns()
    for _ in range(READS):
        found.read_state()
    each_ms = seconds_between(start_ns, clock.now_ns()) * 1e3 / READS
    after = found.bus_statistics
    if ticks is not None and ticks == _ticks(found):
        text = f"frozen: its own clock stood at {ticks} ms during {READS} readings, so its readings are not valid"
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
    """Return the servo's own clock in milliseconds; None for a model without a clock."""
    table = control_table(found.identity.model, found.identity.firmware)
    if "Realtime Tick" not in table:
        return None
    return found.bus.read(found.identity.bus_id, table["Realtime Tick"])
