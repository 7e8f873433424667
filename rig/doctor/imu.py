"""Find IMUs on I2C buses, and check the configured one: its identity, and its readings at rest."""

import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from errno import EBUSY, EIO
from typing import Any

import numpy as np
from smbus2 import SMBus

from rig.bench.computer import Computer
from rig.config.imus import imu_kind, imu_kinds
from rig.core.next_steps import Do, SomeSteps
from rig.devices.bno055 import SLOW_BUS
from rig.devices.head.head import RigHead, open_head
from rig.devices.head.protocol import BAUD
from rig.devices.i2c import NO_DEVICE, RESTART_CONTROLLER, STUCK, controller_hangs, unbind_command
from rig.devices.imu import Imu, open_imu
from rig.doctor.examination import DoctorContext
from rig.doctor.finding import Finding, bad, fine, graded, of_error, warning
from rig.safety.gyro_rotation import DRAIN_SAMPLES

SECONDS, DRAIN_S = 1.5, 0.25
NOISY = 4.0  # multiple of the datasheet's noise that a quiet table does not exceed
NO_REST_DPS = 20.0
MAX_BIAS_DPS = 20.0  # zero-rate output of the MPU-6050's datasheet; more is a rotation, or a broken sensor
UPRIGHT = 0.94  # share of gravity along the table's axis when the sensor lies within 20° of it


@dataclass(frozen=True, slots=True)
class FoundImu:
    """A device at an IMU address; ``driver``, the ``imu.model``, is None if there is no driver, or if it is unknown.

    ``note`` has more about it: the note of its row, or registers of an unknown chip. ``errno`` is the error of the bus
    at the address; the controller ``hangs`` if this is the only answer of the whole bus.
    """

    bus: str
    address: int
    name: str
    driver: str | None = None
    note: str = ""
    errno: int = 0
    hangs: bool = False

    def __str__(self) -> str:
        return f"{self.name} at {self.address:#04x} of {self.bus}" + (f": {self.note}" if self.note else "")


def scan_imus(computer: Computer, bus: int | str) -> list[FoundImu]:
    """Return the devices that answer at IMU addresses; no other address is asked, and nothing is written.

    An address at which the bus fails is also returned, with the error's number: the others are asked nevertheless.

    Raises `OSError`: the bus cannot be opened.
    """
    name, path, kinds = computer.i2c_name(bus), computer.i2c_path(bus), imu_kinds().values()
    found, failures = [], []
    with SMBus(path) as wire:
        for address in sorted({address for kind in kinds for address in kind.addresses}):
            here = [kind for kind in kinds if address in kind.addresses]
            try:
                said = {
                    register: wire.read_byte_data(address, register)
                    for register in sorted({kind.register for kind in here})
                }
            except OSError as error:
                failures.append(error.errno or EIO)
                if failures[-1] not in NO_DEVICE:
                    found.append(FoundImu(name, address, "unknown device", errno=failures[-1]))
                continue
            kind = next((kind for kind in here if said[kind.register] in kind.identities), None)
            values = ", ".join(f"register {register:#04x} is {value:#04x}" for register, value in said.items())
            if kind is None:
                found.append(FoundImu(name, address, "unknown chip", note=values))
            else:
                found.append(FoundImu(name, address, kind.name, kind.key if kind.driver else None, kind.note))
    hangs = all(one.errno for one in found) and controller_hangs(path, failures)
    return [replace(one, hangs=hangs) for one in found]


