"""Objects that were never enrolled: how often they are taken for one that was, and what that costs the others."""

from dataclasses import dataclass, replace

from hbr.arrays import BoolArray
from hbr.deciding import LEAD, conformal_threshold
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
            familiar = (runs.score + LEAD * runs.lead)[0, ..., n]
            known, strange = familiar[~absent], familiar[absent]
            half = known.shape[1] // 2
            threshold = conformal_threshold(known[:, :half], false_reject)
            rejects += int((known[:, half:] < threshold).sum())
            accepts += int((strange >= threshold).sum())
            known_trials += known[:, half:].size
            stranger_trials += strange.size
        rows.append(Stranger(n + 1, false_reject, known_trials, rejects, stranger_trials, accepts))
    return tuple(rows)
