"""Fits of recordings of real devices and of the simulator, side by side.

    python -m tests.recordings.fits

fits the recordings and the simulator, and writes `fits.json` and the table of
`docs/explanation/simulator-against-recordings.md`. The recordings are not part of the project: only numbers derived
from them are.
"""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rig.config import load_config
from sim.devices import SimDevices
from sim.faults import Fault, Faults
from sim.imu.inertial import InertialModel
from sim.imu.mpu6050 import BANDWIDTH_HZ
from sim.noise import NoiseModel
from sim.servo import SimServo
from sim.servo.models import ServoModel
from sim.servo.motor import Motor
from sim.world import World
from tests.allan import allan

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "explanation" / "simulator-against-recordings.md"
FITS = Path(__file__).parent / "fits.json"
FILES = Path(os.environ.get("RIG_TEST_DATA", ROOT / ".." / "shared" / "data")) / "recordings"
GYRO = "sunsided/sensor-fusion, MPU-6050 at rest for 655 s"
STEP = "treydufrene/meiosis_dev, AX-12A, mean of three steps of 146°"
REST = "answers.ros.org 303081, mean of two goals"
SERVO = NoiseModel.none().with_values(servo_lag=1.0, servo_friction=0.0254, servo_friction_spread=0.2)

AX_DEG_PER_COUNT = 300.0 / 1023.0
# Only its motor is simulated: a recorded step shows that a controller with inertia overshoots as a real one.
AX_12A = ServoModel(
    name="ax_12a",
    firmware=24,
    initial={},
    ranges={},
    supply_v=12.0,
    no_load_dps=59.0 * 6.0,
    stall_error_deg=32 * AX_DEG_PER_COUNT,  # its Compliance Slope
    inertia_s=0.055,  # fitted to the recorded step
)

Floats = NDArray[np.float64]
Fit = dict[str, float]


@dataclass(frozen=True)
class Row:
    """A quantity of the table: its unit, where it was recorded, and how far the simulator may differ from it.

    ``limit`` is a share of the real value; None if the difference is only shown.
    """

    name: str
    unit: str
    source: str
    limit: float | None = 0.2


ROWS = (
    *(Row(f"gyro {axis}, white noise", "°/√s", GYRO) for axis in "xyz"),
    *(Row(f"gyro {axis}, Allan deviation at {tau}", "°/s", GYRO) for tau in ("1 s", "20 s") for axis in "xyz"),
    *(Row(f"accelerometer {axis}, standard deviation", "mg", GYRO, limit=None) for axis in "xyz"),
    *(Row(f"host times, {what} interval", "ms", GYRO) for what in ("median", "95 %", "longest")),
    Row("XL430, error at rest", "counts", REST),
    Row("XL430, lag at 90 °/s", "°", "calculated: e-manual, 5 PWM for each count, 885 at 61 rev/min"),
    Row("AX-12A, rise from 10 to 90 %", "ms", STEP),
    Row("AX-12A, overshoot", "%", STEP),
    Row("AX-12A, settled within a count", "ms", STEP),
)


def of_gyro(rate_dps: Floats, accel_g: Floats, host_s: Floats) -> Fit:
    """Return the quantities of a sensor at rest, from its samples and the times at which the host received them.

    The white noise is fitted to the Allan deviation from 0.08 s on, together with a floor: half the sampling rate has
    the disturbance of the mains.
    """
    period_s = float(host_s[-1] - host_s[0]) / (len(host_s) - 1)
    fit: Fit = {}
    for axis, rate, force in zip("xyz", rate_dps.T, accel_g.T, strict=True):
        tau, deviation, freedom = allan(rate, period_s)
        slow = tau > 0.07
        weight = np.sqrt(freedom[slow] / 2) / deviation[slow] ** 2
        model = np.column_stack([1 / tau[slow], np.ones(int(slow.sum()))])
        fit[f"gyro {axis}, white noise"] = (
            float(nnls(model * weight[:, None], deviation[slow] ** 2 * weight)[0][0]) ** 0.5
        )
        for seconds in (1, 20):
            at = np.exp(np.interp(np.log(seconds), np.log(tau), np.log(deviation)))
            fit[f"gyro {axis}, Allan deviation at {seconds} s"] = float(at)
        fit[f"accelerometer {axis}, standard deviation"] = 1e3 * float(force.std())
    intervals_ms = np.quantile(np.diff(host_s) * 1e3, [0.5, 0.95, 1.0])
    names = (f"host times, {what} interval" for what in ("median", "95 %", "longest"))
    return fit | dict(zip(names, intervals_ms.tolist(), strict=True))


def recorded_gyro(name: str = "set-2-unmoved-with-x-pointing-forward-10min") -> Fit:
    """Return the quantities of a recording."""
    with np.load(FILES / "gyro" / f"{name}.npz") as file:
        return of_gyro(*(file[key].astype(np.float64) for key in ("gyroscope", "accelerometer", "gyroscope_s")))


