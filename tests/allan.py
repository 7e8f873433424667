"""The Allan deviation of a rate."""

import numpy as np
from numpy.typing import NDArray


def allan(
    rate: NDArray[np.float64], period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return τ (s), the overlapping Allan deviation, and its degrees of freedom, over octaves of τ.

    ``rate``, float64 (n,), is evenly spaced by ``period_s``.
    """
    angle = np.concatenate([[0.0], np.cumsum(rate)]) * period_s
    spans = 2 ** np.arange(int(np.log2(rate.size / 4)) + 1)
    second = [angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m] for m in spans]
    taus = np.asarray(spans * period_s, dtype=np.float64)
    variance = np.array([(d**2).mean() for d in second]) / (2 * taus**2)
    # Degrees of freedom of an overlapping estimate under white frequency noise (NIST SP 1065, table 5).
    n = rate.size
    freedom: NDArray[np.float64] = (3 * (n - 1) / (2 * spans) - 2 * (n - 2) / n) * 4 * spans**2 / (4 * spans**2 + 5)
    return taus, np.sqrt(variance), np.maximum(freedom, 1.0)
