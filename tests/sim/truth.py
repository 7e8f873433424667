"""True values of a simulated world that no device measures."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.world import World

_AROUND_NS = 100_000


def table_rates(world: World, times_ns: ArrayLike) -> NDArray[np.float64]:
    """Return the platter's true rate (°/s) at each of the given times, int64 (n,), as a mean over 0.2 ms."""
    t = np.asarray(times_ns, np.int64)
    rates: NDArray[np.float64] = world.table_angles(t + _AROUND_NS) - world.table_angles(t - _AROUND_NS)
    return rates / (2e-9 * _AROUND_NS)
