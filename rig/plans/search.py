"""A search without its hardware: views in, ranking and decision out. The bench runs it, and a replay runs it again."""

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.angles import wrap360
from rig.config import IdentifyConfig
from rig.errors import CatalogError
from rig.plans.events import Candidate, Ranked
from rig.plans.strategies import Look, Stop, Strategy, Turn

SHOWN = 5
"""Candidates that an event names at most, unless more are asked for."""


class Search:
    """What the views so far say about the object, and what to do next.

    Parameters
    ----------
    index : hbr.ViewIndex
        The enrolled views.
    config
        The settings of a search.
    strategy
        Decides where to look next.
    seed
        For strategies that draw.
    top
        How many candidates are named.

    Raises
    ------
    CatalogError
        Nothing is enrolled.
    """

    def __init__(
        self, index: hbr.ViewIndex, config: IdentifyConfig, strategy: Strategy, *, seed: int = 0, top: int = SHOWN
    ) -> None:
        if not len(index.views):
            raise CatalogError("The catalog is empty.", next_step="Enroll at least one object: rig enroll NAME.")
        self.min_score = (
            hbr.familiar_score(index.views, repeatability=config.repeatability)
            if config.min_score is None
            else config.min_score
        )
        self._index = index
        self._config = config
        self._strategy = strategy
        self._top = top
        self._rng = np.random.default_rng(seed)
        self._descriptors: list[NDArray[np.uint8]] = []
        self._orientations: list[float] = []

    def look(
        self,
        descriptor: NDArray[np.uint8],
        azimuth_deg: float,
        *,
        table_deg: float,
        limits_deg: tuple[float, float],
    ) -> tuple[Ranked, Turn | Stop]:
        """Take the next view; return what is thought now, and what to do.

        Parameters
        ----------
        descriptor : uint8 array (144,)
            Of the view.
        azimuth_deg
            Orientation of the camera around the object, from any zero that all views share, in [0, 360).
        table_deg, limits_deg
            Where the table stands, and how far its cable reaches.
        """
        self._descriptors.append(descriptor)
        self._orientations.append(azimuth_deg)
        queries = np.array(self._descriptors)
        config = self._config
        ranking = hbr.retrieve(
            queries,
            np.array(self._orientations),
            self._index,
            omega=config.omega,
            list_length=config.list_length,
            extension=config.extension,
        )
        views = len(queries)
        candidates = tuple(
            Candidate(name, float(score) / views, float(pose_deg))
            for name, score, pose_deg in zip(ranking.names[: self._top], ranking.scores, ranking.pose_deg, strict=False)
        )
        ranked = Ranked(views - 1, candidates, hbr.lead(ranking, queries) / views)
        look = Look(
            index=self._index,
            queries=queries,
            ranking=ranking,
            score=candidates[0].score,
            margin=ranked.margin,
            min_score=self.min_score,
            table_deg=table_deg,
            limits_deg=limits_deg,
            config=config,
            rng=self._rng,
        )
        return ranked, self._strategy.next(look)

    def yaw_deg(self, ranked: Ranked) -> float:
        """Return how far the leading candidate stands turned counter-clockwise against its enrollment."""
        return float(wrap360(self._orientations[-1] - ranked.candidates[0].pose_deg))
