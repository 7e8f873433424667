"""Objects that were never enrolled: how often they are taken for one that was, and what that costs the others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hbr.core.arrays import BoolArray
from hbr.dense.stopping import Leaders, Rehearsal, conformal_threshold, usual_scores
from hbr.evaluation.draws import generator
from hbr.evaluation.protocol import Protocol, Runs


@dataclass(frozen=True)
class Stranger:
    """After so many views, over all draws of objects that were left out.

    False rejects are of the last third of the known objects' trials: what each object usually scores comes from the
    first third, thresholds from the second. Or, where the catalog was rehearsed, of all against its thresholds.
    """

    rehearsed: bool
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


def strangers(
    parts: Sequence[tuple[Runs, BoolArray]], false_reject: float, rehearsals: Sequence[Rehearsal] = ()
) -> tuple[Stranger, ...]:
    """Judge the draws at a nominal false-reject rate.

    Parameters
    ----------
    parts : sequence of (Runs, bool array (objects,))
        Of each draw the runs of all objects by one method of the dense filter, and which were absent.
    false_reject : float
        Share of known objects' searches that may be called unknown.
    rehearsals : sequence of Rehearsal, optional
        Of each draw's catalog: thresholds come from them instead of from trials.
    """
    views = parts[0][0].score.shape[-1]
    counts = np.zeros((views, 4), int)
    for d, (runs, absent) in enumerate(parts):
        third = runs.score.shape[2] // 3
        strange = _leaders(runs, absent, slice(None))
        if rehearsals:
            known, sample = _leaders(runs, ~absent, slice(None)), rehearsals[d].known
            usual = usual_scores(sample, rehearsals[d].correct, len(absent))
        else:
            first = _leaders(runs, ~absent, slice(third))
            sample, known = (
                _leaders(runs, ~absent, part) for part in (slice(third, 2 * third), slice(2 * third, None))
            )
            correct = first.object_index == np.repeat(np.flatnonzero(~absent), third)[:, None]
            usual = usual_scores(first, correct, len(absent))
        measured = sample.familiarity(usual)
        for n in range(views):
            threshold = conformal_threshold(measured[:, n], false_reject)
            familiar, odd = known.familiarity(usual)[:, n], strange.familiarity(usual)[:, n]
            counts[n] += len(familiar), (familiar < threshold).sum(), len(odd), (odd >= threshold).sum()
    return tuple(Stranger(bool(rehearsals), n + 1, false_reject, *row) for n, row in enumerate(counts.tolist()))


def _leaders(runs: Runs, objects: BoolArray, trials: slice) -> Leaders:
    """Of these objects' trials, (objects * trials, views)."""
    parts = (part[0, objects][:, trials] for part in (runs.best, runs.score, runs.lead))
    return Leaders(*(part.reshape(-1, part.shape[-1]) for part in parts))
