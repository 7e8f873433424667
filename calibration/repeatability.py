"""How well the bench repeats a view: what similarity the same view keeps, and what may be made of it.

An object is placed several times at the same mark; each time the table goes round twice and takes the same views. Two
views of the same azimuth differ by the camera's noise and the table's repeatability where they are of one placing, and
by the hand and the light besides where they are of two. From the latter follow

- ``identify.repeatability``: the similarity a view that a known object falls below with the stated error rate α when
  it is decided about: the conformal quantile ⌊α(n+1)⌋ of the n comparisons, each averaged over the N views of the
  shortest decision. A single view falls much lower, and by its quantile strangers would be taken for known; and
- ``identify.margin``: how far two scores of equal truth are apart by chance in a decision of N views,
  z(1−α)·√2·σ/√N, with σ the scatter about the mean of the azimuth.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations
from math import ceil, floor, sqrt
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hbr
from calibration import pictures
from calibration.events import Ask
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import LIMIT, OTHER, Axis, Chart, Series
from rig.core.errors import UsageError
from rig.events.events import Accepted, Event
from rig.motion.turntable import Turntable
from rig.plans.capture import capture, moved
from rig.views.capture import Viewer
from rig.views.description import PAPER_DESCRIPTOR, ViewDescriber

NAME = "noise.repeatability"
VALID_DAYS = 180

AZIMUTHS = 12
ROUNDS = 2
MIN_PLACEMENTS = 2
ERROR_RATE = 0.02
BOOTSTRAPS = 200
MAX_DRIFT = 0.02
"""By how much less the first placing and the last may be alike than placings that follow each other, in similarity."""
MIN_SIMILARITY = 0.7
"""Views of the same azimuth that are less alike are not of the same object, or not of the same azimuth."""


@dataclass(frozen=True, slots=True)
class Sitting:
    """One placing: the descriptors of its rounds, uint8 (rounds, azimuths, levels)."""

    descriptors: NDArray[np.uint8]


def live(
    bench: Bench, name: str, *, placements: int = 5, error_rate: float = ERROR_RATE
) -> Generator[Event | Ask | CalibrationResult, None, CalibrationResult]:
    """Have ``name`` placed several times at its mark, and look at it from all sides; yields events, then the fact.

    Raises
    ------
    UsageError
        Too few placements to be sure of the error rate.
    ViewRejected, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`.
    """
    needed = needed_placements(error_rate)
    if placements < needed:
        raise UsageError(
            f"{placements} placements are too few for an error rate of {error_rate:.1%}.",
            next_step=f"Place the object {needed} times (--placements {needed}), or ask for a larger --error-rate.",
        )
    when_utc = bench.clock.utc()
    viewer = Viewer(bench.camera, bench.config.view)
    describe = ViewDescriber(bench.config.view, (PAPER_DESCRIPTOR,))
    sittings: list[Sitting] = []
    index = 0
    for placing in range(1, placements + 1):
        again = "again, taken off and put back" if placing > 1 else "as it stands when it is enrolled"
        yield Ask(
            f"Put {name} at its mark on the platter, {again} (placing {placing} of {placements}); take your hands off.",
            pictures.OBJECT_AT_MARK,
        )
        bench.operator.place(name)
        rounds = []
        with Turntable(bench) as table:
            for _ in range(ROUNDS):
                views = []
                for step in range(AZIMUTHS):
                    move = table.goto(step * 360.0 / AZIMUTHS)
                    yield moved(index, move)
                    shot = yield from capture(index, viewer, table, move.settled_ns)
                    yield Accepted(index, (-move.encoder_deg) % 360.0, shot.evidence, shot.image_bgr)
                    views.append(describe(shot.image_bgr).levels[PAPER_DESCRIPTOR])
                    index += 1
                rounds.append(views)
            table.goto(0.0)
        sittings.append(Sitting(np.array(rounds)))
    fact = from_data(
        sittings,
        error_rate=error_rate,
        views=bench.config.identify.min_views,
        first_step_deg=bench.config.identify.first_step_deg,
        when_utc=when_utc,
        device=bench.apparatus("camera"),
        name=name,
    )
    yield fact
    return fact


def needed_placements(error_rate: float) -> int:
    """Return how many placements give enough comparisons between placings to state the error rate."""
    pairs = ceil(1 / error_rate) - 1
    return max(MIN_PLACEMENTS, ceil((1 + sqrt(1 + 8 * pairs / AZIMUTHS)) / 2))


def from_data(
    sittings: Sequence[Sitting],
    *,
    error_rate: float,
    views: int,
    first_step_deg: float = 90.0,
    when_utc: datetime,
    device: Mapping[str, Any],
    name: str = "",
    seed: int = 0,
) -> CalibrationResult:
    """Find the similarity that repeats keep, and judge it.

    Parameters
    ----------
    sittings
        Placings of the same object at the same mark.
    error_rate
        Share of known objects that may fall below ``identify.repeatability``.
    views, first_step_deg
        Of the shortest decision, and the turn between them.
    when_utc, device
        Kept with the fact.
    name
        The object's.
    seed
        Of the bootstrap over azimuths.
    """
    within = np.array([_similar(s.descriptors[0], s.descriptors[1]) for s in sittings])
    between = np.array([_similar(a.descriptors[0], b.descriptors[0]) for a, b in combinations(sittings, 2)])
    refusals: list[str] = []
    if len(sittings) < needed_placements(error_rate):
        refusals.append(
            f"{len(sittings)} placements are too few to promise an error rate of {error_rate:.1%}: "
            f"{needed_placements(error_rate)} are needed. Give --placements, or a larger --error-rate."
        )
    turn = round(first_step_deg * AZIMUTHS / 360.0)
    decided = np.mean([np.roll(between, -turn * view, axis=1) for view in range(views)], axis=0)
    low = float(np.median(between))
    if low < MIN_SIMILARITY:
        refusals.append(
            f"Views of the same azimuth keep a similarity of only {low:.2f}, below {MIN_SIMILARITY:g}: the object was "
            "not put back at its mark, or the light changed. Fix a mark on the platter and calibrate again."
        )
    last = len(sittings) - 1
    apart = {(i, j): row for (i, j), row in zip(combinations(range(len(sittings)), 2), between, strict=True)}
    neighbours = float(np.median([apart[i, i + 1] for i in range(last)]))
    drift = neighbours - float(np.median(apart[0, last]))
    if last > 1 and drift > MAX_DRIFT:
        refusals.append(
            f"The first placing and the last are less alike than their neighbours, by {drift:.3f}: the light drifts. "
            "Let the lamps warm up, lock the camera, and calibrate again."
        )

    def figures(chosen: NDArray[np.int64]) -> tuple[float, float, float, float]:
        some_within, some_between = within[:, chosen], between[:, chosen]
        ordered = np.sort(decided[:, chosen].ravel())
        quantile = float(ordered[max(floor(error_rate * (ordered.size + 1)) - 1, 0)])
        # Scatter about the mean of its azimuth: the mean itself depends on the object, and is in every score.
        scatter = float(np.sqrt(some_between.var(axis=0, ddof=min(1, len(between) - 1)).mean()))
        return float(np.median(some_within)), float(np.median(some_between)), quantile, scatter

    found = figures(np.arange(AZIMUTHS))
    rng = np.random.default_rng(seed)
    drawn = np.array([figures(rng.integers(0, AZIMUTHS, AZIMUTHS)) for _ in range(BOOTSTRAPS)])
    sigma = drawn.std(axis=0, ddof=1)
    names = ("repeat", "placed_again", "repeatability", "scatter")
    estimates = {
        key: Estimate(value, float(s), "of similarity") for key, value, s in zip(names, found, sigma, strict=True)
    }
    margin = NormalDist().inv_cdf(1 - error_rate) * sqrt(2 / views) * found[3]
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=1.0 - low,
        limit=1.0 - MIN_SIMILARITY,
        residual_unit="of similarity",
        refusals=tuple(refusals),
        settings={}
        if refusals
        else {"identify.repeatability": round(found[2], 4), "identify.margin": round(min(margin, 1.0), 4)},
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={
            "object": name,
            "error_rate": error_rate,
            "views_of_a_decision": views,
            "within": within.round(4).tolist(),
            "between": between.round(4).tolist(),
            "by_step": _by_step(sittings),
        },
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return how alike views are that lie some degrees of the table apart."""
    steps = [step["step_deg"] for step in fact.evidence["by_step"]]
    threshold = fact.estimates["repeatability"].value
    return Chart(
        "Similarity of repeated views",
        Axis("apart, ° of the table"),
        Axis("Tanimoto similarity", span=(1.0,)),
        [
            Series("median", steps, [step["median"] for step in fact.evidence["by_step"]], curve=True),
            Series("tenth percentile", steps, [step["tenth"] for step in fact.evidence["by_step"]], OTHER, curve=True),
            Series(
                f"unknown below {threshold:.3f}",
                [steps[0], steps[-1]],
                [threshold] * 2,
                LIMIT,
                False,
                True,
                dashed=True,
            ),
        ],
    )


def _similar(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the Tanimoto similarity of views of the same azimuth, float64 (azimuths,)."""
    return np.array([float(hbr.tanimoto(x[None], y[None])[0, 0]) for x, y in zip(a, b, strict=True)])


def _by_step(sittings: Sequence[Sitting]) -> list[dict[str, float]]:
    """Return how alike views are that lie one, two, ... steps of the table apart: median and tenth percentile."""
    curve = []
    for step in range(AZIMUTHS // 2 + 1):
        values = np.concatenate([_similar(s.descriptors[0], np.roll(s.descriptors[1], step, axis=0)) for s in sittings])
        curve.append(
            {
                "step_deg": step * 360.0 / AZIMUTHS,
                "median": round(float(np.median(values)), 4),
                "tenth": round(float(np.quantile(values, 0.1)), 4),
            }
        )
    return curve
