"""Check the IMU: its identity, and its readings at rest."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np

from rig.config import ImuConfig
from rig.devices.head.opening import open_head
from rig.devices.head.protocol import BAUD
from rig.devices.imu import Imu, ImuSamples
from rig.devices.open_imu import open_imu
from rig.doctor.bus_scan import FoundImu, scan_imus
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, bad, fine, of_error, warning

SECONDS, DRAIN_S = 1.5, 0.25
NOISY = 4.0  # multiple of the datasheet's noise that a quiet table does not exceed
NO_REST_DPS = 20.0
MAX_BIAS_DPS = 20.0  # zero-rate output of the MPU-6050's datasheet; more is a rotation, or a broken sensor
UPRIGHT = 0.94  # share of gravity along the table's axis when the sensor lies within 20° of it


def imu(context: DoctorContext) -> Iterator[Finding]:
    """Identify the sensor, then check its noise, its zero, and its orientation."""
    if context.holder is not None:
        yield warning("imu", "not checked: opening it would disturb the running measurement", context.rig("stop"))
        return
    config, clock = context.config, context.computer.clock
    if config.imu.connection == "head":
        head = open_head(config, lambda: context.computer.open_serial(config.head.port, BAUD), clock)
        with closing(head):
            who = head.identity
            text = f"{who.model} on a rig head ({who.board}, firmware {who.firmware}) at {config.head.port}"
            yield fine("imu", text, serial=who.serial)
            if (fault := head.fault) is not None:
                yield of_error("imu", fault, context.rig("acknowledge"))
            yield from _at_rest(context, head)
        return
    try:
        there = scan_imus(context.computer, config.imu.bus)
    except OSError as error:
        yield _bus_failed(context, error)
        return
    here = next((found for found in there if found.address == config.imu.address), None)
    if here is None or here.driver is None:
        yield _wrong(context, config.imu, here, there)
        return
    with closing(open_imu(config.imu, context.computer.i2c_path(config.imu.bus), clock)) as sensor:
        bus, identity = context.computer.i2c_name(config.imu.bus), sensor.identity
        text = f"{identity.model} at {identity.bus_address:#04x} of {bus} (identity {identity.who_am_i:#04x})"
        yield fine("imu", text)
        yield from _at_rest(context, sensor)


def _at_rest(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    identity = sensor.identity
    context.identities["imu"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
    yield from _rest(context, sensor, _samples(context, sensor))
    yield from _gravity(context, sensor)


def _samples(context: DoctorContext, sensor: Imu) -> ImuSamples:
    """Return ``SECONDS`` of samples, without older ones."""
    sensor.read_samples()
    taken = []
    for _ in range(round(SECONDS / DRAIN_S)):
        context.computer.clock.sleep(DRAIN_S)
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
        text = f"{len(samples.time_ns)} samples in {SECONDS:g} s instead of {wanted:.0f}, {samples.lost} lost"
        yield bad(
            "imu", text, "Shorten the I2C cable and remove other devices from the bus, then: " + context.rig("doctor")
        )
        return
    rates = samples.gyro_dps
    spread = rates.std(axis=0)
    bias = float(rates[:, axis].mean())
    expected = sensor.identity.gyro_noise_dps_rthz * np.sqrt(sensor.rate_hz / 2)
    text = f"at rest: noise {spread[axis]:.3f} °/s, zero at {bias:+.2f} °/s"
    evidence: dict[str, Any] = {"noise_dps": float(spread[axis]), "bias_dps": bias, "samples": len(rates)}
    if (np.abs(rates) >= sensor.range_dps * 0.999).any():
        fix = "Check the sensor's supply and cable, then: " + context.rig("doctor")
        yield bad("imu", f"saturated at {sensor.range_dps:.0f} °/s at rest", fix, **evidence)
    elif (rates == rates[0]).all():
        fix = "Switch the sensor's supply off and on, then: " + context.rig("doctor")
        yield bad("imu", "frozen: all samples are identical, without noise", fix, **evidence)
    elif spread.max() > NO_REST_DPS:
        fix = "Check the sensor's supply, ground and cable, then: " + context.rig("doctor")
        yield bad("imu", f"{text}: more than a table at rest shows", fix, **evidence)
    elif spread.max() > NOISY * expected:
        fix = "Keep hands and vibration away from the bench, then: " + context.rig("doctor")
        yield warning("imu", f"{text}: noisy, {expected:.3f} °/s is usual", fix, **evidence)
    elif abs(bias) > MAX_BIAS_DPS:
        yield bad("imu", f"{text}: outside the datasheet", "Replace the sensor", **evidence)
    else:
        yield fine("imu", text, **evidence)


def _gravity(context: DoctorContext, sensor: Imu) -> Iterator[Finding]:
    gravity = sensor.read_gravity_g()
    size = float(np.linalg.norm(gravity))
    axis = context.config.imu.axis
    along = float(gravity["xyz".index(axis)])
    evidence: dict[str, Any] = {"gravity_g": [round(float(g), 4) for g in gravity]}
    if not 0.8 < size < 1.2:
        fix = "Check the sensor's supply, then: " + context.rig("doctor")
        yield bad("imu", f"gravity is {size:.2f} g", fix, **evidence)
    elif abs(along) < UPRIGHT * size:
        upright = "xyz"[int(np.abs(gravity).argmax())]
        text = f"its {axis} axis does not point along the table's axis: {along / size:+.2f} of gravity is along it"
        fix = context.set("imu.axis", upright) if upright != axis else "Mount the sensor flat on the platter"
        yield warning("imu", text, fix, **evidence)
    else:
        yield fine("imu", f"gravity {size:.2f} g, {abs(along / size):.0%} of it along {axis}", **evidence)


def _wrong(context: DoctorContext, config: ImuConfig, here: FoundImu | None, there: list[FoundImu]) -> Finding:
    bus = context.computer.i2c_name(config.bus)
    if here is not None:
        fix = "Use an MPU-6050 or a BNO055, or check the wiring"
        return bad("imu", f"{here}: the rig has no driver for it", fix, address=here.address)
    usable = [found for found in there if found.driver]
    text = f"no device answers at {config.address:#04x} of {bus}"
    if usable:
        return bad("imu", f"{text}; there is {usable[0]}", context.set("imu.address", f"{usable[0].address:#04x}"))
    fix = "Check the sensor's 3.3 V, ground, SDA and SCL, then: " + context.rig("find")
    return bad("imu", f"{text}, nor at any other IMU address", fix)


def _bus_failed(context: DoctorContext, error: OSError) -> Finding:
    bus = context.computer.i2c_name(context.config.imu.bus)
    if isinstance(error, FileNotFoundError | PermissionError):
        return bad("imu", f"{bus} cannot be opened: {error.strerror}", context.rig("find"))
    fix = "Switch the sensor's supply off and on, and check SDA and SCL for a short circuit"
    return bad("imu", f"{bus} is stuck: {error.strerror}; a device blocks the bus", fix, errno=error.errno)
