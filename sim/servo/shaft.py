"""The shaft that a servo rotates: the table's shaft itself, or a gear on it."""

from dataclasses import replace
from typing import Protocol

import numpy as np

from sim.clock import VirtualClock
from sim.motion import PiecewiseMotion
from sim.noise import NoiseModel
from sim.world import World


class Shaft(Protocol):
    """The part of a `World` that a servo uses; a world is the shaft of its own table."""

    clock: VirtualClock
    noise: NoiseModel

    def rng(self, name: str) -> np.random.Generator: ...
    def drive(self, shaft: PiecewiseMotion) -> None: ...
    def shaft(self, time_ns: int | None = None) -> tuple[float, float]: ...
    def rippled_deg(self) -> float: ...


class Geared:
    """The servo's side of a gear: ``ratio`` revolutions of the servo for one of the table."""

    def __init__(self, world: World, ratio: float) -> None:
        self.clock, self.noise = world.clock, world.noise
        self._world = world
        self._ratio = ratio

    def rng(self, name: str) -> np.random.Generator:
        return self._world.rng(name)

    def drive(self, shaft: PiecewiseMotion) -> None:
        """Make the servo follow ``shaft``, in degrees of the servo."""
        ratio = self._ratio
        self._world.drive(
            replace(
                shaft,
                position_deg=shaft.position_deg / ratio,
                velocity_dps=shaft.velocity_dps / ratio,
                acceleration_dps2=shaft.acceleration_dps2 / ratio,
            )
        )

    def shaft(self, time_ns: int | None = None) -> tuple[float, float]:
        """Return angle (°) and speed (°/s) of the servo."""
        angle, speed = self._world.shaft(time_ns)
        return angle * self._ratio, speed * self._ratio

    def rippled_deg(self) -> float:
        """Return the angle of the servo with the ripple of its speed."""
        return self._world.rippled_deg() * self._ratio
