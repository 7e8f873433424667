"""Simulated faults of the camera, its lens, its cable and the light."""

from collections.abc import Callable, Mapping
from math import pi, sin

import numpy as np

from sim.devices import SimDevices
from sim.faults.kind import End, Parameter, repeatedly, share, simulated_fault
from sim.frame_times import FPS
from sim.objects.projection import Image

Values = Mapping[str, float]


def _filter(devices: SimDevices, change: Callable[[Image], Image]) -> End:
    def changed(image: Image, _frame: int) -> Image:
        return change(image)

    devices.camera.filters.append(changed)
    return lambda: devices.camera.filters.remove(changed)


@simulated_fault("camera.off", "The camera is unplugged. After it is plugged in, it must be opened again.")
def _off(devices: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    devices.camera.unplug()
    return devices.camera.replug


@simulated_fault("camera.stuck", "The camera's stream hangs. No frame arrives.")
def _stuck(devices: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    devices.camera.hangs = True
    return lambda: setattr(devices.camera, "hangs", False)


@simulated_fault("camera.garbage", "A bad cable corrupts the frames. They show noise.")
def _garbage(devices: SimDevices, _values: Values, rng: np.random.Generator) -> End:
    return _filter(devices, lambda image: rng.integers(0, 256, image.shape, dtype=np.uint8))


@simulated_fault("camera.wrong", "The camera changes to a mode of half the size.")
def _wrong(devices: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    return _filter(devices, lambda image: np.ascontiguousarray(image[::2, ::2]))


@simulated_fault("camera.slow", "The camera delivers few frames.", fps=Parameter(2.0, "frames per second", 0.1, FPS))
def _slow(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    devices.camera.every = max(round(FPS / values["fps"]), 1)
    return lambda: setattr(devices.camera, "every", 1)


@simulated_fault("camera.delayed", "Frames arrive late.", seconds=Parameter(0.4, "delay, s", 0, 10))
def _delayed(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    devices.camera.latency_ns = round(values["seconds"] * 1e9)
    return lambda: setattr(devices.camera, "latency_ns", 0)


@simulated_fault("camera.intermittent", "The plug is loose. Some frames cannot be fetched.", rate=share(0.2, "frames"))
def _intermittent(devices: SimDevices, values: Values, rng: np.random.Generator) -> End:
    def fails() -> bool:
        return bool(rng.random() < values["rate"])

    devices.camera.grab_failures.append(fails)
    return lambda: devices.camera.grab_failures.remove(fails)


@simulated_fault("lost_frames", "The USB is overloaded. Some frames never arrive.", rate=share(0.3, "frames"))
def _lost_frames(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    times = devices.camera.times
    before, times.lost_share = times.lost_share, min(values["rate"], 0.99)
    return lambda: setattr(times, "lost_share", before)


@simulated_fault(
    "doubled_frame",
    "The camera sends some frames a second time instead of the next one, with a new time stamp.",
    rate=share(0.3, "frames"),
)
def _doubled(devices: SimDevices, values: Values, rng: np.random.Generator) -> End:
    images: list[Image] = []

    def again(image: Image) -> Image:
        if not images or rng.random() >= values["rate"]:
            images[:] = [image]
        return images[0]

    return _filter(devices, again)


def _shifted_stamps(devices: SimDevices, ms: float) -> End:
    devices.camera.stamp_shift_ns = round(ms * 1e6)
    return lambda: setattr(devices.camera, "stamp_shift_ns", 0)


@simulated_fault("stamp_jump", "The time stamps of the frames jump.", ms=Parameter(12.0, "jump, ms", -1000, 1000))
def _stamp_jump(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    return _shifted_stamps(devices, values["ms"])


@simulated_fault(
    "stamps_backwards",
    "The time stamps of the frames go backwards.",
    ms=Parameter(80.0, "how far, ms", 0, 1000),
)
def _stamps_backwards(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    return _shifted_stamps(devices, -values["ms"])


@simulated_fault(
    "stamp_jitter",
    "The computer stamps frames late because it is busy.",
    ms=Parameter(6.0, "1 σ of the error, ms", 0, 100),
)
def _stamp_jitter(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    times = devices.camera.times
    times.stamped_late_ns = values["ms"] * 1e6
    return lambda: setattr(times, "stamped_late_ns", 0.0)


@simulated_fault("frozen_frame", "The camera repeats one image with new time stamps.")
def _frozen(devices: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    images: list[Image] = []

    def hold(image: Image) -> Image:
        images.append(image)
        return images[0]

    return _filter(devices, hold)


@simulated_fault("black_frame", "The frames are black because of a lens cap or a broken lamp.")
def _black(devices: SimDevices, _values: Values, _rng: np.random.Generator) -> End:
    return _filter(devices, np.zeros_like)


@simulated_fault("blur", "The lens is out of focus.", pixels=Parameter(8.0, "sigma of the blur, px", 0, 100))
def _blur(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    devices.camera.blur_px = values["pixels"]
    return lambda: setattr(devices.camera, "blur_px", 0.0)


@simulated_fault(
    "exposure_jump",
    "The camera changes its exposure by itself.",
    factor=Parameter(2.0, "new exposure divided by the old one", 0.01, 100),
)
def _exposure_jump(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    exposure = devices.camera.exposure
    devices.camera.drift(exposure=exposure * values["factor"])
    return lambda: devices.camera.drift(exposure=exposure)


@simulated_fault(
    "light_flicker",
    "The lamp flickers.",
    depth=share(0.2, "the light that flickers"),
    hz=Parameter(1.3, "frequency as the frames show it, Hz", 0.01, 15),
)
def _light_flicker(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    world = devices.world
    steady = world.scene.light

    def flicker() -> None:
        level = 1 + values["depth"] * sin(2 * pi * values["hz"] * world.clock.now_ns() * 1e-9)
        world.change(light=(level * steady[0], level * steady[1], level * steady[2]))

    stop = repeatedly(world.clock, 1 / FPS, flicker)

    def restore() -> None:
        stop()
        world.change(light=steady)

    return restore


@simulated_fault(
    "mains_flicker",
    "The lamps flicker with the mains. Exposures that are not whole periods of the lamp show bands.",
    hz=Parameter(50.0, "frequency of the mains, Hz", 1, 400),
    depth=share(0.3, "the light that flickers"),
)
def _mains_flicker(devices: SimDevices, values: Values, _rng: np.random.Generator) -> End:
    devices.camera.lamp = 2 * values["hz"], values["depth"]
    return lambda: setattr(devices.camera, "lamp", None)
