"""Simulated faults of the object and of the computer."""

import errno
import os
from collections.abc import Callable
from typing import Any

from sim.devices import SimDevices
from sim.faults.kind import End, Parameter, Rng, simulated_fault

_os: Any = os


def fill_disk() -> Callable[[], None]:
    """Fill the disk for this process; return the function that frees it.

    `os.fsync` fails: file systems with delayed allocation or a quota also report a full disk there.
    """
    fsync = os.fsync

    def full(_descriptor: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    _os.fsync = full

    def free() -> None:
        _os.fsync = fsync

    return free


@simulated_fault("object_falls", "The object falls off the platter.")
def _object_falls(devices: SimDevices, _rng: Rng) -> End:
    fallen = devices.world.scene.object
    devices.world.change(object=None)
    return lambda: devices.world.change(object=fallen)


@simulated_fault(
    "object_moved",
    "Someone replaces the object on the platter by another one, or rotates it by hand.",
    other=Parameter(
        1.0, "place of the other object in the list of the bench's objects, from 1; 0: the same one", 0, 99
    ),
    angle=Parameter(120.0, "rotation on the platter, °", -360, 360),
)
def _object_moved(devices: SimDevices, rng: Rng, other: float, angle: float) -> End:
    world, before = devices.world, devices.world.scene
    names, place = sorted(devices.objects), int(other)
    put = devices.objects[names[(place - 1) % len(names)]] if place else before.object
    dx_mm, dy_mm = rng.normal(0.0, world.noise.placement_mm, 2).tolist()
    world.put(put, before.yaw_deg + angle, (dx_mm, dy_mm))
    return lambda: world.put(before.object, before.yaw_deg, before.offset_mm)


simulated_fault("disk_full", "The computer's disk is full. Nothing can be stored.")(lambda _, __: fill_disk())


@simulated_fault(
    "clock_jump",
    "The computer's date and time change, set by a time server or by hand.",
    seconds=Parameter(-3600.0, "change, s", -1e9, 1e9),
)
def _clock_jump(devices: SimDevices, _rng: Rng, seconds: float) -> End:
    devices.world.clock.set_civil(seconds)
    return lambda: devices.world.clock.set_civil(-seconds)
