"""Check the servo: its identity, settings and state; reads only."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from typing import Any

from rig.config import ServoConfig
from rig.config.servos import DynamixelModel
from rig.core.clock import seconds_between
from rig.core.errors import DeviceNotFound, DeviceSilent
from rig.core.next_steps import Do, SomeSteps
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.dynamixel.registers import control_table, servo_plugin
from rig.devices.dynamixel.servo import DynamixelServo, open_servo
from rig.devices.servo import Servo
from rig.doctor.computer import LATENCY_MS, udev_command
from rig.doctor.examination import DoctorContext
from rig.doctor.finding import Finding, bad, fine, graded, warning
from rig.doctor.servo_scan import BAUD_RATES, BaudScan, scan_servos

READS = 100  # finds one bad reading in fifty; takes half a second at 57,600 bit/s
REPEATED = 2  # number of repeated readings on a good bus
SLOW = 1 / 3  # share of the control loop's period that a reading may take; the usual cause of more is the latency timer


def servo(context: DoctorContext) -> Iterator[Finding]:
    """Find the configured servo and others on its bus, and check its settings, supply and temperature."""
    config = context.config.servo
    if context.config.imu.connection == "head" and context.config.head.power:
        text = "not checked: the rig head's relay switches its supply on only while a program runs"
        yield warning("supply_switched", text, Do.STATUS())
        return
    with closing(context.computer.open_serial(config.port, config.baud)) as wire:
        plugged = servo_plugin(config.model)
        foreign = plugged is not None and not isinstance(plugged, DynamixelModel)  # it must hear no Dynamixel packets
        try:
            found = open_servo(wire, config, context.computer.clock, context.config.table.mode)
        except DeviceNotFound:
            if foreign:
                raise
            yield _elsewhere(context, wire)
            return
        except DeviceSilent:
            if not foreign:
                yield _others_on_bus(context, wire)
            raise
        # It answers: what it is, what else is on its bus, how it is set, how it is, and how reliably it answers.
        identity = found.identity
        context.identities["servo"] = asdict(identity)
        name = identity.model.replace("_", "-").upper()
        text = "{model}, firmware {firmware}, id {id} at {baud} baud, {port}"
        yield fine("servo", text, model=name, firmware=identity.firmware, **_place(config))
        if isinstance(found, DynamixelServo):
            yield _others_on_bus(context, wire)
            yield from _settings(found)
        yield from _condition(context, found)
        if isinstance(found, DynamixelServo):
            yield _bus_quality(context, found)


def _elsewhere(context: DoctorContext, wire: SerialConnection) -> Finding:
    """Return what answers at other ids and baud rates, because the configured servo does not answer."""
    config = context.config.servo
    rates = (config.baud, *(rate for rate in BAUD_RATES if rate != config.baud))
    scans = scan_servos(wire, context.computer.clock, rates, config.baud)
    if scans and scans[-1].duplicate_ids:
        return duplicate_id(config.port, scans[-1])
    there = [found for scan in scans for found in scan.servos]
    text = "no servo answers at id {id}, {baud} baud, {port}"
    if not there:
        fix = "Check the servo's cable and switch on its 12 V supply (its LED blinks once)"
        return bad("no_servo", f"{text}, nor any other at any baud rate", fix, **_place(config))
    obstacle = there[0].obstacle if len(there) == 1 else None
    use = obstacle[1] if obstacle else Do.SETUP()
    return bad("other_servos", f"{text} (found: {{found}})", use, found=there, **_place(config))


def _place(config: ServoConfig) -> dict[str, Any]:
    return {"id": config.id, "baud": config.baud, "port": config.port}


def _others_on_bus(context: DoctorContext, wire: SerialConnection) -> Finding:
    """Return what else answers at this baud rate: other servos, or a servo with the same id."""
    config = context.config.servo
    (scan,) = scan_servos(wire, context.computer.clock, [config.baud])
    others = [servo for servo in scan.servos if servo.bus_id != config.id]
    if scan.duplicate_ids:
        return duplicate_id(config.port, scan)
    if scan.noise:
        return foreign_bytes(config.port, scan)
    if others:
        return fine("more_servos", "also on the bus, not checked: {found}", found=others)
    return fine("only_servo", "the only servo on its bus")


def duplicate_id(port: str, scan: BaudScan) -> Finding:
    """Return the finding that two servos have the same id."""
    taken = {servo.bus_id for servo in scan.servos} | set(scan.duplicate_ids)
    free_id = next(bus_id for bus_id in range(1, 253) if bus_id not in taken)
    fix = ("Unplug one of the two, then", Do.SERVO_ID(id=free_id))
    text = "{port}: two servos answer at once to id {ids} at {baud} baud (or the connection is very bad)"
    return bad("duplicate_id", text, fix, port=port, ids=scan.duplicate_ids, baud=scan.baud)


def foreign_bytes(port: str, scan: BaudScan) -> Finding:
    """Return the finding that something else than a servo sends on a bus."""
    text = "{port}: bytes at {baud} baud that belong to no servo: another program or adapter, or a loose contact"
    fix = "Remove everything but servos from the bus"
    return warning("foreign_bytes", text, fix, port=port, baud=scan.baud)


def _settings(found: DynamixelServo) -> Iterator[Finding]:
    differences = found.setting_differences()
    if not differences:
        yield fine("settings_correct", "its permanent settings (EEPROM) are as required")
    for difference in differences:
        values = {"register": difference.register, "found": difference.found, "wanted": difference.wanted}
        yield bad("setting_differs", "EEPROM {difference}", Do.SERVO_SETTINGS(), difference=difference, **values)


def _condition(context: DoctorContext, found: Servo) -> Iterator[Finding]:
    state, limits, safety = found.read_state(), found.limits, context.config.safety
    condition = found.read_condition()
    # What an earlier program left behind.
    if condition.hardware_errors:
        text = "reports a hardware error: {hardware_errors}; torque stays off until it restarts"
        yield bad("hardware_error", text, Do.ACKNOWLEDGE(reboot=True), hardware_errors=condition.hardware_errors)
    if condition.watchdog_tripped:
        text = "its watchdog tripped: a program ended during a rotation"
        yield warning("watchdog_tripped", text, Do.STATUS())
    if condition.torque:
        yield warning("torque_on", "its torque is on although no program uses it", Do.STOP())
    # Supply and temperature.
    low, high = limits.voltage_v
    beyond_v = max(low - state.voltage_v, state.voltage_v - high)
    supply: dict[str, Any] = {"voltage_v": state.voltage_v, "low_v": low, "high_v": high}
    text = "supply {voltage_v:.1f} V (the servo shuts down outside {low_v:.1f}–{high_v:.1f} V)"
    fix = "Check the power supply and its plug"
    yield graded("supply", text, fix, is_bad=beyond_v > 0, is_warning=beyond_v > -safety.voltage_margin_v, **supply)
    hot = state.temperature_c >= limits.temperature_c - safety.temperature_margin_c
    heat: dict[str, Any] = {"temperature_c": state.temperature_c, "limit_c": limits.temperature_c}
    text = "temperature {temperature_c:.0f} °C (the servo shuts down above {limit_c:.0f} °C)"
    yield graded("temperature", text, "Let it cool, and find out why the table is hard to rotate", is_bad=hot, **heat)


def _bus_quality(context: DoctorContext, found: DynamixelServo) -> Finding:
    # Many readings: how long each takes, how many were repeated, and whether the servo's own clock runs.
    clock = context.computer.clock
    before = found.bus_statistics
    ticks = _ticks(found)
    start_ns = clock.now_ns()
    for _ in range(READS):
        found.read_state()
    each_ms = seconds_between(start_ns, clock.now_ns()) * 1e3 / READS
    after = found.bus_statistics
    if ticks is not None and ticks == _ticks(found):
        text = "frozen: its own clock stood at {tick_ms} ms during {readings} readings: its readings are not valid"
        fix: SomeSteps = "Switch the servo's supply off and on"
        return bad("servo_frozen", text, fix, tick_ms=ticks, readings=READS)
    again = after["retries"] - before["retries"]
    quality: dict[str, Any] = {"readings": READS, "reading_ms": each_ms, "retries": again}
    text = "{readings} readings of {reading_ms:.1f} ms each, {retries} repeated"
    if again <= REPEATED and each_ms > SLOW * 1e3 * context.config.table.poll_s:
        port = context.computer.serial_port(context.config.servo.port)
        has_timer = port is not None and (port.latency_ms or 0) > LATENCY_MS
        fix = udev_command(context) if has_timer else Do.SERVO_BAUD(baud=1000000)
        return warning("slow_readings", f"{text}: slow", fix, **quality)
    fix = "Check the plugs of the servo's cable"
    return graded("readings", text, fix, is_warning=again > REPEATED, **quality)


def _ticks(found: DynamixelServo) -> int | None:
    """Return the servo's own clock in milliseconds; None for a model without a clock."""
    table = control_table(found.identity.model, found.identity.firmware)
    if "Realtime Tick" not in table:
        return None
    return found.bus.read(found.identity.bus_id, table["Realtime Tick"])
