"""Changes of the bench between enrollment and identification, for tests of robustness."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Self

import cv2
import numpy as np

from hbr.drawing.bench import HARD, DrawnBench, Visit, VisitChange
from hbr.drawing.noise import GN_STANDARD_DEVIATION, GN_VARIANCE, MB_LENGTH_PX, Noise
from rig.core.errors import UsageError
from sim.devices import SimDevices
from sim.objects.projection import CENTRE_PX, HEIGHT, PX_PER_MM, SIN, WIDTH, Image
from sim.sensor import Gains


@dataclass(frozen=True, slots=True)
class Change:
    """The strength of each change of the bench.

    The world's seed gives each change, uniformly distributed between −strength and +strength. The light changes for
    each object, like daylight. The camera's settings and the surroundings change once.
    """

    brightness: float = 0.0
    """Relative brightness of the light."""
    colour: float = 0.0
    """Additional relative brightness of blue, green and red, each on its own."""
    exposure: float = 0.0
    """Relative exposure time of the camera."""
    white_balance_k: float = 0.0
    """White balance of the camera, in kelvin."""
    placement_mm: float = 0.0
    """Distance of objects from the table's axis, along each axis of the platter."""
    background: float = 0.0
    """Weight of another bench's table and wall with patterns: 0 for none, 1 for only these."""
    hard: float = 0.0
    """Strength of what `rig eval hard-change` changes (`hbr.drawing.bench.HARD`): another bench with
    patterns and clutter, a holder in front, cast shadows, highlights, coloured light with a gradient, gamma, placement,
    scale, elevation and defocus. The light, the camera and the placement change for each object."""
    gaussian_variance: float = 0.0
    motion_px: float = 0.0
    """The paper's noise of queries, as in `sim.noise.NoiseModel`; enrolled views do not have it."""

    @classmethod
    def named(cls, names: Iterable[str]) -> Self | None:
        """Return the combination of the named changes, or None if there are no names.

        Raises `UsageError`: a name is unknown.
        """
        wanted = list(dict.fromkeys(names))
        for name in wanted:
            if name not in CHANGES:
                raise UsageError(f"There is no change {name!r}.", next_step=f"Choose one of {', '.join(CHANGES)}.")
        if not wanted:
            return None
        return cls(**{f.name: max(getattr(CHANGES[name], f.name) for name in wanted) for f in fields(cls)})

    def light(self, rng: np.random.Generator) -> Gains:
        """Draw the light on the next object."""
        whole = 1 + self.brightness * rng.uniform(-1, 1)
        blue, green, red = (whole * (1 + self.colour * rng.uniform(-1, 1, 3))).tolist()
        return blue, green, red

    def offset_mm(self, rng: np.random.Generator) -> tuple[float, float]:
        """Draw the additional offset of the next object from the axis."""
        x, y = (self.placement_mm * rng.uniform(-1, 1, 2)).tolist()
        return x, y

    def visit(self, devices: SimDevices, rng: np.random.Generator) -> None:
        """Draw the hard change for the next object."""
        if not self.hard:
            return
        factors = {f.name: self.hard * getattr(HARD, f.name) for f in fields(HARD)} | {"noise": 0.0}
        bench = DrawnBench.drawn(devices.world.rng("hard bench"))
        devices.camera.visit = Visit(bench, VisitChange(**factors), rng)  # the sensor adds the noise

    def apply_to(self, devices: SimDevices) -> None:
        """Change the camera's settings and the surroundings from now on."""
        rng, camera = devices.world.rng("another day"), devices.camera
        exposure, kelvin = rng.uniform(-1, 1, 2).tolist()
        camera.drift(
            exposure=camera.controls.exposure * (1 + self.exposure * exposure),
            kelvin=camera.controls.kelvin + self.white_balance_k * kelvin,
        )
        if self.gaussian_variance or self.motion_px:
            camera.noise = Noise(self.gaussian_variance, self.motion_px)
        if self.background:
            other = another_bench(rng)
            camera.backdrop = cv2.addWeighted(camera.backdrop, 1 - self.background, other, self.background, 0.0).astype(
                np.uint8
            )


CHANGES: Mapping[str, Change] = MappingProxyType(
    {
        "light": Change(brightness=0.3, colour=0.1, exposure=0.25, white_balance_k=900.0),
        "placement": Change(placement_mm=14.0),
        "bench": Change(
            brightness=0.3, colour=0.1, exposure=0.25, white_balance_k=900.0, placement_mm=14.0, background=1.0
        ),
        "hard": Change(hard=1.0),
        "gn": Change(gaussian_variance=GN_VARIANCE),
        "gn-sd": Change(gaussian_variance=GN_STANDARD_DEVIATION**2),
        "mb": Change(motion_px=MB_LENGTH_PX),
    }
)
"""By name: light, exposure and white balance; placement; both together with another table and wall; all that
`rig eval hard-change` changes; the paper's Gaussian noise, with 0.012 as its variance or its standard deviation; its
motion blur."""


def another_bench(rng: np.random.Generator) -> Image:
    """Draw a wall with patches of colour, a table with a grain, and a platter, uint8 (480, 640, 3)."""
    patches = rng.uniform(50, 150, (7, 9, 1)) + rng.uniform(-25, 25, (7, 9, 3))
    wall = cv2.resize(patches.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    horizon = int(rng.uniform(0.55, 0.7) * HEIGHT)
    wood = np.array([60, 85, 110]) * rng.uniform(0.7, 1.2, 3)
    grain = cv2.GaussianBlur(rng.normal(0, 60, (HEIGHT - horizon, WIDTH)).astype(np.float32), (0, 0), 25, sigmaY=1.5)
    wall[horizon:] = wood + grain[:, :, None] * 3
    image = np.clip(wall, 0, 255).astype(np.uint8)
    axes = int(105 * PX_PER_MM), int(105 * PX_PER_MM * SIN)
    grey = int(rng.uniform(60, 140))
    cv2.ellipse(image, CENTRE_PX, axes, 0, 0, 360, (grey, grey, grey), -1, cv2.LINE_AA)
    return image
