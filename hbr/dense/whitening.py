"""Whitened descriptions: what all enrolled views share counts little, what tells them apart counts much.

Source: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification", ECCV
2012.
"""

from functools import cached_property
from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray, LevelArray
from hbr.descriptors import descriptor
from hbr.model.views import Views

#: Share of the mean variance that is added to all variances before whitening.
_SHRINKAGE: Final = 0.3
#: Largest number of views from which the whitening is computed.
_MOST: Final = 4096
#: Largest number of descriptions that are remembered, 18 MB.
_MOST_REMEMBERED: Final = 4096


class Whitening:
    """Whitening of the descriptions of a catalog; computed when it is first used.

    Parameters
    ----------
    views : Views
        The enrolled views.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._known: dict[bytes, FloatArray] = {}

    @cached_property
    def _transform(self) -> tuple[FloatArray, FloatArray]:
        rows = np.unique(np.linspace(0, len(self._views) - 1, min(len(self._views), _MOST)).astype(int))
        entries = descriptor(self._views.descriptor).entries(self._views.levels(rows))
        mean = entries.mean(axis=0)
        apart = entries - mean
        covariance = apart.T @ apart / max(1, len(rows) - 1)
        size = len(covariance)
        covariance += (_SHRINKAGE * np.trace(covariance) / size + 1e-12) * np.eye(size)
        # with C = L Lᵀ, products of L⁻¹ a and L⁻¹ b are those of any whitening
        return mean, np.linalg.inv(np.linalg.cholesky(covariance)).T

    def unit(self, levels: LevelArray) -> FloatArray:
        """Return whitened descriptions of unit length, (n, d), of levels, uint8 (n, length).

        A search asks for the same few rows after each view: they are computed once.
        """
        if len(levels) > _MOST_REMEMBERED // 8:
            return self._unit(levels)
        keys = [row.tobytes() for row in levels]
        if len(self._known) > _MOST_REMEMBERED:
            self._known = {}
        known = self._known  # of this call, even if another thread begins a new one
        missing = {key: i for i, key in enumerate(keys) if key not in known}
        if missing:
            known.update(zip(missing, self._unit(levels[list(missing.values())]), strict=True))
        return np.stack([known[key] for key in keys])

    def _unit(self, levels: LevelArray) -> FloatArray:
        mean, transform = self._transform
        white = (descriptor(self._views.descriptor).entries(levels) - mean) @ transform
        length = np.sqrt(np.einsum("ij,ij->i", white, white))[:, None]
        unit: FloatArray = np.divide(white, length, out=np.zeros_like(white), where=length > 0)
        return unit
