"""Check the servo: its identity, settings and state; reads only."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any

from rig.config import ServoConfig
from rig.config.servos import DynamixelModel
from rig.core.clock import seconds_between
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.core.next_steps import Do, SomeSteps
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.dynamixel.registers import (
    control_table,
    model_of,
    obstacle,
    servo_plugin,
)
from rig.devices.dynamixel.servo import DynamixelServo, open_servo
from rig.devices.servo import Servo
from rig.doctor.bus_scan import BAUD_RATES, BaudScan, FoundServo, scan_rates, scan_servos
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, Severity, graded, of_error

READS = 100  # finds one bad reading in fifty; takes half a second at 57,600 bit/s
REPEATED = 2  # number of repeated readings on a good bus
SLOW = 1 / 3  # share of the control loop's period that a reading may take; the usual cause of more is the latency timer
IMPOSSIBLE_C = 150


def servo(context: DoctorContext) -> Iterator[Finding | str]:
    """Find the configured servo and others on its bus, and check its settings, supply and temperature."""
    config = context.config.servo
    if context.config.imu.connection == "head" and context.config.head.power:
        yield FindingCode.SUPPLY_SWITCHED()
        return
    with ExitStack() as opened:
        try:
            wire = context.computer.open_serial(config.port, config.baud)
        except DeviceNotFound as error:
            yield of_error(error)
            return
        opened.callback(wire.close)
        plugged = servo_plugin(config.model)
        foreign = plugged is not None and not isinstance(plugged, DynamixelModel)  # it must hear no Dynamixel packets
        try:
            found = open_servo(wire, config, context.computer.clock, context.config.table.mode)
        except DeviceNotFound as error:
            yield from [of_error(error)] if foreign else _scan_rates(context, wire)
            return
        except DeviceMismatch as error:
            number = error.evidence.get("model_number")  # another maker's driver may not report it
            model = None if number is None or obstacle(number) else model_of(number)
            yield of_error(error, Do.SET_KEY(key="servo.model", value=model) if model else "")
            return
        except DeviceSilent as error:
            yield from () if foreign else _others_on_bus(context, wire)
            yield of_error(error)
            return
        identity = found.identity
        context.identities["servo"] = asdict(identity)
        name = identity.model.replace("_", "-").upper()
        yield FindingCode.SERVO(model=name, firmware=identity.firmware, **_place(config))
        if isinstance(found, DynamixelServo):
            yield from _others_on_bus(context, wire)
            yield from _settings(found)
        yield from _condition(context, found)
        if isinstance(found, DynamixelServo):
            yield from _bus_quality(context, found)


def _scan_rates(context: DoctorContext, wire: SerialConnection) -> Iterator[Finding | str]:
    """Scan the other baud rates, because the configured servo does not answer."""
    config = context.config.servo
    rates = (config.baud, *(rate for rate in BAUD_RATES if rate != config.baud))
    answered = yield from scan_rates(context, wire, rates, config.port)
    if answered and answered[-1].duplicate_ids:
        yield duplicate_id(config.port, answered[-1])
        return
    there = [found for scan in answered for found in scan.servos]
    if not there:
        yield FindingCode.NO_SERVO(**_place(config))
        return
    fix = Do.SETUP() if len(there) > 1 else _use(config, there[0])
    yield FindingCode.OTHER_SERVOS(fix, found=there, **_place(config))


def _place(config: ServoConfig) -> dict[str, Any]:
    return {"id": config.id, "baud": config.baud, "port": config.port}


def _use(config: ServoConfig, there: FoundServo) -> SomeSteps:
    """Return the command that changes the configuration to the servo found, if the rig can drive it."""
    if there.obstacle:
        return there.obstacle[1]
    differing = {
        "servo.id": (config.id, there.bus_id),
        "servo.baud": (config.baud, there.baud),
        "servo.model": (config.model, there.model),
    }
    changes = [Do.SET_KEY(key=key, value=now) for key, (was, now) in differing.items() if was != now]
    return changes[0] if len(changes) == 1 else Do.SETUP()


def _others_on_bus(context: DoctorContext, wire: SerialConnection) -> Iterator[Finding]:
    """Find other servos at this baud rate, and servos with the same id."""
    config = context.config.servo
    for scan in scan_servos(wire, context.computer.clock, [config.baud]):
        others = [servo for servo in scan.servos if servo.bus_id != config.id]
        if scan.duplicate_ids:
            yield duplicate_id(config.port, scan)
        elif scan.noise:
            yield FindingCode.FOREIGN_BYTES(port=config.port, baud=scan.baud)
        elif others:
            yield FindingCode.MORE_SERVOS(found=others)
        else:
            yield FindingCode.ONLY_SERVO()


def duplicate_id(port: str, scan: BaudScan) -> Finding:
    """Return the finding that two servos have the same id."""
    taken = {servo.bus_id for servo in scan.servos} | set(scan.duplicate_ids)
    free_id = next(bus_id for bus_id in range(1, 253) if bus_id not in taken)
    fix = ("Unplug one of the two, then", Do.SERVO_ID(id=free_id))
    return FindingCode.DUPLICATE_ID(fix, port=port, ids=scan.duplicate_ids, baud=scan.baud)


def _settings(found: DynamixelServo) -> Iterator[Finding]:
    differences = found.setting_differences()
    if not differences:
        yield FindingCode.SETTINGS_CORRECT()
    for difference in differences:
        values = {"register": difference.register, "found": difference.found, "wanted": difference.wanted}
        yield FindingCode.SETTING_DIFFERS(difference=difference, **values)


def _condition(context: DoctorContext, found: Servo) -> Iterator[Finding]:
    state, limits, safety = found.read_state(), found.limits, context.config.safety
    condition = found.read_condition()
    if condition.hardware_errors:
        yield FindingCode.HARDWARE_ERROR(hardware_errors=condition.hardware_errors)
    if condition.watchdog_tripped:
        yield FindingCode.WATCHDOG_TRIPPED()
    if condition.torque:
        yield FindingCode.TORQUE_ON()
    low, high = limits.voltage_v
    if state.voltage_v > 2 * high or state.temperature_c > IMPOSSIBLE_C:
        values = {"voltage_v": state.voltage_v, "temperature_c": state.temperature_c}
        yield FindingCode.IMPOSSIBLE_VALUES(**values)
        return
    beyond_v = max(low - state.voltage_v, state.voltage_v - high)
    level = graded(bad=beyond_v > 0, warning=beyond_v > -safety.voltage_margin_v)
    supply = {"voltage_v": state.voltage_v, "low_v": low, "high_v": high}
    yield FindingCode.SUPPLY((), level, **supply)
    level = graded(bad=state.temperature_c >= limits.temperature_c - safety.temperature_margin_c)
    temperature = {"temperature_c": state.temperature_c, "limit_c": limits.temperature_c}
    yield FindingCode.TEMPERATURE((), level, **temperature)


def _bus_quality(context: DoctorContext, found: DynamixelServo) -> Iterator[Finding]:
    clock = context.computer.clock
    before = found.bus_statistics
    ticks = _ticks(found)
    start_ns = clock.now_ns()
    for _ in range(READS):
        found.read_state()
    each_ms = seconds_between(start_ns, clock.now_ns()) * 1e3 / READS
    after = found.bus_statistics
    if ticks is not None and ticks == _ticks(found):
        yield FindingCode.SERVO_FROZEN(tick_ms=ticks, readings=READS)
        return
    again = after["retries"] - before["retries"]
    quality = {"readings": READS, "reading_ms": each_ms, "retries": again}
    if again > REPEATED:
        yield FindingCode.READINGS(**quality)
    elif each_ms > SLOW * 1e3 * context.config.table.poll_s:
        port = context.computer.serial_port(context.config.servo.port)
        fix = f"echo 1 | sudo tee {port.latency_file}" if port and (port.latency_ms or 0) > 1 else ""
        yield FindingCode.SLOW_READINGS(fix or Do.SERVO_BAUD(baud=1000000), **quality)
    else:
        yield FindingCode.READINGS((), Severity.FINE, **quality)


def _ticks(found: DynamixelServo) -> int | None:
    """Return the servo's own clock in milliseconds; None for a model without a clock."""
    table = control_table(found.identity.model, found.identity.firmware)
    if "Realtime Tick" not in table:
        return None
    return found.bus.read(found.identity.bus_id, table["Realtime Tick"])
