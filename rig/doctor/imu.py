"""Check the IMU: its identity, and its readings at rest."""

from collections.abc import Iterator
from contextlib import closing
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
from rig.doctor.finding import Finding, FindingCode, bad, fine, of_error, warning
from rig.safety.gyro_rotation import DRAIN_SAMPLES

SECONDS, DRAIN_S = 1.5, 0.25
NOISY = 4.0  # multiple of the datasheet's noise that a quiet table does not exceed
NO_REST_DPS = 20.0
MAX_BIAS_DPS = 20.0  # zero-rate output of the MPU-6050's datasheet; more is a rotation, or a broken sensor
STRETCH_KHZ = 20.0
"""Highest frequency at which a controller that does not wait for a stretched clock reads a BNO055 correctly."""
_SLOWER = "echo dtparam=i2c_arm_baudrate=10000 | sudo tee -a /boot/firmware/config.txt && sudo reboot"
UPRIGHT = 0.94  # share of gravity along the table's axis when the sensor lies within 20° of it


def imu(context: DoctorContext) -> Iterator[Finding]:
    """Identify the sensor, then check its noise, its zero, and its orientation."""
    if context.holder is not None:
        yield warning("imu", FindingCode.NOT_CHECKED, Do.STOP())
        return
    config, clock = context.config, context.computer.clock
    # The sensor of a rig head is not on a bus of this computer.
    if config.imu.connection == "head":
        head = open_head(config, lambda: context.computer.open_serial(config.head.port, BAUD), clock)
        with closing(head):
            who = head.identity
            parts = {"model": who.model, "board": who.board, "firmware": who.firmware, "serial": who.serial}
            yield fine("imu", FindingCode.HEAD, port=config.head.port, **parts)
            if (fault := head.fault) is not None:
                yield of_error("imu", fault, Do.ACKNOWLEDGE())
            yield from _at_rest(context, head)
        return
    # A Raspberry Pi's controller corrupts bytes of a sensor that stretches the clock: warn before the cause is in
    # doubt.
    khz = context.computer.cannot_stretch_khz(config.imu.bus)
    if config.imu.model == "bno055" and khz is not None and khz > STRETCH_KHZ:
        bus = context.computer.i2c_name(config.imu.bus)
        yield warning("imu", FindingCode.CLOCK_STRETCHING, _SLOWER, bus=bus, khz=khz)
    try:
        there = scan_imus(context.computer, config.imu.bus)
    except OSError as error:
        yield _bus_failed(context, error)
        return
    here = next((found for found in there if found.address == config.imu.address), None)
    if here is None or here.driver != config.imu.model:
        yield _wrong(context, config.imu, here, there)
        return
    with closing(open_imu(config.imu, context.computer.i2c_path(config.imu.bus), clock)) as sensor:
        bus, identity = context.computer.i2c_name(config.imu.bus), sensor.identity
        parts = {"model": identity.model, "address": identity.bus_address, "who_am_i": identity.who_am_i}
        yield fine("imu", FindingCode.IMU, bus=bus, **parts)
        # The sensor works: now its samples and its bus.
        yield from _at_rest(context, sensor)
        corrupt = getattr(getattr(sensor, "statistics", None), "corrupt", 0)
        if corrupt:
            fix = SLOW_BUS if config.imu.model == "bno055" else ("Shorten the I2C cable, then", Do.DOCTOR())
            yield warning("imu", FindingCode.CORRUPT_READINGS, fix, corrupt=corrupt)