def unusable(computer: Computer, found: FoundImu) -> Finding | None:
    """Return why the rig cannot use a device: a kernel driver uses it, the bus fails, or the rig has no driver."""
    place = {"bus": found.bus, "address": found.address}
    if found.errno == EBUSY:
        text = "the kernel driver {driver} uses {address:#04x} of {bus}"
        driver = computer.i2c_driver(found.bus, found.address)
        fix = unbind_command(found.bus.removeprefix("/dev/"), found.address, driver or "")
        fix = fix if driver else "ls -l /sys/bus/i2c/devices/*/driver"
        return bad("kernel_driver", text, fix, driver=driver or "(unknown)", **place)
    if found.errno:
        place |= {"reason": os.strerror(found.errno), "errno": found.errno}
        restart = "Switch the sensor's supply off and on, and check SDA and SCL for a short circuit"
        if found.hangs:
            text = "the controller of {bus} hangs: {reason}; it works again after its supply was off"
            return bad("i2c_hangs", text, RESTART_CONTROLLER, **place)
        if found.errno in STUCK:
            return bad("i2c_stuck", "{bus} is stuck: {reason}; a device blocks the bus", restart, **place)
        return bad("i2c_failed", "{bus} fails at {address:#04x}: {reason}", restart, **place)
    if found.driver is None:
        fix = f"Use one of these sensors: {', '.join(kind.name for kind in imu_kinds().values() if kind.driver)}"
        return bad("no_driver", "{found}: the rig has no driver for it", fix, found=found, address=found.address)
    return None


def not_opened(bus: str, error: OSError) -> Finding:
    """Return the finding that an I2C bus cannot be opened."""
    return bad("i2c_not_opened", "{bus} cannot be opened: {reason}", Do.FIND(), bus=bus, reason=error.strerror)


def rig_head(head: RigHead, port: str) -> Finding:
    """Return which rig head is at a port, and its sensor."""
    who = head.identity
    parts = {"model": who.model, "board": who.board, "firmware": who.firmware, "serial": who.serial}
    return fine("head", "{model} on a rig head ({board}, firmware {firmware}) at {port}", port=port, **parts)


def imu(context: DoctorContext) -> Iterator[Finding]:
    """Identify the sensor, then check its noise, its zero, and its orientation."""
    config, computer = context.config, context.computer
    # The sensor of a rig head is not on a bus of this computer.
    if config.imu.connection == "head":
        with closing(open_head(config, lambda: computer.open_serial(config.head.port, BAUD), computer.clock)) as head:
            yield rig_head(head, config.head.port)
            if (fault := head.fault) is not None:
                yield of_error(fault, Do.ACKNOWLEDGE())
            yield from _at_rest(context, head)
        return
    bus = computer.i2c_name(config.imu.bus)
    try:
        there = scan_imus(computer, config.imu.bus)
    except OSError as error:
        yield not_opened(bus, error)
        return
    here = next((found for found in there if found.address == config.imu.address), None)
    if here is None or here.driver != config.imu.model:
        yield _wrong(context, here, [found for found in there if found.driver])
        return
    with closing(open_imu(config.imu, computer.i2c_path(config.imu.bus), computer.clock)) as sensor:
        identity = sensor.identity
        parts = {"model": identity.model, "address": identity.bus_address, "who_am_i": identity.who_am_i}
        yield fine("imu", "{model} at {address:#04x} of {bus} (identity {who_am_i:#04x})", bus=bus, **parts)
        # The sensor works: now its samples and its bus.
        yield from _at_rest(context, sensor)
        if corrupt := getattr(getattr(sensor, "statistics", None), "corrupt", 0):
            fix = SLOW_BUS if config.imu.model == "bno055" else "Shorten the I2C cable"
            yield warning("corrupt_readings", "{corrupt} readings of the sensor were corrupt", fix, corrupt=corrupt)


def _wrong(context: DoctorContext, here: FoundImu | None, usable: list[FoundImu]) -> Finding:
    """Return why the configured sensor is not there: what is at its address, or at which address another is."""
    config = context.config.imu
    if here is not None:
        other = {"found": here, "address": here.address, "model": config.model}
        text = "{found}, but imu.model is {model}"
        return unusable(context.computer, here) or bad("other_imu", text, Do.SETUP(), **other)
    fix = Do.SETUP() if usable else "Check the sensor's 3.3 V, ground, SDA and SCL"
    text = "no device answers at {address:#04x} of {bus} (at other IMU addresses: {found})"
    bus = context.computer.i2c_name(config.bus)
    return bad("no_imu", text, fix, address=config.address, bus=bus, found=usable)


