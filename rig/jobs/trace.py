"""Record a trace of the devices of a bench in a short, prescribed sequence."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.core.clock import Clock, seconds_between
from rig.core.errors import MotionStopped, RigError, UsageError
from rig.core.next_steps import Do
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.imu import ImuIdentity, ImuSamples
from rig.devices.trace import Device, camera_notes, imu_notes
from rig.jobs.desk import Desk, JobResult, Remark, Steps
from rig.motion.turntable import Flight, Turntable
from rig.plans.steps import announced, moved

STEPS_DEG: Final = (10.0, 45.0, 0.0)
"""The stops of the prescribed motions, from the present angle; then it is interrupted on the way to the farthest."""
REACH_DEG: Final = max(STEPS_DEG)
_STOP_AFTER_S: Final = 0.4
_RATE_HZ: Final = 200.0


def record(desk: Desk, *, still: bool = False, adapter: Mapping[str, Any] | None = None) -> Steps[None]:
    """Read everything that the devices of a bench report, and rotate the table a little; ``config.trace`` records it.

    With ``still``, nothing moves. A sensor that is missing or broken is left out. ``adapter`` are facts about the
    adapter of the servo.
    """
    if desk.config.trace is None:
        raise UsageError("The trace has no file.", next_step=Do.RECORD_TRACE())
    with desk.open_bench(()) as bench:
        trace = bench.trace
        assert trace is not None  # the bench records with this configuration
        trace.note("servo", notes={"identity": asdict(bench.servo.identity), "adapter": adapter})
        if isinstance(bench.servo, DynamixelServo):
            bench.servo.read_table()
        sensors: dict[Device, Callable[[], dict[str, Any]]] = {
            "imu": lambda: imu_notes(bench.imu, bench.clock),
            "camera": lambda: camera_notes(bench.camera),
        }
        for sensor, read in sensors.items():
            try:
                trace.note(sensor, notes=read())
            except RigError as error:
                yield Remark(f"The trace has no {sensor}. {error.what}")
                if sensor == "imu":
                    bench.imu = _NoImu(bench.clock)
        if not still:
            yield from _rotate(bench)
    text = f"Recorded {desk.config.trace}. Look through it before you send it."
    yield JobResult({"trace": str(desk.config.trace), "still": still}, text)


def _rotate(bench: Bench) -> Steps[None]:
    """Rotate the table a little, interrupt one motion, and come back."""
    with Turntable(bench, trust_gyro=not isinstance(bench.imu, _NoImu)) as table:
        start_deg = table.return_deg
        side = 1.0 if start_deg + REACH_DEG <= table.limits_deg[1] else -1.0
        for number, step_deg in enumerate(STEPS_DEG):
            yield moved(number, (yield from announced(number, table, start_deg + side * step_deg)))
        _interrupt(bench, table, start_deg + side * REACH_DEG)
    with Turntable(bench, trust_gyro=not isinstance(bench.imu, _NoImu)) as table:
        yield moved(len(STEPS_DEG), table.goto(start_deg))
        table.approach(start_deg)


def _interrupt(bench: Bench, table: Turntable, target_deg: float) -> None:
    """Begin a rotation, and stop it on its way."""
    clock, begun_ns = bench.clock, bench.clock.now_ns()
    planned = MotionStopped("The trace stops this motion.", next_step=Do.RUN_AGAIN())

    def wait() -> None:
        clock.sleep(bench.config.table.poll_s)
        if seconds_between(begun_ns, clock.now_ns()) > _STOP_AFTER_S:
            raise planned

    flight = Flight(wait, (target_deg, target_deg), table.recorder(), bench.config.table.velocity_dps)
    try:
        table.fly(target_deg, flight)
    except MotionStopped as stop:
        if stop is not planned:
            raise


class _NoImu:
    """The place of a missing IMU: it reports rest, so that the encoder alone decides when the table has arrived."""

    identity = ImuIdentity("none", 0, 0, 0.0)
    rate_hz, range_dps = _RATE_HZ, 2000.0

    def __init__(self, clock: Clock) -> None:
        self._clock, self._read_ns = clock, clock.now_ns()

    def read_samples(self) -> ImuSamples:
        period_ns = round(1e9 / _RATE_HZ)
        count = (self._clock.now_ns() - self._read_ns) // period_ns
        times = self._read_ns + period_ns * np.arange(1, count + 1, dtype=np.int64)
        self._read_ns += count * period_ns
        return ImuSamples(times, np.zeros((count, 3)))

    def read_gravity_g(self) -> NDArray[np.float64]:
        return np.array([0.0, 0.0, 1.0])

    def temperature_c(self) -> float:
        return 20.0

    def close(self) -> None: ...
