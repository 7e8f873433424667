"""Objects that were never enrolled: how often they are taken for one that was, and what that costs the others."""

from dataclasses import dataclass, replace

import numpy as np

from hbr.arrays import BoolArray
from hbr.deciding import Leaders, conformal_threshold, usual_scores
from hbr.evaluation.draws import generator
from hbr.evaluation.protocol import Protocol, Runs


@dataclass(frozen=True)
class Stranger:
    """After so many views, over all draws of objects that were left out.

    False rejects are of the second half of the known objects' trials, against thresholds from the first half.
    """

    views: int
    nominal: float
    known_trials: int
    false_rejects: int
    stranger_trials: int
    false_accepts: int


def left_out(protocol: Protocol, names: tuple[str, ...], count: int, draws: int) -> tuple[Protocol, ...]:
    """Return the protocol with so many objects absent, drawn at random, a few times; each draw has trials of its own.

    Raises
    ------
    ValueError
        Fewer than two objects would be left.
    """
    if not 1 <= count <= len(names) - 2:
        raise ValueError(f"{count} of {len(names)} objects cannot be left out; at least two must stay enrolled")
    drawn = []
    for draw in range(draws):
        absent = generator(protocol.seed, "strangers", "trial", draw).choice(len(names), count, replace=False)
        chosen = tuple(names[j] for j in sorted(absent.tolist()))
        drawn.append(replace(protocol, absent=chosen, seed=protocol.seed + draw))
    return tuple(drawn)


def strangers(parts: list[tuple[Runs, BoolArray]], false_reject: float) -> tuple[Stranger, ...]:
    """Judge the draws at a nominal false-reject rate.

    Parameters
    ----------
    parts : list of (Runs, bool array (objects,))
        Of each draw the runs of all objects by one method of the dense filter, and which were absent.
    false_reject : float
        Share of known objects' searches that may be called unknown.
    """
    views = parts[0][0].score.shape[-1]
    rows = []
    for n in range(views):
        rejects = accepts = known_trials = stranger_trials = 0
        for runs, absent in parts:
            half = runs.score.shape[2] // 2
            first, second, strange = (
                _leaders(runs, rows, trials)
                for rows, trials in ((~absent, slice(half)), (~absent, slice(half, None)), (absent, slice(None)))
            )
            asked = np.repeat(np.flatnonzero(~absent), half)[:, None]
            usual = usual_scores(first, first.object_index == asked, len(absent))
            threshold = conformal_threshold(first.familiarity(usual)[:, n], false_reject)
            known, stranger = second.familiarity(usual)[:, n], strange.familiarity(usual)[:, n]
            rejects += int((known < threshold).sum())
            accepts += int((stranger >= threshold).sum())
            known_trials += known.size
            stranger_trials += stranger.size
        rows.append(Stranger(n + 1, false_reject, known_trials, rejects, stranger_trials, accepts))
    return tuple(rows)


def _leaders(runs: Runs, objects: BoolArray, trials: slice) -> Leaders:
    """Of these objects' trials, (objects * trials, views)."""
    parts = (part[0, objects][:, trials] for part in (runs.best, runs.score, runs.lead))
    return Leaders(*(part.reshape(-1, part.shape[-1]) for part in parts))
