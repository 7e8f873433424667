"""Simulated faults of the gyro on the platter and of its I2C bus."""

import numpy as np

from rig.devices.i2c import DESIGNWARE
from sim.devices import SimDevices
from sim.faults.kind import End, Parameter, Rng, added, repeatedly, share, simulated_fault, switched
from sim.i2c import SimI2cBus
from sim.imu.inertial import Words


@simulated_fault("imu.off", "The gyro is unplugged. After it is plugged in, its settings are lost.")
def _off(devices: SimDevices, _rng: Rng) -> End:
    address = devices.imu.address
    device = devices.i2c.detach(address)

    def restore() -> None:
        devices.imu.power_cycle()
        devices.i2c.attach(address, device)

    return restore


@simulated_fault("imu.stuck", "The gyro repeats one sample.")
def _stuck(devices: SimDevices, _rng: Rng) -> End:
    samples: list[Words] = []

    def hold(words: Words) -> Words:
        samples.append(words[:1])
        return np.repeat(samples[0], len(words), axis=0)

    return added(devices.imu.distortions, hold)


simulated_fault("imu.garbage", "The gyro delivers random samples.")(
    lambda devices, rng: added(
        devices.imu.distortions, lambda words: rng.integers(-32768, 32768, words.shape).astype(">i2")
    )
)


@simulated_fault(
    "imu.wrong", "The gyro's scale is wrong.", factor=Parameter(1.3, "gain divided by the true gain", 0, 10)
)
def _wrong(devices: SimDevices, _rng: Rng, factor: float) -> End:
    inertial = devices.imu.inertial
    inertial.gyro_gain = inertial.gyro_gain * factor
    return lambda: setattr(inertial, "gyro_gain", inertial.gyro_gain / factor)


@simulated_fault(
    "imu.slow",
    "The gyro's clock is slow, so it takes fewer samples.",
    factor=Parameter(0.5, "rate divided by the true rate", 0.01, 1),
)
def _slow(devices: SimDevices, _rng: Rng, factor: float) -> End:
    devices.imu.run_clock(factor - 1)
    return lambda: devices.imu.run_clock(0.0)


@simulated_fault("imu.delayed", "The gyro's samples arrive late.", seconds=Parameter(0.3, "delay, s", 0, 10))
def _delayed(devices: SimDevices, _rng: Rng, seconds: float) -> End:
    waiting: list[Words] = []

    def delay(words: Words) -> Words:
        if not waiting:
            count = round(seconds * devices.imu.rate_hz)
            waiting.append(np.resize(words, (count, words.shape[1])))  # the first samples are repeated
        queue = np.concatenate([waiting[0], words])
        waiting[0] = queue[len(words) :]
        return queue[: len(words)]

    return added(devices.imu.distortions, delay)


simulated_fault(
    "imu.intermittent",
    "A contact is loose. The gyro loses its supply and its settings again and again.",
    period=Parameter(2.0, "time between losses, s", 0.01, 1000),
)(lambda devices, _, period: repeatedly(devices.world.clock, period, devices.imu.power_cycle))


@simulated_fault(
    "imu.bursts",
    "The computer is busy, so the gyro's samples reach it in bursts.",
    longest=Parameter(0.5, "longest pause, s: one of 1000", 0.065, 10),
)
def _bursts(devices: SimDevices, rng: Rng, longest: float) -> End:
    """Let the computer pause as it did in a recording (docs/explanation/simulator-against-recordings.md)."""
    awake = [0, 0]  # it is busy before, and again from then on

    def held(time_ns: int) -> int:
        while time_ns >= awake[1]:
            pause_s = longest if rng.random() < 0.001 else rng.uniform(0.005, 0.065)
            begins = (awake[1] or time_ns) + round(pause_s * 1e9)
            awake[:] = begins, begins + 5_000_000
        return max(time_ns, awake[0])

    return switched(devices.i2c, "held", held, int)


simulated_fault("i2c_nack", "The cable is long. Some transfers are not acknowledged.", rate=share(0.02, "transfers"))(
    lambda devices, rng, rate: added(devices.i2c.nack_conditions, lambda _: bool(rng.random() < rate))
)
simulated_fault("i2c_stuck", "A wire of the I2C bus is held low. No transfer is possible.")(
    lambda devices, _: switched(devices.i2c, "stuck", True, False)
)


@simulated_fault("i2c_hang", "The computer's I2C controller hangs, as that of a Raspberry Pi 5 can. No transfer ends.")
def _i2c_hang(devices: SimDevices, _rng: Rng) -> End | None:
    bus = devices.i2c
    if not isinstance(bus, SimI2cBus):  # a rig head has its own controller
        return None
    name, bus.name, bus.stuck = bus.name, DESIGNWARE, True

    def restore() -> None:
        bus.name, bus.stuck = name, False

    return restore


@simulated_fault("imu_saturated", "The gyro reports the maximum of its range.")
def _saturated(devices: SimDevices, _rng: Rng) -> End:
    def clip(words: Words) -> Words:
        words[:, 4:] = 32767
        return words

    return added(devices.imu.distortions, clip)
