"""Changes of a description by a change of the bench, to test a catalog against such changes without images.

A box that is a little wrong moves and scales the grid of cells, a holder hides some of them, another light changes the
colours, and highlights, shadows and defocus change the strength of edges.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

#: At strength 1: standard deviations of the box's scale and shift (shares of its side), of the exponent of edges, of
#: the share of false edges, of the light's colour and of the contrast in logarithms, and of other changes of colours.
_SCALE: Final = 0.07
_MOVE: Final = 0.045
_EXPONENT: Final = 0.15
_FALSE: Final = 0.5
_LIGHT: Final = 0.14
_CONTRAST: Final = 0.12
_STAIN: Final = 0.05
#: Probability of a holder, and its width in cells.
_HOLDER: Final = 0.5
_HOLDER_CELLS: Final = 0.8


@dataclass(frozen=True, eq=False)
class Shift:
    """A change of the bench, as one view shows it.

    Attributes
    ----------
    move : float64 array (2, 3)
        Affine map from places in the changed grid, from -0.5 to 0.5, to the unchanged one.
    visible : float32 array (8, 8)
        Share of each cell that the holder leaves visible.
    exponent, false, light, contrast, stain
        Exponent of the edges' strength; share of false edges; change of the two opponent colours, (2,); factor of the
        contrast; other changes of the colours.
    seed : int
        Seed of the random values of the cells.
    """

    move: NDArray[np.float64]
    visible: NDArray[np.float32]
    exponent: float
    false: float
    light: NDArray[np.float64]
    contrast: float
    stain: float
    seed: int

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float) -> "Shift":
        """Draw a shift; at strength 0 nothing changes, and 1 is a hard change of the bench."""
        scale = np.exp(rng.normal(0, _SCALE * strength, 2))
        move = np.column_stack([np.diag(scale), rng.normal(0, _MOVE * strength, 2)])
        visible = np.ones((8, 8), np.float32)
        if rng.random() < _HOLDER * min(1.0, strength):
            column, lean, top = rng.uniform(1, 6), rng.uniform(-1.5, 1.5), int(rng.integers(2, 7))
            for row in range(top, 8):
                away = np.abs(np.arange(8) - column - lean * (row - 4) / 8)
                visible[row] = np.clip(away - _HOLDER_CELLS / 2 + 0.5, 0, 1)
        return cls(
            move,
            visible,
            float(np.exp(rng.normal(0, _EXPONENT * strength))),
            _FALSE * strength * float(rng.uniform(0, 1)),
            rng.normal(0, _LIGHT * strength, 2),
            float(np.exp(rng.normal(0, _CONTRAST * strength))),
            _STAIN * strength,
            int(rng.integers(2**31)),
        )

    def moved(self, planes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return planes of 8 x 8 cells, (n, 8, 8), after the change of the box."""
        matrix = self.move.copy()
        middle = np.full(2, 3.5)
        matrix[:, 2] = middle + 8 * matrix[:, 2] - matrix[:, :2] @ middle
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        stacked = np.ascontiguousarray(planes.transpose(1, 2, 0))
        parts = [
            cv2.warpAffine(stacked[:, :, n : n + 4], matrix, (8, 8), flags=flags).reshape(8, 8, -1)
            for n in range(0, stacked.shape[2], 4)
        ]
        return np.concatenate(parts, axis=2).transpose(2, 0, 1).astype(np.float32)