def simulated_gyro(seconds: float = 655.0) -> Fit:
    """Return the quantities of the simulator's MPU-6050 with its low-pass off, at 100 Hz, read in bursts."""
    world = World(seed=1)
    part = InertialModel(world, "imu-68")
    n, read = round(seconds * 100), []
    due_ns = np.arange(1, n + 1, dtype=np.int64) * 10_000_000
    for times_ns in np.array_split(due_ns, n // 100):
        ticks_ns = (times_ns[:, None] + np.arange(-79, 1) * 125_000).ravel()  # 8 kHz inside
        read.append(np.concatenate(part.sample(ticks_ns, 8000.0, BANDWIDTH_HZ[0]), axis=1)[79::80])
    rate_dps, accel_g = np.split(np.concatenate(read), 2, axis=1)
    warming = part.warmth_c(due_ns)[:, None] * part.gyro_slope_dps_c
    with SimDevices.connected(load_config(), world) as devices:
        Faults(devices).schedule(Fault.parse("imu.bursts"))
        host_ms = [0.0]
        for at_ns in due_ns.tolist():  # each sample takes 2 ms to arrive
            host_ms.append(max(devices.i2c.held(at_ns) * 1e-6, host_ms[-1] + 2))
    return of_gyro(np.rint((rate_dps - warming) * 131) / 131, accel_g, np.array(host_ms[1:]) / 1e3)


def of_step(time_ms: Floats, counts: Floats) -> Fit:
    """Return the quantities of an AX-12A's step upwards, which begins at its first change."""
    start = np.median(counts[:5])
    begun = int(np.argmax(counts > start + 2)) - 1
    time_ms = time_ms[begun:] - time_ms[begun]
    counts = counts[begun:][time_ms < 1200]
    time_ms = time_ms[time_ms < 1200]
    end = np.median(counts[time_ms > 900])
    share = (counts - start) / (end - start)
    top = int(share.argmax()) + 1
    low_ms, high_ms = np.interp([0.1, 0.9], share[:top], time_ms[:top])
    settled_ms = time_ms[int(np.flatnonzero(np.abs(counts - end) > 1)[-1]) + 1]
    values = float(high_ms - low_ms), 100 * float(share.max() - 1), float(settled_ms)
    return dict(zip((row.name for row in ROWS if row.source == STEP), values, strict=True))


def recorded_step() -> Fit:
    """Return the mean quantities of the recorded steps of AX-12A."""
    steps = []
    for path in sorted((FILES / "ax12").glob("AX12A_*.csv")):
        pairs = [line.split(",") for line in path.read_text().splitlines() if line[:1].isdigit()]
        time_ms, counts = np.array([pair for pair in pairs if len(pair) == 2], np.float64).T
        forward = np.append(True, np.diff(time_ms) > 0)
        steps.append(of_step(time_ms[forward], counts[forward]))
    return {name: float(np.mean([step[name] for step in steps])) for name in steps[0]}


def simulated_step() -> Fit:
    """Return the quantities of a simulated AX-12A's step."""
    clock = (world := World(noise=SERVO)).clock
    motor = Motor(world, AX_12A)
    motor.hold()
    motor.go_to(498 * AX_DEG_PER_COUNT, motor.fastest_dps, motor.steepest_dps2)
    counts = []
    for _ in range(100):
        counts.append(round(world.shaft()[0] / AX_DEG_PER_COUNT))
        clock.sleep(0.016)
    return of_step(np.arange(100) * 16.0, np.array(counts, np.float64))


def simulated_xl430() -> Fit:
    """Return lag and error at rest of simulated XL430 with factory gains: the mean of 20 parts."""
    found = []
    for seed in range(20):
        world = World(noise=SERVO, seed=seed)
        motor = SimServo(world).motor
        motor.hold()
        motor.go_to(180.0, 90.0, 240.0)
        world.clock.sleep(1.5)
        state = motor.state()
        world.clock.sleep(3.0)
        found.append(((180.0 - world.shaft()[0]) * 4096 / 360, state.target_deg - state.angle_deg))
    rest_counts, lag_deg = np.mean(found, axis=0).tolist()
    return {"XL430, error at rest": rest_counts, "XL430, lag at 90 °/s": lag_deg}


def stated_xl430() -> Fit:
    """Return what is known of a real XL430 without a recording: 1000 asked, 995 reached; 1450 and 1446."""
    return {"XL430, error at rest": 4.5, "XL430, lag at 90 °/s": 885 * 90 / 366 / 5 * 360 / 4096}


RECORDED: tuple[Callable[[], Fit], ...] = (recorded_gyro, recorded_step, stated_xl430)
SIMULATED: tuple[Callable[[], Fit], ...] = (simulated_gyro, simulated_step, simulated_xl430)


def fits() -> dict[str, Any]:
    """Return the stored fits: name to the real and the simulated value."""
    return dict(json.loads(FITS.read_text()))


def table() -> Iterator[str]:
    """Yield the lines of the page's table."""
    yield "| quantity | real | simulated | ratio | limit | source |"
    yield "|---|---|---|---|---|---|"
    stored = fits()
    for row in ROWS:
        real, simulated = stored[row.name]
        limit = "–" if row.limit is None else f"±{row.limit:.0%}".replace("%", " %")
        values = f"{real:.3g} {row.unit} | {simulated:.3g} {row.unit} | {simulated / real:.2f}"
        yield f"| {row.name} | {values} | {limit} | {row.source} |"


def main() -> None:
    real: Fit = {name: value for fit in RECORDED for name, value in fit().items()}
    simulated: Fit = {name: value for fit in SIMULATED for name, value in fit().items()}
    rounded = {row.name: [float(f"{fit[row.name]:.4g}") for fit in (real, simulated)] for row in ROWS}
    lines = (f" {json.dumps(name, ensure_ascii=False)}: {pair}" for name, pair in rounded.items())
    FITS.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    page = PAGE.read_text()
    before, _, rest = page.partition("| quantity |")
    after = rest[rest.index("\n\n") :]
    PAGE.write_text(before + "\n".join(table()) + after)


if __name__ == "__main__":
    main()
