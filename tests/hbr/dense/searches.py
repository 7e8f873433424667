"""Drawn catalogs, and searches of several views, one after the other."""

from collections.abc import Iterable

import numpy as np
import pytest

from hbr import Belief, DenseIndex, Views, descriptor, update_belief
from hbr.dense.pixel_fit import PixelFit
from hbr.dense.space import parts_of

LIGHT = "edges+colours+cedd"


def fitted(
    object_index: int, own: float, *, second: float = 0.3, others: float = 0.3, expected: float = 0.85
) -> PixelFit:
    """Return a fit in the light of the enrollment."""
    return PixelFit(object_index, own, second, others, expected, 0.0)


def catalog(objects: int = 8, *, seed: int = 0, kind: str = LIGHT, step_deg: float = 20.0) -> Views:
    """Return views of drawn objects: each level is a wave around the object, so that neighbouring views are alike."""
    rng = np.random.default_rng(seed)
    most = np.concatenate([np.full(part.length, min(part.max_level, 7)) for part, _ in parts_of(descriptor(kind))])
    azimuth_deg = np.arange(0, 360, step_deg)
    parts = []
    for j in range(objects):
        waves, phase_deg = rng.integers(0, 3, len(most)), rng.uniform(0, 360, len(most))
        middle = rng.uniform(-0.6, 1, len(most))
        share = np.clip(middle + 0.4 * np.cos(np.deg2rad(waves * azimuth_deg[:, None] + phase_deg)), 0, 1)
        parts.append(Views.of_object(f"object {j}", np.rint(share * most).astype(np.uint8), azimuth_deg, kind))
    return Views.concatenate(parts)


def view(views: Views, j: int, azimuth_deg: float) -> np.ndarray:
    """Return the levels of the view of an object that is nearest to an azimuth."""
    rows = views.of(j)
    away_deg = np.abs((views.azimuth_deg[rows] - azimuth_deg + 180) % 360 - 180)
    return views.levels(rows[[int(away_deg.argmin())]])[0]


def belief_after(queries: Iterable, orientation_deg: Iterable[float], index: DenseIndex) -> Belief:
    """Return the belief after all these queries, in their order."""
    belief: DenseIndex | Belief = index
    for query, angle_deg in zip(queries, orientation_deg, strict=True):
        belief = update_belief(query, float(angle_deg), belief)
    assert isinstance(belief, Belief)
    return belief


def found_from(monkeypatch: pytest.MonkeyPatch, probability: float) -> None:
    """Let searches end as found from this probability on; with 2, none does."""
    for name in ("MIN_CONFIDENCE", "LAST_CONFIDENCE"):
        monkeypatch.setattr(f"hbr.dense.stopping.{name}", probability)