def _at_rest(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    if note := imu_kind(context.config.imu.model).note:
        yield fine("imu_note", "{note}", note=note)
    context.identities["imu"] = asdict(sensor.identity)
    yield _rest(context, sensor)
    yield _gravity(context, sensor)


def _rest(context: DoctorContext, sensor: Imu) -> Finding:
    """Take ``SECONDS`` of samples, without older ones, and return whether they are those of a sensor at rest."""
    sensor.read_samples()
    taken, drain_s = [], min(DRAIN_S, DRAIN_SAMPLES / sensor.rate_hz)  # before the sensor's buffer is full
    for _ in range(round(SECONDS / drain_s)):
        context.computer.clock.sleep(drain_s)
        taken.append(sensor.read_samples())
    rates, wanted = np.concatenate([part.gyro_dps for part in taken]), SECONDS * sensor.rate_hz
    if len(rates) < 0.8 * wanted:
        text = "{samples} samples in {seconds:g} s instead of {wanted:.0f}, {lost} lost"
        lost = sum(part.lost for part in taken)
        fix = "Shorten the I2C cable and remove other devices from the bus"
        return bad("samples_missing", text, fix, samples=len(rates), seconds=SECONDS, wanted=wanted, lost=lost)
    axis = "xyz".index(context.config.imu.axis)
    spread, bias = rates.std(axis=0), float(rates[:, axis].mean())
    expected = sensor.identity.gyro_noise_dps_rthz * np.sqrt(sensor.rate_hz / 2)
    evidence: dict[str, Any] = {"noise_dps": float(spread[axis]), "bias_dps": bias, "samples": len(rates)}
    noise, zero = "noise {noise_dps:.3f} °/s", "zero at {bias_dps:+.2f} °/s"
    if (np.abs(rates) >= sensor.range_dps * 0.999).any():
        fix = "Check the sensor's supply and cable"
        text = "saturated at {range_dps:.0f} °/s at rest"
        return bad("saturated", text, fix, range_dps=sensor.range_dps, **evidence)
    if (rates == rates[0]).all():
        fix = "Switch the sensor's supply off and on"
        return bad("imu_frozen", "frozen: all samples are identical, without noise", fix, **evidence)
    is_bad, is_noisy = spread.max() > NO_REST_DPS, spread.max() > NOISY * expected
    if is_bad or is_noisy:
        fix = "Keep hands and vibration away from the bench, and check the sensor's supply, ground and cable"
        text, evidence = f"{noise} at rest; {{expected_dps:.3f}} °/s is usual", {"expected_dps": expected} | evidence
        return graded("noisy", text, fix, is_bad=is_bad, is_warning=is_noisy, **evidence)
    if abs(bias) > MAX_BIAS_DPS:
        return bad("large_bias", f"{zero}: outside the datasheet", "Replace the sensor", **evidence)
    return fine("at_rest", f"at rest: {noise}, {zero}", **evidence)


def _gravity(context: DoctorContext, sensor: Imu) -> Finding:
    gravity = sensor.read_gravity_g()
    size, axis = float(np.linalg.norm(gravity)), context.config.imu.axis
    along = float(gravity["xyz".index(axis)])
    evidence: dict[str, Any] = {"gravity_g": [round(float(g), 4) for g in gravity], "size_g": size, "axis": axis}
    if not 0.8 < size < 1.2:
        fix: SomeSteps = "Check the sensor's supply"
        return bad("wrong_gravity", "gravity is {size_g:.2f} g", fix, **evidence)
    if abs(along) < UPRIGHT * size:
        upright = "xyz"[int(np.abs(gravity).argmax())]
        fix = Do.SET_KEY(key="imu.axis", value=upright) if upright != axis else "Mount the sensor flat on the platter"
        text = "its {axis} axis does not point along the table's axis: {along:+.2f} of gravity is along it"
        return warning("tilted", text, fix, along=along / size, **evidence)
    text = "gravity {size_g:.2f} g, {along:.0%} of it along {axis}"
    return fine("gravity", text, along=abs(along / size), **evidence)
