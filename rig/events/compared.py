"""The events of comparisons pixel by pixel: of the leading candidate with the views, and of two candidates."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hbr.dense.stopping import Outcome


@dataclass(frozen=True, slots=True)
class Verified:
    """The leading candidate was doubtful, and its enrolled views were compared with the views pixel by pixel.

    ``fit`` is the share of the views' contrast that its enrolled views explain, at most 1, and ``others`` that of the
    next candidates. ``score`` is the log-odds from these numbers and the open-set score. With at least ``found_from``
    the object is found, and below ``unknown_below`` it is unknown.
    """

    index: int
    name: str
    fit: float
    others: float
    score: float
    found_from: float
    unknown_below: float
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class ComparedView:
    """A view in which two candidates differ: ``score`` is 1 for the first one, −1 for the second one.

    ``weight`` is the difference of their enrolled views there: grey levels, summed over pixels.
    """

    index: int
    score: float
    weight: float


@dataclass(frozen=True, slots=True)
class Compared:
    """The two leading candidates were compared pixel by pixel where their enrolled views differ most.

    ``winner`` is the one that the views show; None if the comparison decides for neither. ``score`` is 1 for the first
    one, −1 for the second one. ``expected`` are the scores of enrolled views of each, None if they were not compared.
    ``error_bound`` is the bound of the probability of a wrong winner, at most ``max_error``. ``unexplained`` is the
    difference that the better one leaves unexplained, as a share of the difference of both; ``misfit`` and ``apart``
    are these two differences in grey levels of a pixel. ``views`` are those that show a difference, the clearest first;
    ``azimuths_deg`` are the enrolled views of each.

    ``picture_bgr`` has a row for each of the clearest views: the view, both enrolled views, and where these differ.
    ``leaders`` has the crops and masks of the enrolled views, uint8 (160, 320, 3).
    """

    index: int
    names: tuple[str, str]
    winner: str | None
    score: float
    expected: tuple[float, float] | None
    error_bound: float
    max_error: float
    unexplained: float | None
    misfit: float
    apart: float
    views: tuple[ComparedView, ...]
    azimuths_deg: tuple[tuple[float, ...], tuple[float, ...]]
    picture_bgr: NDArray[np.uint8] | None = field(default=None, metadata={"json": False}, repr=False)
    leaders: tuple[tuple[NDArray[np.uint8], ...], ...] = field(default=(), metadata={"json": False}, repr=False)
