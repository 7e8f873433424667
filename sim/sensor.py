"""Image formation: from the light of a scene to the pixel values of a camera's sensor.

The sensor is linear (gamma 1). The scene's levels 0..255 are the signal at nominal exposure, gain and light, so a
saturated pixel has `NoiseModel.full_well_e` electrons. Noise follows EMVA 1288: its variance in electrons is
the number of electrons (shot noise) plus the square of the read noise.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.noise import NoiseModel
from sim.objects.projection import HEIGHT, WIDTH, Image

Gains = tuple[float, float, float]
"""Factors of B, G, R."""

NOMINAL_KELVIN = 5000.0  # the light in which the frame has the scene's colours
_WAVELENGTHS_NM = (465.0, 540.0, 610.0)  # middles of the bands of usual filters, B, G, R
# Noise is drawn once, because it takes longer than a frame; each frame takes another part of the tile. Larger: frames
# are less alike, and the start takes longer.
_TILE_MARGIN = 128
STRIP = 32  # rows that are computed together: they stay in the processor's cache


class Sensor:
    """A colour sensor with its lens' vignetting and its noise.

    ``rng`` draws the noise tile, of which each frame uses a part. ``binning`` pixels along each side are combined into
    one. ``size`` is width and height of the scene in pixels.
    """

    def __init__(
        self, noise: NoiseModel, rng: np.random.Generator, binning: int = 1, size: tuple[int, int] = (WIDTH, HEIGHT)
    ) -> None:
        self._size = width, height = size[0] // binning, size[1] // binning
        self._noise = noise
        levels_per_e = 255 / (noise.full_well_e or NoiseModel().full_well_e)
        self._shot = levels_per_e if noise.full_well_e else 0.0
        self._dark_variance = np.full((height, width, 3), (levels_per_e * noise.read_noise_e) ** 2, dtype=np.float32)
        noisy = noise.full_well_e > 0 or noise.read_noise_e > 0
        shape = (height + _TILE_MARGIN, width + _TILE_MARGIN, 3)
        self._tile = rng.standard_normal(shape, dtype=np.float32) if noisy else None
        self._vignette = _vignette(noise.vignetting, width, height)
        self._light_key: Gains | None = None
        self._light_map = np.empty((height, width, 3), dtype=np.float32)
        self._gain_key: Gains | None = None
        self._gain_map = np.empty((height, width, 3), dtype=np.float32)

    def expose(
        self,
        scene: Image | NDArray[np.float32],
        *,
        light: Gains,
        exposure: float,
        gains: Gains,
        rng: np.random.Generator,
    ) -> Image:
        """Return one frame, uint8, of the size of the scene, or smaller by the binning.

        ``scene``, (height, width, 3), has the levels 0..255 under nominal light; ``light`` and ``exposure`` are
        relative to the nominal ones, and ``gains`` include the white balance. ``rng`` is that of this frame, for the
        flicker of the light and the part of the noise tile.
        """
        flicker = 1 + self._noise.light_flicker * rng.standard_normal()
        if light != self._light_key:
            self._light_key, self._light_map = light, self._vignette * np.array(light, dtype=np.float32)
        if gains != self._gain_key:
            self._gain_key = gains
            self._gain_map[:] = gains
        if scene.shape[1] != self._size[0]:
            scene = cv2.resize(scene, self._size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        width, height = self._size
        tile = None
        if self._tile is not None:
            y, x = rng.integers(0, _TILE_MARGIN, 2, endpoint=True)
            tile = self._tile[y : y + height, x : x + width]
        image = np.empty((height, width, 3), dtype=np.uint8)
        scale = max(flicker, 0.0) * exposure
        for top in range(0, height, STRIP):
            rows = np.s_[top : top + STRIP]
            signal = cv2.multiply(scene[rows], self._light_map[rows], scale=scale, dtype=cv2.CV_32F)
            if tile is not None:
                # var = levels_per_e · signal + (levels_per_e · read noise)²: EMVA 1288, in grey levels
                sigma = cv2.scaleAdd(signal, self._shot, self._dark_variance[rows])
                cv2.sqrt(sigma, dst=sigma)
                cv2.multiply(sigma, tile[rows], dst=sigma)
                cv2.add(signal, sigma, dst=signal)
            cv2.multiply(signal, self._gain_map[rows], dst=image[rows], dtype=cv2.CV_8U)
        return image


def _vignette(loss: float, width: int, height: int) -> NDArray[np.float32]:
    """Return the share of light that reaches each pixel, falling with the square of the distance from the middle."""
    x = (np.arange(width) - (width - 1) / 2)[None, :, None]
    y = (np.arange(height) - (height - 1) / 2)[:, None, None]
    square = (x**2 + y**2) / (((width - 1) / 2) ** 2 + ((height - 1) / 2) ** 2)
    return np.repeat(1 - loss * square, 3, axis=2).astype(np.float32)


@lru_cache(maxsize=64)
def white_balance(kelvin: float) -> Gains:
    """Return the gains that make a black body's light at ``kelvin`` look as it does at 5000 K (Planck's law)."""
    nominal, there = _planck(NOMINAL_KELVIN), _planck(kelvin)
    ratio = (nominal / nominal[1]) / (there / there[1])
    return float(ratio[0]), float(ratio[1]), float(ratio[2])


def _planck(kelvin: float) -> NDArray[np.float64]:
    """Return the relative spectral radiance at the colours' wavelengths."""
    wavelength = np.array(_WAVELENGTHS_NM) * 1e-9
    return np.asarray(wavelength**-5 / np.expm1(1.438777e-2 / (wavelength * kelvin)))
