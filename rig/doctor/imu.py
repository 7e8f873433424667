"""The IMU: who answers, and what it reads while nothing moves."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np

from rig.config import ImuConfig
from rig.devices.head.opening import open_head
from rig.devices.head.protocol import BAUD
from rig.devices.imu import Imu, ImuSamples
from rig.devices.open_imu import open_imu
from rig.doctor.case import Case
from rig.doctor.finding import Finding, bad, fine, of_error, warning
from rig.doctor.scan import FoundImu, scan_imus

SECONDS, DRAIN_S = 1.5, 0.25
NOISY = 4.0
"""How many times the datasheet's noise is more than a quiet table shows."""
NO_REST_DPS = 20.0
MAX_BIAS_DPS = 20.0
"""Zero-rate output of the MPU-6050's datasheet; more is a rotation, or a broken sensor."""
UPRIGHT = 0.94
"""Share of gravity along the table's axis when the sensor lies within 20° of it."""


def imu(case: Case) -> Iterator[Finding]:
    """Identify the sensor, then look at its noise, its zero, and which way is up for it."""
    if case.holder is not None:
        yield warning("imu", "not asked: opening it would spoil the measurement that is running", case.rig("stop"))
        return
    config, clock = case.config, case.computer.clock
    if config.imu.connection == "head":
        head = open_head(config, lambda: case.computer.open_serial(config.head.port, BAUD), clock)
        with closing(head):
            who = head.identity
            text = f"{who.model} on a rig head ({who.board}, firmware {who.firmware}) at {config.head.port}"
            yield fine("imu", text, serial=who.serial)
            if (fault := head.fault) is not None:
                yield of_error("imu", fault, case.rig("acknowledge"))
            yield from _at_rest(case, head)
        return
    try:
        there = scan_imus(case.computer, config.imu.bus)
    except OSError as error:
        yield _bus_failed(case, error)
        return
    here = next((found for found in there if found.address == config.imu.address), None)
    if here is None or here.driver is None:
        yield _wrong(case, config.imu, here, there)
        return
    with closing(open_imu(config.imu, case.computer.i2c_path(config.imu.bus), clock)) as sensor:
        bus, identity = case.computer.i2c_name(config.imu.bus), sensor.identity
        text = f"{identity.model} at {identity.bus_address:#04x} of {bus} (identity {identity.who_am_i:#04x})"
        yield fine("imu", text)
        yield from _at_rest(case, sensor)


