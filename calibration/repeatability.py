"""Measure the repeatability of views: the similarity of repeated views, and the settings that depend on it.

An object is placed several times at the same mark; each time the table makes two revolutions and takes the same views.
Two views of the same azimuth differ by the camera's noise and the table's repeatability within one placement, and also
by placement and light between two placements. The differences between placements determine

- ``identify.repeatability``: the similarity per view below which a known object falls with the stated error rate α in a
  decision: the conformal quantile ⌊α(n+1)⌋ of the n comparisons, each averaged over the N views of the shortest
  decision. A single view can be much less similar; with its quantile, unknown objects would be found as known ones.
- ``identify.margin``: the difference by chance of two equally true scores in a decision of N views, z(1−α)·√2·σ/√N,
  with σ the scatter about the mean of the azimuth.
"""

from dataclasses import dataclass
from itertools import combinations
from math import ceil, floor, sqrt
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

import hbr
from calibration.procedure import Ask, Evaluation, Measured, Procedure
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode
from rig.charts.xy import LIMIT, OTHER, Axis, Chart, Series
from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.core.phrases import percent
from rig.events.events import Accepted
from rig.motion.turntable import Turntable
from rig.plans.steps import capture, moved
from rig.views.capture import Viewer
from rig.views.description import within

NAME = "noise.repeatability"

