"""The space in which views are compared: properties that distinguish views count most in it.

Each part of a description (edges, colours, CEDD, a network's layer) is whitened and scaled to unit length. The cosine
of two views of different objects has a mean μ and a spread σ, which differ from part to part. So the similarities of
the parts are standardised before they are added up:

    z(q, c) = Σ w ((q · c) - μ) / σ / √(Σ w²)

With the factors inside of the vectors, z is a product of two vectors minus a constant. The weights w are the same for
all catalogs. A part that scatters in this catalog counts less.

Whitening with few objects would describe these objects, and not what objects have in common. Therefore means,
covariances and spreads are averages of those of the catalog and of those of objects 1-50 of COIL-100
(``prior.npz``, `python -m benchmarks.fit_search`), which count like `_PRIOR_OBJECTS` objects. So a catalog with one
object has a space, too.

Source: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification", ECCV
2012.

Decision: docs/decisions/0014.
"""

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from io import BytesIO
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.descriptors import descriptor
from hbr.descriptors.base import Descriptor
from hbr.descriptors.registry import Joined
from hbr.model.views import Views

Floats = NDArray[np.float32]

PRIOR: Final = "prior.npz"
#: The prior counts like this number of objects.
_PRIOR_OBJECTS: Final = 10.0  # from 5 to 15 nothing changes; without it, catalogs of fewer objects recognise fewer
#: Share of the mean variance that is added to all variances before whitening.
_SHRINKAGE: Final = 1.0  # smaller: directions with little variance, which are mostly noise, count as much as all others
#: Dimensions of each whitened part: those with the largest variance.
_MOST_DIMENSIONS: Final = 128  # 96: real photographs lose up to 2 points; all: slower, and nothing is gained
#: Largest number of views from which the whitening, and the spread of similarities, are computed.
_MOST: Final = 4096
MOST_PAIRED: Final = 1500


class _Use(NamedTuple):
    """One use of a part: whitened or as it is, with its weight."""

    is_whitened: bool
    weight: float


#: The uses of each part; of another descriptor, one.
# A network's layer that is whitened finds more objects in photographs without a change of the bench, and as it is more
# after a hard change; both together keep both.
_USES: Final[Mapping[str, tuple[_Use, ...]]] = {
    "cedd": (_Use(True, 0.8),),
    "network": (_Use(False, 2.0), _Use(True, 2.0)),
}
_USUAL: Final = (_Use(True, 1.0),)


class Statistics(NamedTuple):
    """What whitening needs to know of the entries of a part.

    Attributes
    ----------
    mean : float64 array (d,)
    covariance : float64 array (d, d)
    """

    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, entries: FloatArray) -> "Statistics":
        """Return the statistics of entries, (n, d)."""
        mean = entries.mean(axis=0)
        apart = entries - mean
        return cls(mean, apart.T @ apart / max(1, len(apart) - 1))


