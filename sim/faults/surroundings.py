"""What goes wrong around the devices: with the object, and with the computer."""

from collections.abc import Mapping

import numpy as np

from sim import disk
from sim.faults.kind import End, Parameter, kind
from sim.parts import SimParts

Values = Mapping[str, float]


@kind("object_falls", "The object falls off the platter.")
def _object_falls(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    thing = parts.world.scene.thing
    parts.world.change(thing=None)
    return lambda: parts.world.change(thing=thing)


@kind("disk_full", "The computer's disk is full: nothing can be made durable.")
def _disk_full(_parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    return disk.fill()


@kind(
    "clock_jump",
    "The computer's civil time is set, by a time server or a person.",
    seconds=Parameter(-3600.0, "by how much, s", -1e9, 1e9),
)
def _clock_jump(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.world.clock.set_civil(values["seconds"])
    return lambda: parts.world.clock.set_civil(-values["seconds"])
