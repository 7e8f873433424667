"""Check the IMU: its identity, and its readings at rest."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from typing import Any

import numpy as np

from rig.config import ImuConfig
from rig.config.imus import imu_kind
from rig.core.next_steps import Do, SomeSteps
from rig.devices.bno055 import SLOW_BUS
from rig.devices.head.head import open_head
from rig.devices.head.protocol import BAUD
from rig.devices.imu import Imu, ImuSamples, open_imu
from rig.doctor.bus_scan import FoundImu, scan_imus, unusable_address, use_another_imu
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, of_error
from rig.safety.gyro_rotation import DRAIN_SAMPLES

SECONDS, DRAIN_S = 1.5, 0.25
NOISY = 4.0  # multiple of the datasheet's noise that a quiet table does not exceed
NO_REST_DPS = 20.0
MAX_BIAS_DPS = 20.0  # zero-rate output of the MPU-6050's datasheet; more is a rotation, or a broken sensor
STRETCH_KHZ = 20.0
"""Highest frequency at which a controller that does not wait for a stretched clock reads a BNO055 correctly."""
UPRIGHT = 0.94  # share of gravity along the table's axis when the sensor lies within 20° of it


def imu(context: DoctorContext) -> Iterator[Finding]:
    """Identify the sensor, then check its noise, its zero, and its orientation."""
    config, clock = context.config, context.computer.clock
    # The sensor of a rig head is not on a bus of this computer.
    if config.imu.connection == "head":
        head = open_head(config, lambda: context.computer.open_serial(config.head.port, BAUD), clock)
        with closing(head):
            who = head.identity
            parts = {"model": who.model, "board": who.board, "firmware": who.firmware, "serial": who.serial}
            yield FindingCode.HEAD(port=config.head.port, **parts)
            if (fault := head.fault) is not None:
                yield of_error(fault, Do.ACKNOWLEDGE())
            yield from _at_rest(context, head)
        return
    # A Raspberry Pi's controller corrupts bytes of a sensor that stretches the clock: warn before the cause is in
    # doubt.
    khz = context.computer.cannot_stretch_khz(config.imu.bus)
    if config.imu.model == "bno055" and khz is not None and khz > STRETCH_KHZ:
        bus = context.computer.i2c_name(config.imu.bus)
        yield FindingCode.CLOCK_STRETCHING(bus=bus, khz=khz)
    try:
        there = scan_imus(context.computer, config.imu.bus)
    except OSError as error:
        bus = context.computer.i2c_name(config.imu.bus)
        yield FindingCode.I2C_NOT_OPENED(bus=bus, reason=error.strerror)
        return
    here = next((found for found in there if found.address == config.imu.address), None)
    if here is None or here.driver != config.imu.model:
        yield _wrong(context, config.imu, here, there)
        return
    with closing(open_imu(config.imu, context.computer.i2c_path(config.imu.bus), clock)) as sensor:
        bus, identity = context.computer.i2c_name(config.imu.bus), sensor.identity
        parts = {"model": identity.model, "address": identity.bus_address, "who_am_i": identity.who_am_i}
        yield FindingCode.IMU(bus=bus, **parts)
        # The sensor works: now its samples and its bus.
        yield from _at_rest(context, sensor)
        corrupt = getattr(getattr(sensor, "statistics", None), "corrupt", 0)
        if corrupt:
            fix = SLOW_BUS if config.imu.model == "bno055" else ("Shorten the I2C cable, then", Do.DOCTOR())
            yield FindingCode.CORRUPT_READINGS(fix, corrupt=corrupt)


def _at_rest(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    identity = sensor.identity
    if note := imu_kind(context.config.imu.model).note:
        yield FindingCode.IMU_NOTE(note=note)
    context.identities["imu"] = asdict(identity)
    yield from _rest(context, sensor, _samples(context, sensor))
    yield from _gravity(context, sensor)


def _samples(context: DoctorContext, sensor: Imu) -> ImuSamples:
    """Return ``SECONDS`` of samples, without older ones."""
    sensor.read_samples()
    taken = []
    drain_s = min(DRAIN_S, DRAIN_SAMPLES / sensor.rate_hz)
    for _ in range(round(SECONDS / drain_s)):
        context.computer.clock.sleep(drain_s)
        taken.append(sensor.read_samples())
    return ImuSamples(
        np.concatenate([part.time_ns for part in taken]),
        np.concatenate([part.gyro_dps for part in taken]),
        sum(part.lost for part in taken),
    )


def _rest(context: DoctorContext, sensor: Imu, samples: ImuSamples) -> Iterator[Finding]:
    axis = "xyz".index(context.config.imu.axis)
    wanted = SECONDS * sensor.rate_hz
    if len(samples.time_ns) < 0.8 * wanted:
        counts = {"samples": len(samples.time_ns), "seconds": SECONDS, "wanted": wanted, "lost": samples.lost}
        yield FindingCode.SAMPLES_MISSING(**counts)
        return
    rates = samples.gyro_dps
    spread = rates.std(axis=0)
    bias = float(rates[:, axis].mean())
    expected = sensor.identity.gyro_noise_dps_rthz * np.sqrt(sensor.rate_hz / 2)
    evidence: dict[str, Any] = {"noise_dps": float(spread[axis]), "bias_dps": bias, "samples": len(rates)}
    if (np.abs(rates) >= sensor.range_dps * 0.999).any():
        yield FindingCode.SATURATED(range_dps=sensor.range_dps, **evidence)
    elif (rates == rates[0]).all():
        yield FindingCode.IMU_FROZEN(**evidence)
    elif spread.max() > NO_REST_DPS:
        yield FindingCode.NOT_AT_REST(**evidence)
    elif spread.max() > NOISY * expected:
        yield FindingCode.NOISY(expected_dps=expected, **evidence)
    elif abs(bias) > MAX_BIAS_DPS:
        yield FindingCode.LARGE_BIAS(**evidence)
    else:
        yield FindingCode.AT_REST(**evidence)


def _gravity(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    gravity = sensor.read_gravity_g()
    size = float(np.linalg.norm(gravity))
    axis = context.config.imu.axis
    along = float(gravity["xyz".index(axis)])
    evidence: dict[str, Any] = {"gravity_g": [round(float(g), 4) for g in gravity], "size_g": size, "axis": axis}
    if not 0.8 < size < 1.2:
        yield FindingCode.WRONG_GRAVITY(**evidence)
    elif abs(along) < UPRIGHT * size:
        upright = "xyz"[int(np.abs(gravity).argmax())]
        fix = Do.SET_KEY(key="imu.axis", value=upright) if upright != axis else "Mount the sensor flat on the platter"
        yield FindingCode.TILTED(fix, along=along / size, **evidence)
    else:
        yield FindingCode.GRAVITY(along=abs(along / size), **evidence)


def _wrong(context: DoctorContext, config: ImuConfig, here: FoundImu | None, there: list[FoundImu]) -> Finding:
    bus = context.computer.i2c_name(config.bus)
    if here is not None and (problem := unusable_address(here)) is not None:
        return problem
    if here is not None and here.driver is None:
        return FindingCode.NO_DRIVER(use_another_imu(), found=here, address=here.address)
    if here is not None:
        fix: SomeSteps = Do.SET_KEY(key="imu.model", value=here.driver)
        return FindingCode.OTHER_IMU(fix, found=here, address=here.address, model=config.model)
    usable = [found for found in there if found.driver]
    fix = ("Check the sensor's 3.3 V, ground, SDA and SCL, then", Do.FIND())
    if usable:
        fix = Do.SET_KEY(key="imu.address", value=f"{usable[0].address:#04x}")
    return FindingCode.NO_IMU(fix, address=config.address, bus=bus, found=usable)