AZIMUTHS = 12  # every 30°; more make each of the placements longer, and placements are what shows the scatter
ROUNDS = 2
MIN_PLACEMENTS = 2
BOOTSTRAPS = 200  # gives an uncertainty to 5 %
MAX_DRIFT = 0.02
"""Largest loss of similarity between the first and the last placement, compared with consecutive placements."""
MIN_SIMILARITY = 0.7
"""Smallest similarity of two views of the same object at the same azimuth."""


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the similarity of views over the rotation of the table between them."""
    rows, threshold = result.evidence["by_step"], result.estimates["repeatability"].value
    steps, limit = [row["step_deg"] for row in rows], f"unknown below {threshold:.3f}"
    return Chart(
        "Similarity of repeated views",
        Axis("rotation of the table, °"),
        Axis("Tanimoto similarity", span=(1.0,)),
        [
            Series("median", steps, [row["median"] for row in rows], curve=True),
            Series("tenth percentile", steps, [row["tenth"] for row in rows], OTHER, curve=True),
            Series(limit, [steps[0], steps[-1]], [threshold] * 2, LIMIT, False, True, dashed=True),
        ],
    )


@dataclass(frozen=True)
class Repeatability(Procedure):
    """A procedure that asks for the object ``thing`` at its mark several times, and takes views from all sides."""

    result_name, devices, valid_days, plots = NAME, ("camera",), 180, (plot,)
    reference = "other views of {thing}"
    thing: str
    placements: int
    error_rate: float

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        needed = needed_placements(self.error_rate)
        if self.placements < needed:
            raise UsageError(
                f"{self.placements} placements are too few for an error rate of {percent(self.error_rate)}.",
                next_step=(
                    f"Place the object {needed} times.",
                    Do.RUN_AGAIN(placements=needed),
                    "Or give a larger error rate.",
                ),
            )
        # The operator places the object again each time: views of one placement share its errors.
        viewer = Viewer(bench.camera, bench.config)
        placements: list[list[list[NDArray[np.uint8]]]] = []
        index = 0
        for number in range(1, self.placements + 1):
            again = "again: take it off and put it back" if number > 1 else "as it stands when you enroll it"
            yield Ask(
                f"Put {self.thing} at its mark on the platter, {again} (placement {number} of {self.placements}). Take "
                "your hands off.",
            )
            bench.place(self.thing)
            rounds = []
            with Turntable(bench) as table:
                # Two rounds of each placement show the noise without the placement.
                for _round in range(ROUNDS):
                    views = []
                    for step in range(AZIMUTHS):
                        move = table.goto(step * 360.0 / AZIMUTHS)
                        yield moved(index, move)
                        captured = yield from capture(index, viewer, table, move.settled_ns)
                        azimuth_deg = (-move.encoder_deg) % 360.0
                        yield Accepted(index, azimuth_deg, captured.evidence, captured.image_bgr)
                        views.append(hbr.describe(within(captured.image_bgr, bench.config.view.roi)))
                        index += 1
                    rounds.append(views)
                table.goto(0.0)
            placements.append(rounds)
        identify = bench.config.identify
        found = evaluate(
            np.array(placements),
            error_rate=self.error_rate,
            views=identify.min_views,
            first_step_deg=identify.first_step_deg,
        )
        found.evidence["object"] = self.thing
        return found


def needed_placements(error_rate: float) -> int:
    """Return the number of placements with enough comparisons between them to state the error rate."""
    pairs = ceil(1 / error_rate) - 1
    return max(MIN_PLACEMENTS, ceil((1 + sqrt(1 + 8 * pairs / AZIMUTHS)) / 2))


def evaluate(
    placements: NDArray[np.uint8], *, error_rate: float, views: int, first_step_deg: float = 90.0, seed: int = 0
) -> Evaluation:
    """Evaluate the similarity of repeated views of one object at one mark.

    ``placements`` are descriptors, uint8 (placements, rounds, azimuths, levels).
    ``error_rate`` is the share of known objects that may fall below ``identify.repeatability``. The shortest decision
    has ``views``, ``first_step_deg`` apart. ``seed`` is that of the bootstrap over azimuths.
    """
    found = Evaluation(name=NAME, residual_unit="of similarity", limit=1.0 - MIN_SIMILARITY)
    within = np.array([_similar(first, second) for first, second, *_ in placements])
    between = np.array([_similar(a, b) for a, b in combinations(placements[:, 0], 2)])
    needed = needed_placements(error_rate)
    found.reject_if(
        len(placements) < needed,
        RejectionCode.TOO_FEW_PLACEMENTS,
        placements=len(placements),
        error_rate=error_rate,
        needed=needed,
    )
    # A search decides after several views: average the similarities at the azimuths that it visits.
    shift = round(first_step_deg * AZIMUTHS / 360.0)
    decided = np.mean([np.roll(between, -shift * view, axis=1) for view in range(views)], axis=0)
    low = float(np.median(between))
    found.reject_if(low < MIN_SIMILARITY, RejectionCode.SIMILARITY_TOO_LOW, similarity=low, needed=MIN_SIMILARITY)
    # Light that drifts makes distant placements less similar than consecutive ones.
    last = len(placements) - 1
    apart = {(i, j): row for (i, j), row in zip(combinations(range(len(placements)), 2), between, strict=True)}
    neighbours = float(np.median([apart[i, i + 1] for i in range(last)]))
    drift = neighbours - float(np.median(apart[0, last]))
    found.reject_if(last > 1 and drift > MAX_DRIFT, RejectionCode.LIGHT_DRIFTS_BETWEEN_PLACEMENTS, drift=drift)

    def figures(chosen: NDArray[np.int64]) -> tuple[float, float, float, float]:
        some_within, some_between = within[:, chosen], between[:, chosen]
        ordered = np.sort(decided[:, chosen].ravel())
        quantile = float(ordered[max(floor(error_rate * (ordered.size + 1)) - 1, 0)])
        # Scatter about the mean of each azimuth, because the mean depends on the object and is in every score.
        scatter = float(np.sqrt(some_between.var(axis=0, ddof=min(1, len(between) - 1)).mean()))
        return float(np.median(some_within)), float(np.median(some_between)), quantile, scatter

    # The uncertainty from drawing azimuths again: those of one object are the independent data.
    values = figures(np.arange(AZIMUTHS))
    rng = np.random.default_rng(seed)
    drawn = np.array([figures(rng.integers(0, AZIMUTHS, AZIMUTHS)) for _ in range(BOOTSTRAPS)])
    names = ("repeat", "placed_again", "repeatability", "scatter")
    for name, value, sigma in zip(names, values, drawn.std(axis=0, ddof=1), strict=True):
        chance = Contribution("chance in the azimuths (bootstrap)", "A", float(sigma), "of similarity")
        found.estimate(name, value, "of similarity", chance)
    margin = NormalDist().inv_cdf(1 - error_rate) * sqrt(2 / views) * values[3]
    found.residual = 1.0 - low
    found.proposed = {"identify.repeatability": round(values[2], 4), "identify.margin": round(min(margin, 1.0), 4)}
    found.evidence = {
        "error_rate": error_rate,
        "views_of_a_decision": views,
        "within": within.round(4).tolist(),
        "between": between.round(4).tolist(),
        "by_step": _by_step(placements),
    }
    return found


def _similar(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the Tanimoto similarity of views of the same azimuth, float64 (azimuths,)."""
    return np.diag(hbr.tanimoto(a, b))


def _by_step(placements: NDArray[np.uint8]) -> list[dict[str, float]]:
    """Return median and tenth percentile of the similarity of views that are 0, 1, 2, ... steps apart."""
    curve = []
    for step in range(AZIMUTHS // 2 + 1):
        values = [_similar(first, np.roll(second, step, axis=0)) for first, second, *_ in placements]
        curve.append(
            {
                "step_deg": step * 360.0 / AZIMUTHS,
                "median": round(float(np.median(values)), 4),
                "tenth": round(float(np.quantile(values, 0.1)), 4),
            }
        )
    return curve
