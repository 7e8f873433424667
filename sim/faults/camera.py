"""Simulated faults of the camera, its lens, its cable and the light."""

from collections.abc import Callable
from math import pi, sin

import numpy as np

from sim.devices import SimDevices
from sim.faults.kind import End, Parameter, Rng, added, repeatedly, share, simulated_fault, switched
from sim.frame_times import FPS
from sim.objects.projection import Image


def _filter(devices: SimDevices, change: Callable[[Image], Image]) -> End:
    def changed(image: Image, _frame: int) -> Image:
        return change(image)

    return added(devices.camera.filters, changed)


@simulated_fault("camera.off", "The camera is unplugged. After it is plugged in, it must be opened again.")
def _off(devices: SimDevices, _rng: Rng) -> End:
    devices.camera.unplug()
    return devices.camera.replug


simulated_fault("camera.stuck", "The camera's stream hangs. No frame arrives.")(
    lambda devices, _: switched(devices.camera, "hangs", True, False)
)
simulated_fault("camera.garbage", "A bad cable corrupts the frames. They show noise.")(
    lambda devices, rng: _filter(devices, lambda image: rng.integers(0, 256, image.shape, dtype=np.uint8))
)
simulated_fault("camera.wrong", "The camera changes to a mode of half the size.")(
    lambda devices, _: _filter(devices, lambda image: np.ascontiguousarray(image[::2, ::2]))
)
simulated_fault("camera.slow", "The camera delivers few frames.", fps=Parameter(2.0, "frames per second", 0.1, FPS))(
    lambda devices, _, fps: switched(devices.camera, "every", max(round(FPS / fps), 1), 1)
)
simulated_fault("camera.delayed", "Frames arrive late.", seconds=Parameter(0.4, "delay, s", 0, 10))(
    lambda devices, _, seconds: switched(devices.camera, "latency_ns", round(seconds * 1e9), 0)
)
simulated_fault("camera.intermittent", "The plug is loose. Some frames cannot be fetched.", rate=share(0.2, "frames"))(
    lambda devices, rng, rate: added(devices.camera.grab_failures, lambda: bool(rng.random() < rate))
)


@simulated_fault("lost_frames", "The USB is overloaded. Some frames never arrive.", rate=share(0.3, "frames"))
def _lost_frames(devices: SimDevices, _rng: Rng, rate: float) -> End:
    times = devices.camera.times
    return switched(times, "lost_share", min(rate, 0.99), times.lost_share)


@simulated_fault(
    "doubled_frame",
    "The camera sends some frames a second time instead of the next one, with a new time stamp.",
    rate=share(0.3, "frames"),
)
def _doubled(devices: SimDevices, rng: Rng, rate: float) -> End:
    images: list[Image] = []

    def again(image: Image) -> Image:
        if not images or rng.random() >= rate:
            images[:] = [image]
        return images[0]

    return _filter(devices, again)


simulated_fault("stamp_jump", "The time stamps of the frames jump.", ms=Parameter(12.0, "jump, ms", -1000, 1000))(
    lambda devices, _, ms: switched(devices.camera, "stamp_shift_ns", round(ms * 1e6), 0)
)
simulated_fault(
    "stamps_backwards", "The time stamps of the frames go backwards.", ms=Parameter(80.0, "how far, ms", 0, 1000)
)(lambda devices, _, ms: switched(devices.camera, "stamp_shift_ns", round(-ms * 1e6), 0))
simulated_fault(
    "stamp_jitter",
    "The computer stamps frames late because it is busy.",
    ms=Parameter(6.0, "1 σ of the error, ms", 0, 100),
)(lambda devices, _, ms: switched(devices.camera.times, "stamped_late_ns", ms * 1e6, 0.0))


@simulated_fault("frozen_frame", "The camera repeats one image with new time stamps.")
def _frozen(devices: SimDevices, _rng: Rng) -> End:
    images: list[Image] = []

    def hold(image: Image) -> Image:
        images.append(image)
        return images[0]

    return _filter(devices, hold)


simulated_fault("black_frame", "The frames are black because of a lens cap or a broken lamp.")(
    lambda devices, _: _filter(devices, np.zeros_like)
)
simulated_fault("blur", "The lens is out of focus.", pixels=Parameter(8.0, "sigma of the blur, px", 0, 100))(
    lambda devices, _, pixels: switched(devices.camera, "blur_px", pixels, 0.0)
)


@simulated_fault(
    "exposure_jump",
    "The camera changes its exposure by itself.",
    factor=Parameter(2.0, "new exposure divided by the old one", 0.01, 100),
)
def _exposure_jump(devices: SimDevices, _rng: Rng, factor: float) -> End:
    exposure = devices.camera.controls.exposure
    devices.camera.drift(exposure=exposure * factor)
    return lambda: devices.camera.drift(exposure=exposure)


@simulated_fault(
    "light_flicker",
    "The lamp flickers.",
    depth=share(0.2, "the light that flickers"),
    hz=Parameter(1.3, "frequency as the frames show it, Hz", 0.01, 15),
)
def _light_flicker(devices: SimDevices, _rng: Rng, depth: float, hz: float) -> End:
    world = devices.world
    steady = world.scene.light

    def flicker() -> None:
        level = 1 + depth * sin(2 * pi * hz * world.clock.now_ns() * 1e-9)
        world.change(light=(level * steady[0], level * steady[1], level * steady[2]))

    stop = repeatedly(world.clock, 1 / FPS, flicker)

    def restore() -> None:
        stop()
        world.change(light=steady)

    return restore


simulated_fault(
    "mains_flicker",
    "The lamps flicker with the mains. Exposures that are not whole periods of the lamp show bands.",
    hz=Parameter(50.0, "frequency of the mains, Hz", 1, 400),
    depth=share(0.3, "the light that flickers"),
)(lambda devices, _, hz, depth: switched(devices.camera, "lamp", (2 * hz, depth), None))
