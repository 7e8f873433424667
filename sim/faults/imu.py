"""What goes wrong with the gyro on the platter, and on its I2C bus."""

from collections.abc import Callable, Mapping

import numpy as np

from sim.faults.kind import End, Parameter, kind, repeatedly, share
from sim.imu.mpu6050 import Words
from sim.parts import SimParts

Values = Mapping[str, float]


def _distort(parts: SimParts, change: Callable[[Words], Words]) -> End:
    parts.imu.distortions.append(change)
    return lambda: parts.imu.distortions.remove(change)


@kind("imu.off", "The gyro is off the bus: a pulled plug; put in again, it has forgotten its settings.")
def _off(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    address = parts.imu.address
    device = parts.i2c.detach(address)

    def restore() -> None:
        parts.imu.power_cycle()
        parts.i2c.attach(address, device)

    return restore


@kind("imu.stuck", "The gyro delivers the same sample for ever.")
def _stuck(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    kept: list[Words] = []

    def hold(words: Words) -> Words:
        kept.append(words[:1])
        return np.repeat(kept[0], len(words), axis=0)

    return _distort(parts, hold)


@kind("imu.garbage", "The gyro delivers random samples.")
def _garbage(parts: SimParts, _values: Values, rng: np.random.Generator) -> End:
    return _distort(parts, lambda words: rng.integers(-32768, 32768, words.shape).astype(">i2"))


@kind("imu.wrong", "The gyro's scale is wrong.", factor=Parameter(1.3, "its gain against the true one", 0, 10))
def _wrong(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    inertial = parts.imu.inertial
    inertial.gyro_gain = inertial.gyro_gain * values["factor"]
    return lambda: setattr(inertial, "gyro_gain", inertial.gyro_gain / values["factor"])


@kind("imu.slow", "The gyro's clock runs slow: it takes fewer samples.", factor=Parameter(0.5, "its rate", 0.01, 1))
def _slow(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.imu.run_clock(values["factor"] - 1)
    return lambda: parts.imu.run_clock(0.0)


@kind("imu.delayed", "The gyro's samples are old.", seconds=Parameter(0.3, "how old, s", 0, 10))
def _delayed(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    waiting: list[Words] = []

    def delay(words: Words) -> Words:
        if not waiting:
            held = round(values["seconds"] * parts.imu.rate_hz)
            waiting.append(np.resize(words, (held, words.shape[1])))  # what was before, again
        line = np.concatenate([waiting[0], words])
        waiting[0] = line[len(words) :]
        return line[: len(words)]

    return _distort(parts, delay)


@kind(
    "imu.intermittent",
    "A loose contact: the gyro loses its supply again and again, and with it its settings.",
    period=Parameter(2.0, "from one loss to the next, s", 0.01, 1000),
)
def _intermittent(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    return repeatedly(parts.world.clock, values["period"], parts.imu.power_cycle)


@kind("i2c_nack", "The gyro does not acknowledge now and then: a long cable.", rate=share(0.02, "the transfers"))
def _nack(parts: SimParts, values: Values, rng: np.random.Generator) -> End:
    def refuses(_address: int) -> bool:
        return bool(rng.random() < values["rate"])

    parts.i2c.refusals.append(refuses)
    return lambda: parts.i2c.refusals.remove(refuses)


@kind("i2c_stuck", "A wire of the I2C bus is held low: nothing goes through.")
def _i2c_stuck(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.i2c.stuck = True
    return lambda: setattr(parts.i2c, "stuck", False)


@kind("imu_saturated", "The gyro's rate is at the end of its range.")
def _saturated(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    def clip(words: Words) -> Words:
        words[:, 4:] = 32767
        return words

    return _distort(parts, clip)