def _at_rest(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    identity = sensor.identity
    if note := imu_kind(context.config.imu.model).note:
        yield fine("imu", FindingCode.IMU_NOTE, note=note)
    context.identities["imu"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
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
        fix: SomeSteps = (
            "Shorten the I2C cable and remove other devices from the bus, then",
            Do.DOCTOR(),
        )
        counts = {"samples": len(samples.time_ns), "seconds": SECONDS, "wanted": wanted, "lost": samples.lost}
        yield bad("imu", FindingCode.SAMPLES_MISSING, fix, **counts)
        return
    rates = samples.gyro_dps
    spread = rates.std(axis=0)
    bias = float(rates[:, axis].mean())
    expected = sensor.identity.gyro_noise_dps_rthz * np.sqrt(sensor.rate_hz / 2)
    evidence: dict[str, Any] = {"noise_dps": float(spread[axis]), "bias_dps": bias, "samples": len(rates)}
    if (np.abs(rates) >= sensor.range_dps * 0.999).any():
        fix = ("Check the sensor's supply and cable, then", Do.DOCTOR())
        yield bad("imu", FindingCode.SATURATED, fix, range_dps=sensor.range_dps, **evidence)
    elif (rates == rates[0]).all():
        fix = ("Switch the sensor's supply off and on, then", Do.DOCTOR())
        yield bad("imu", FindingCode.IMU_FROZEN, fix, **evidence)
    elif spread.max() > NO_REST_DPS:
        fix = ("Check the sensor's supply, ground and cable, then", Do.DOCTOR())
        yield bad("imu", FindingCode.NOT_AT_REST, fix, **evidence)
    elif spread.max() > NOISY * expected:
        fix = ("Keep hands and vibration away from the bench, then", Do.DOCTOR())
        yield warning("imu", FindingCode.NOISY, fix, expected_dps=expected, **evidence)
    elif abs(bias) > MAX_BIAS_DPS:
        yield bad("imu", FindingCode.LARGE_BIAS, "Replace the sensor", **evidence)
    else:
        yield fine("imu", FindingCode.AT_REST, **evidence)


def _gravity(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    gravity = sensor.read_gravity_g()
    size = float(np.linalg.norm(gravity))
    axis = context.config.imu.axis
    along = float(gravity["xyz".index(axis)])
    evidence: dict[str, Any] = {"gravity_g": [round(float(g), 4) for g in gravity], "size_g": size, "axis": axis}
    if not 0.8 < size < 1.2:
        fix: SomeSteps = ("Check the sensor's supply, then", Do.DOCTOR())
        yield bad("imu", FindingCode.WRONG_GRAVITY, fix, **evidence)
    elif abs(along) < UPRIGHT * size:
        upright = "xyz"[int(np.abs(gravity).argmax())]
        fix = Do.SET_KEY(key="imu.axis", value=upright) if upright != axis else "Mount the sensor flat on the platter"
        yield warning("imu", FindingCode.TILTED, fix, along=along / size, **evidence)
    else:
        yield fine("imu", FindingCode.GRAVITY, along=abs(along / size), **evidence)


def _wrong(context: DoctorContext, config: ImuConfig, here: FoundImu | None, there: list[FoundImu]) -> Finding:
    bus = context.computer.i2c_name(config.bus)
    if here is not None and (problem := unusable_address(here)) is not None:
        return problem
    if here is not None and here.driver is None:
        return bad("imu", FindingCode.NO_DRIVER, use_another_imu(), found=here, address=here.address)
    if here is not None:
        fix: SomeSteps = Do.SET_KEY(key="imu.model", value=here.driver)
        return bad("imu", FindingCode.OTHER_IMU, fix, found=here, address=here.address, model=config.model)
    usable = [found for found in there if found.driver]
    fix = ("Check the sensor's 3.3 V, ground, SDA and SCL, then", Do.FIND())
    if usable:
        fix = Do.SET_KEY(key="imu.address", value=f"{usable[0].address:#04x}")
    return bad("imu", FindingCode.NO_IMU, fix, address=config.address, bus=bus, found=usable)


def _bus_failed(context: DoctorContext, error: OSError) -> Finding:
    bus = context.computer.i2c_name(context.config.imu.bus)
    return bad("imu", FindingCode.I2C_NOT_OPENED, Do.FIND(), bus=bus, reason=error.strerror)
