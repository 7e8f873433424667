"""What goes wrong with the camera, its lens, its cable and the light."""

from collections.abc import Callable, Mapping
from math import pi, sin

import numpy as np

from sim.camera import FPS
from sim.faults.kind import End, Parameter, kind, repeatedly, share
from sim.objects.projection import Image
from sim.parts import SimParts

Values = Mapping[str, float]


def _tamper(parts: SimParts, change: Callable[[Image], Image]) -> End:
    def tamper(image: Image, _frame: int) -> Image:
        return change(image)

    parts.camera.tampers.append(tamper)
    return lambda: parts.camera.tampers.remove(tamper)


@kind("camera.off", "The camera is unplugged; put in again, it must be opened anew.")
def _off(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.camera.unplug()
    return parts.camera.replug


@kind("camera.stuck", "The camera's stream hangs: no frame arrives.")
def _stuck(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.camera.hangs = True
    return lambda: setattr(parts.camera, "hangs", False)


@kind("camera.garbage", "The frames are noise: corrupted on a bad cable.")
def _garbage(parts: SimParts, _values: Values, rng: np.random.Generator) -> End:
    return _tamper(parts, lambda image: rng.integers(0, 256, image.shape, dtype=np.uint8))


@kind("camera.wrong", "The camera falls back to a mode of half the size.")
def _wrong(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    return _tamper(parts, lambda image: np.ascontiguousarray(image[::2, ::2]))


@kind("camera.slow", "The camera takes few frames.", fps=Parameter(2.0, "frames a second", 0.1, FPS))
def _slow(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.camera.every = max(round(FPS / values["fps"]), 1)
    return lambda: setattr(parts.camera, "every", 1)


@kind("camera.delayed", "Frames arrive late.", seconds=Parameter(0.4, "how late, s", 0, 10))
def _delayed(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.camera.latency_ns = round(values["seconds"] * 1e9)
    return lambda: setattr(parts.camera, "latency_ns", 0)


@kind("camera.intermittent", "A loose plug: fetching a frame fails now and then.", rate=share(0.2, "the fetches"))
def _intermittent(parts: SimParts, values: Values, rng: np.random.Generator) -> End:
    def fails() -> bool:
        return bool(rng.random() < values["rate"])

    parts.camera.falters.append(fails)
    return lambda: parts.camera.falters.remove(fails)


@kind("frozen_frame", "The camera repeats one picture, each time with a new time stamp.")
def _frozen(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    kept: list[Image] = []

    def hold(image: Image) -> Image:
        kept.append(image)
        return kept[0]

    return _tamper(parts, hold)


@kind("black_frame", "The frames are black: a lens cap, a dead lamp.")
def _black(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    return _tamper(parts, np.zeros_like)


@kind("blur", "The lens was knocked out of focus.", pixels=Parameter(8.0, "width of the blur, px", 0, 100))
def _blur(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.camera.blur_px = values["pixels"]
    return lambda: setattr(parts.camera, "blur_px", 0.0)


@kind(
    "exposure_jump",
    "The camera changes its exposure by itself.",
    factor=Parameter(2.0, "new exposure against the old one", 0.01, 100),
)
def _exposure_jump(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    exposure = parts.camera.exposure
    parts.camera.drift(exposure=exposure * values["factor"])
    return lambda: parts.camera.drift(exposure=exposure)


@kind(
    "light_flicker",
    "The lamp flickers.",
    depth=share(0.2, "the light that comes and goes"),
    hz=Parameter(1.3, "how often a second it seems to, beaten against the frame rate", 0.01, 15),
)
def _light_flicker(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    world = parts.world
    steady = world.scene.light

    def shine() -> None:
        level = 1 + values["depth"] * sin(2 * pi * values["hz"] * world.clock.now_ns() * 1e-9)
        world.change(light=(level * steady[0], level * steady[1], level * steady[2]))

    stop = repeatedly(world.clock, 1 / FPS, shine)

    def restore() -> None:
        stop()
        world.change(light=steady)

    return restore