def _at_rest(case: Case, sensor: Imu) -> Iterator[Finding]:
    identity = sensor.identity
    case.identities["imu"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
    yield from _rest(case, sensor, _samples(case, sensor))
    yield from _gravity(case, sensor)


def _samples(case: Case, sensor: Imu) -> ImuSamples:
    """Collect ``SECONDS`` of samples, what is old thrown away first."""
    sensor.read_samples()
    taken = []
    for _ in range(round(SECONDS / DRAIN_S)):
        case.computer.clock.sleep(DRAIN_S)
        taken.append(sensor.read_samples())
    return ImuSamples(
        np.concatenate([part.time_ns for part in taken]),
        np.concatenate([part.gyro_dps for part in taken]),
        sum(part.lost for part in taken),
    )


def _rest(case: Case, sensor: Imu, samples: ImuSamples) -> Iterator[Finding]:
    axis = "xyz".index(case.config.imu.axis)
    wanted = SECONDS * sensor.rate_hz
    if len(samples.time_ns) < 0.8 * wanted:
        text = f"{len(samples.time_ns)} samples in {SECONDS:g} s instead of {wanted:.0f}, {samples.lost} lost"
        yield bad("imu", text, "Shorten the I2C cable, take other devices off the bus, then: " + case.rig("doctor"))
        return
    rates = samples.gyro_dps
    spread = rates.std(axis=0)
    bias = float(rates[:, axis].mean())
    expected = sensor.identity.gyro_noise_dps_rthz * np.sqrt(sensor.rate_hz / 2)
    text = f"at rest: noise {spread[axis]:.3f} °/s, zero at {bias:+.2f} °/s"
    evidence: dict[str, Any] = {"noise_dps": float(spread[axis]), "bias_dps": bias, "samples": len(rates)}
    if (np.abs(rates) >= sensor.range_dps * 0.999).any():
        mend = "Check the sensor's supply and cable, then: " + case.rig("doctor")
        yield bad("imu", f"saturated at {sensor.range_dps:.0f} °/s although nothing moves", mend, **evidence)
    elif (rates == rates[0]).all():
        mend = "Switch the sensor's supply off and on, then: " + case.rig("doctor")
        yield bad("imu", "frozen: every sample is the same, not even noise", mend, **evidence)
    elif spread.max() > NO_REST_DPS:
        mend = "Check the sensor's supply, ground and cable, then: " + case.rig("doctor")
        yield bad("imu", f"{text}: no table at rest shakes so, and no motor runs", mend, **evidence)
    elif spread.max() > NOISY * expected:
        mend = "Keep hands and vibration off the bench, then: " + case.rig("doctor")
        yield warning("imu", f"{text}: restless, {expected:.3f} °/s is usual", mend, **evidence)
    elif abs(bias) > MAX_BIAS_DPS:
        yield bad("imu", f"{text}: no sensor of its kind is as far off", "Replace the sensor", **evidence)
    else:
        yield fine("imu", text, **evidence)


def _gravity(case: Case, sensor: Imu) -> Iterator[Finding]:
    gravity = sensor.read_gravity_g()
    size = float(np.linalg.norm(gravity))
    axis = case.config.imu.axis
    along = float(gravity["xyz".index(axis)])
    evidence: dict[str, Any] = {"gravity_g": [round(float(g), 4) for g in gravity]}
    if not 0.8 < size < 1.2:
        mend = "Check the sensor's supply, then: " + case.rig("doctor")
        yield bad("imu", f"gravity is {size:.2f} g", mend, **evidence)
    elif abs(along) < UPRIGHT * size:
        upright = "xyz"[int(np.abs(gravity).argmax())]
        text = f"its {axis} axis does not point along the table's axis: {along / size:+.2f} of gravity is along it"
        mend = case.set("imu.axis", upright) if upright != axis else "Mount the sensor flat on the platter"
        yield warning("imu", text, mend, **evidence)
    else:
        yield fine("imu", f"gravity {size:.2f} g, {abs(along / size):.0%} of it along {axis}", **evidence)


def _wrong(case: Case, config: ImuConfig, here: FoundImu | None, there: list[FoundImu]) -> Finding:
    bus = case.computer.i2c_name(config.bus)
    if here is not None:
        mend = "Check its wiring; the rig drives MPU-6050 and BNO055"
        return bad("imu", f"{here}: the rig has no driver for it", mend, address=here.address)
    usable = [found for found in there if found.driver]
    text = f"nobody answers at {config.address:#04x} of {bus}"
    if usable:
        return bad("imu", f"{text}; there is {usable[0]}", case.set("imu.address", f"{usable[0].address:#04x}"))
    mend = "Check the sensor's 3.3 V, ground, SDA and SCL, then: " + case.rig("find")
    return bad("imu", f"{text}, nor at any other address of an IMU", mend)


def _bus_failed(case: Case, error: OSError) -> Finding:
    bus = case.computer.i2c_name(case.config.imu.bus)
    if isinstance(error, FileNotFoundError | PermissionError):
        return bad("imu", f"{bus} cannot be opened: {error.strerror}", case.rig("find"))
    mend = "Take the sensor's supply off and on; check SDA and SCL for a short"
    return bad("imu", f"{bus} does not move: {error.strerror}; a device holds the bus", mend, errno=error.errno)