class Space:
    """The space of a catalog.

    Parameters
    ----------
    views : Views
        The enrolled views, at least one.

    Attributes
    ----------
    begin : integer array (p,)
        The first dimension of each use of a part.
    largest, usual : float64 arrays (p,)
        What each use adds to the product of equal views, and of views of different objects on average.
    """

    def __init__(self, views: Views) -> None:
        rows = _spread(len(views), _MOST)
        object_index = views.object_index[rows]
        levels = views.levels(rows)
        paired = _spread(len(rows), MOST_PAIRED)
        objects = len(np.unique(object_index))
        share = _PRIOR_OBJECTS / (_PRIOR_OBJECTS + objects)
        is_other = object_index[paired][:, None] != object_index[paired]
        self._parts = parts_of(descriptor(views.descriptor))
        # z of independent parts then has a standard deviation of 1, for any number of parts
        total = float(np.sqrt(sum(use.weight**2 for kind, _ in self._parts for use in uses_of(kind))))
        self._transforms: list[tuple[int, FloatArray | None, Floats | None, float]] = []
        largest, usual, sizes = [], [], []
        for part, (kind, columns) in enumerate(self._parts):
            entries = kind.entries(levels[:, columns])
            prior = _prior().get(kind.name)
            own = Statistics.of(entries)
            if prior is not None:
                own = Statistics(*((1 - share) * a + share * b for a, b in zip(own, prior.statistics, strict=True)))
            for number, use in enumerate(uses_of(kind)):
                mean, transform = (own.mean, whitening(own)) if use.is_whitened else (None, None)
                unit = unit_vectors(entries[paired], mean, transform)
                middle, spread = of_others(unit, is_other)
                if prior is not None:
                    before = prior.others[number]
                    middle = (1 - share) * middle + share * before[0]
                    spread = float(np.sqrt((1 - share) * spread**2 + share * before[1] ** 2))
                factor = use.weight / (total * spread)
                self._transforms.append((part, mean, transform, float(np.sqrt(factor))))
                largest.append(factor)
                usual.append(factor * middle)
                sizes.append(unit.shape[1])
        self.begin: IndexArray = np.cumsum([0, *sizes[:-1]])
        self.largest, self.usual = np.array(largest), np.array(usual)

    def vectors(self, levels: LevelArray) -> Floats:
        """Return levels, uint8 (n, length), as vectors, float32 (n, d)."""
        entries = [kind.entries(levels[:, columns]) for kind, columns in self._parts]
        found = [
            unit_vectors(entries[part], mean, transform) * np.float32(factor)
            for part, mean, transform, factor in self._transforms
        ]
        return np.concatenate(found, axis=1)

    def standardised(self, products: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return z of products of vectors: 0 on average for views of different objects."""
        z: NDArray[np.floating] = products - products.dtype.type(self.usual.sum())
        return z

    def similarity(self, z: NDArray[np.floating]) -> FloatArray:
        """Return z as a weighted mean of cosines, at most 1."""
        similar: FloatArray = (np.asarray(z, np.float64) + self.usual.sum()) / self.largest.sum()
        return similar


def parts_of(kind: Descriptor) -> list[tuple[Descriptor, slice]]:
    """Return the parts of a descriptor, and the columns of each in its levels."""
    if not isinstance(kind, Joined):
        return [(kind, slice(0, kind.length))]
    return list(zip(kind.parts, kind.columns(), strict=True))


def uses_of(kind: Descriptor) -> tuple[_Use, ...]:
    """Return the uses of a part."""
    return _USES.get(kind.name, _USUAL)


def whitening(statistics: Statistics) -> Floats:
    """Return the matrix that whitens entries, float32 (d, at most 128)."""
    variance, directions = np.linalg.eigh(statistics.covariance)
    added = _SHRINKAGE * float(variance.mean()) + 1e-12
    kept = slice(-_MOST_DIMENSIONS, None)
    matrix: Floats = (directions[:, kept] / np.sqrt(np.maximum(variance[kept], 0) + added)).astype(np.float32)
    return matrix


def unit_vectors(entries: FloatArray, mean: FloatArray | None, transform: Floats | None) -> Floats:
    """Return entries, (n, d), as vectors of unit length: whitened, or as they are without a mean and a transform."""
    if mean is not None and transform is not None:
        vectors: Floats = (entries - mean).astype(np.float32) @ transform
    else:
        vectors = entries.astype(np.float32)
    return unit_rows(vectors)


def unit_rows(rows: Floats) -> Floats:
    """Return rows of unit length; rows of zeros stay."""
    length = np.sqrt(np.einsum("ij,ij->i", rows, rows))[:, None]
    unit: Floats = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    return unit


def of_others(unit: Floats, is_other: NDArray[np.bool_]) -> tuple[float, float]:
    """Return mean and standard deviation of the cosines between views of different objects; 0 and 1 without such."""
    if not is_other.any():
        return 0.0, 1.0
    cosines = (unit @ unit.T)[is_other].astype(np.float64)
    return float(cosines.mean()), max(float(cosines.std()), 1e-3)


def _spread(count: int, most: int) -> IndexArray:
    rows: IndexArray = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
    return rows


class _Prior(NamedTuple):
    """What is known of a part before an object is enrolled; ``others`` has mean and spread of each use."""

    statistics: Statistics
    others: list[tuple[float, float]]


@cache
def _prior() -> dict[str, _Prior]:
    with np.load(BytesIO(files("hbr.dense").joinpath(PRIOR).read_bytes())) as stored:
        found = {}
        for name in {key.partition(".")[0] for key in stored.files}:
            directions = stored[f"{name}.directions"].astype(np.float64)
            covariance = directions @ directions.T + np.diag(stored[f"{name}.rest"].astype(np.float64))
            others = [(float(mean), float(spread)) for mean, spread in stored[f"{name}.others"]]
            found[name] = _Prior(Statistics(stored[f"{name}.mean"].astype(np.float64), covariance), others)
        return found
