"""The events of comparisons pixel by pixel: of the leading candidate with the views, and of two candidates."""

from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, GetPydanticSchema
from pydantic_core import core_schema

from hbr.dense.stopping import Outcome

NO_JSON: Final = GetPydanticSchema(lambda _kind, _handler: core_schema.any_schema())
Image = Annotated[NDArray[np.uint8], NO_JSON, Field(exclude=True, default=np.empty((0, 0, 3), np.uint8))]
"""The image of an event. It is no part of the JSON; an event that is read has an empty one."""


@dataclass(frozen=True, slots=True)
class Verified:
    """The enrolled views of the leading candidates were compared with the views so far, pixel by pixel.

    A replay does not repeat this comparison: it uses the saved ``fit``, ``second``, ``others`` and ``expected``.
    """

    event: Literal["verified"] = field(default="verified", init=False)
    index: int
    """Index of the last view, from 0."""
    name: str
    """Name of the leading candidate."""
    fit: float
    """Share of the views' contrast that the enrolled views of this candidate explain, at most 1."""
    second: float
    """The same share for the other one of the two likeliest candidates, at most 1; 0 without one."""
    others: float
    """The best of these shares for the next candidates that are no near twins of this one, at most 1; 0 without one."""
    expected: float
    """Share of the contrast that two neighbouring enrolled views of this candidate explain of each other, at most 1."""
    outcome: Outcome
    """Decision after the comparison: ``continue``, ``found``, ``ambiguous`` or ``unknown``."""
    probability: float
    """Probability of this candidate after the comparison."""
    not_enrolled: float
    """Probability that the object on the table is not enrolled, after the comparison."""


@dataclass(frozen=True, slots=True)
class ComparedView:
    """A view that shows a difference between the two candidates."""

    index: int
    """Index of the view, from 0."""
    score: float
    """Result of this view: near 1 it shows the first candidate, near −1 the second one."""
    weight: float
    """Difference between the enrolled views of the two candidates from this side, in grey levels, summed over all
    pixels."""


@dataclass(frozen=True, slots=True)
class Compared:
    """The two leading candidates were compared pixel by pixel where their enrolled views differ most.

    This is the last step of a search that would otherwise end as ambiguous, or as unknown although two candidates have
    nearly the same score. A saved run contains the compared enrolled views in ``leaders/``.
    """

    event: Literal["compared"] = field(default="compared", init=False)
    index: int
    """Index of the last view, from 0."""
    names: tuple[str, str]
    """Names of the two candidates, the likelier one first."""
    winner: str | None
    """Name of the candidate that the views show; null if the comparison does not decide it."""
    score: float
    """Result: near 1 the views show the first candidate, near −1 the second one."""
    expected: tuple[float, float] | None
    """Two scores, for comparison: those of enrolled views of the first and of the second candidate, in the place of the
    views. Null if they were not computed."""
    error_bound: float
    """Upper bound of the probability that the winner is wrong; 1 if it is not known."""
    max_error: float
    """Largest ``error_bound`` at which the comparison names a winner."""
    unexplained: float | None
    """Difference between the views and the better candidate, divided by the difference between the two candidates. Null
    if the candidates do not differ."""
    misfit: float
    """Difference between the views and the better candidate, in grey levels per pixel."""
    apart: float
    """Difference between the two candidates, in grey levels per pixel."""
    views: tuple[ComparedView, ...]
    """Views that show a difference between the candidates, the clearest first."""
    azimuths_deg: tuple[tuple[float, ...], tuple[float, ...]]
    """Azimuths of the enrolled views that were used, one list for each candidate."""
    picture_bgr: Annotated[NDArray[np.uint8] | None, NO_JSON, Field(exclude=True)] = field(default=None, repr=False)
    """A row for each of the clearest views: the view, both enrolled views, and where these differ."""
    leaders: Annotated[tuple[tuple[NDArray[np.uint8], ...], ...], NO_JSON, Field(exclude=True)] = field(
        default=(), repr=False
    )
    """Crops and masks of the enrolled views of each candidate, uint8 (160, 320, 3)."""
