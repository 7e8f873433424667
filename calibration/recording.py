"""Record the readings of servo and IMU while a procedure moves the table."""

from copy import copy
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.devices.imu import Imu, ImuSamples
from rig.devices.servo import Servo, ServoState


@dataclass(slots=True)
class Recording:
    """All readings, in order."""

    states: list[ServoState] = field(default_factory=list)
    samples: list[ImuSamples] = field(default_factory=list)

    def clear(self) -> None:
        self.states.clear()
        self.samples.clear()

    def gyro(self) -> tuple[NDArray[np.int64], NDArray[np.float64], int]:
        """Return the samples' times (n,), the rates (n, 3) in °/s, and the number of lost samples."""
        if not self.samples:
            return np.empty(0, np.int64), np.empty((0, 3)), 0
        return (
            np.concatenate([part.time_ns for part in self.samples]),
            np.concatenate([part.gyro_dps for part in self.samples]),
            sum(part.lost for part in self.samples),
        )


class _Tapped:
    """A device that records the values of one of its readings."""

    def __init__(self, device: Any, reading: str, kept: list[Any]) -> None:
        self._device, self._reading, self._kept = device, reading, kept

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._device, name)
        if name != self._reading:
            return attribute

        def read() -> Any:
            value = attribute()
            self._kept.append(value)
            return value

        return read


def recording(bench: Bench) -> tuple[Bench, Recording]:
    """Return a bench on the same devices, for a `Turntable`, and what it reads from servo and IMU."""
    kept, recorded = Recording(), copy(bench)
    recorded.servo = cast(Servo, _Tapped(bench.servo, "read_state", kept.states))
    recorded.imu = cast(Imu, _Tapped(bench.imu, "read_samples", kept.samples))
    return recorded, kept
