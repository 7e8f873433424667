"""Whitened descriptions, in which the properties that distinguish the enrolled views count most.

Source: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification", ECCV
2012.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
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
    def _rows(self) -> IndexArray:
        count = min(len(self._views), _MOST)
        rows: IndexArray = np.unique(np.linspace(0, len(self._views) - 1, count).astype(int))
        return rows

    @cached_property
    def _transform(self) -> tuple[FloatArray, FloatArray]:
        entries = descriptor(self._views.descriptor).entries(self._views.levels(self._rows))
        mean = entries.mean(axis=0)
        apart = entries - mean
        covariance = apart.T @ apart / max(1, len(apart) - 1)
        size = len(covariance)
        covariance += (_SHRINKAGE * np.trace(covariance) / size + 1e-12) * np.eye(size)
        # with C = L Lᵀ, products of L⁻¹ a and L⁻¹ b are those of any whitening
        return mean, np.linalg.inv(np.linalg.cholesky(covariance)).T

    def white(self, levels: LevelArray) -> FloatArray:
        """Return whitened descriptions, (n, d), of levels, uint8 (n, length)."""
        mean, transform = self._transform
        white: FloatArray = (descriptor(self._views.descriptor).entries(levels) - mean) @ transform
        return white

    def unit(self, levels: LevelArray) -> FloatArray:
        """Return whitened descriptions of unit length, (n, d), of levels, uint8 (n, length).

        A search needs the same few rows after each view; they are computed once.
        """
        if len(levels) > _MOST_REMEMBERED // 8:
            return unit_rows(self.white(levels))
        keys = [row.tobytes() for row in levels]
        if len(self._known) > _MOST_REMEMBERED:
            self._known = {}
        known = self._known  # this call uses one cache, even if another thread begins a new one
        missing = {key: i for i, key in enumerate(keys) if key not in known}
        if missing:
            known.update(zip(missing, unit_rows(self.white(levels[list(missing.values())])), strict=True))
        return np.array([known[key] for key in keys])

    def without(self, rows: IndexArray) -> Callable[[FloatArray], FloatArray]:
        """Return the whitening as if k views were not enrolled, without computing it again.

        If C is the covariance with these views and U has their distances from the mean as columns, the covariance
        without them is C - U Uᵀ (the mean stays). By the Woodbury identity its inverse is
        C⁻¹ + C⁻¹ U (I - Uᵀ C⁻¹ U)⁻¹ Uᵀ C⁻¹. The second part adds entries to each whitened description, one for each
        view that is left out.

        Returns
        -------
        callable
            Returns descriptions of unit length, (n, d + k), of those that `white` returns, (n, d).
        """
        used = rows[np.isin(rows, self._rows)]
        own = self.white(self._views.levels(used)) / np.sqrt(max(1, len(self._rows) - 1))
        more = own.T @ np.linalg.cholesky(np.linalg.inv(np.eye(len(own)) - own @ own.T))
        return lambda white: unit_rows(np.hstack([white, white @ more]))


def unit_rows(white: FloatArray) -> FloatArray:
    """Return rows of unit length; rows of zeros stay."""
    length = np.sqrt(np.einsum("ij,ij->i", white, white))[:, None]
    unit: FloatArray = np.divide(white, length, out=np.zeros_like(white), where=length > 0)
    return unit
