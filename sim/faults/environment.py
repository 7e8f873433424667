"""Simulated faults of the object and of the computer."""

from collections.abc import Mapping

import numpy as np

from sim import disk
from sim.devices import SimDevices
from sim.faults.kind import End, Parameter, simulated_fault

Values = Mapping[str, float]


@simulated_fault("object_falls", "The object falls off the platter.")
def _object_falls(devices: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    fallen = devices.world.scene.object
    devices.world.change(object=None)
    return lambda: devices.world.change(object=fallen)


@simulated_fault("disk_full", "The computer's disk is full. Nothing can be stored.")
def _disk_full(_parts: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    return disk.fill()


@simulated_fault(
    "clock_jump",
    "The computer's date and time change, set by a time server or by hand.",
    seconds=Parameter(-3600.0, "change, s", -1e9, 1e9),
)
def _clock_jump(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    devices.world.clock.set_civil(values["seconds"])
    return lambda: devices.world.clock.set_civil(-values["seconds"])
