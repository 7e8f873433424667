"""When the dense search ends and what it calls unknown: rehearsed on a catalog, kept beside it, renewed with it.

`hbr.rehearse` and `hbr.rules` do the work. Here is what a bench needs beyond them: what to do where there is too little
data to promise the rates that were asked for, and whose rules the stored ones are.
"""

import json
from collections import Counter
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib.metadata import version
from math import ceil, inf, isfinite, nan
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.dense.filter import BETA
from hbr.dense.stopping import Rehearsal, conformal_threshold
from hbr.descriptors import descriptor
from rig.core.errors import CatalogError
from rig.core.files import write
from rig.events.wording import counted

FILE: Final = "search_rules.json"
"""Beside ``catalog.sqlite``."""
FORMAT: Final = "hbr-rig search rules"
VERSION: Final = 1
ERROR_RATE: Final = 0.01
FALSE_REJECT: Final = 0.02
VIEWS: Final = 4
"""Views of a rehearsed search, where the objects have enough."""
ENOUGH: Final = 400
"""Searches of a rehearsal, from different first views; one for each object where there are more objects."""
UNPROMISED: Final = 0.98
"""Probability that ends a search where no error rate can be promised."""

_KNOWN_SHARE: Final = 0.5
_QUICK_S: Final = 0.4
_LEAST_QUICK_S: Final = 0.08
_LOADED_S: Final = 5e-6
"""What a rehearsal may take that nobody asked for, and at least; less by so much for each view that was loaded."""
_SEARCH_S, _VIEW_S = 1.4e-3, 1.3e-6
"""What a rehearsed search takes, and how much more for each enrolled view."""


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """Rules, and what they made of the searches that they come from.

    Attributes
    ----------
    rules : hbr.Rules
        See there; ``promises`` says what is not promised, and how much more data it takes.
    views
        Of each search.
    ended, wrong
        Searches that ended by their probability, and those of them with a wrong object.
    mean_views
        That they took; nan where none ended.
    rejected
        Searches for enrolled objects that ended "unknown" after the last view.
    accepted
        Searches for objects that were left out, and did not; None where that cannot be rehearsed.
    taken_for
        Which objects those were, and what they were taken for: the three most frequent pairs of names.
    """

    rules: hbr.Rules
    views: int = 0
    ended: int = 0
    wrong: int = 0
    mean_views: float = nan
    rejected: int = 0
    accepted: int | None = None
    taken_for: tuple[tuple[str, str], ...] = ()


def rehearse(
    index: hbr.DenseIndex,
    *,
    error_rate: float = ERROR_RATE,
    false_reject: float = FALSE_REJECT,
    quick: bool = False,
) -> Rehearsed:
    """Look for the enrolled objects among each other, and return the rules that follow.

    Where there is too little data for a rate that was asked for, the rules do their best and promise nothing: a search
    ends at a probability of 0.98, and unknown is what is less familiar than every rehearsed search was. What is not
    promised, and how much more data it takes, stands in ``promises``.

    Parameters
    ----------
    index : hbr.DenseIndex
        Of at least one object.
    error_rate, false_reject
        Shares of wrong answers, and of enrolled objects called unknown.
    quick
        Take a sample that does not keep anybody waiting.
    """
    views = rehearsed_views(index)
    places = np.arange(len(index))
    budget_s = max(_QUICK_S - _LOADED_S * len(index.views), _LEAST_QUICK_S)
    most = _affordable(len(index.views), budget_s) if quick else ENOUGH
    searches = min(most // len(index), int(index.rows.shape[1]))
    sampled = not searches
    if sampled and quick:
        # a sample of the objects, each looked for once among the others of the sample
        each = len(index.views) // len(index)
        few = max(2, next(n for n in range(len(index), 0, -1) if n <= _affordable(n * each, budget_s)))
        places = np.unique(np.linspace(0, len(index) - 1, few).astype(int))
    searches = max(1, searches)
    if len(index) < 2 or not views:
        return _alone(index, error_rate, false_reject)
    rehearsed = hbr.rehearse(index.only(places), beta=BETA, views=views, searches=searches)
    return _with_what_is_known(rehearsed, index, error_rate, false_reject, of=len(places))


def _affordable(views: int, budget_s: float) -> int:
    """Searches among so many enrolled views within the time."""
    return int(budget_s / (_SEARCH_S + _VIEW_S * views))


def rehearsed_views(index: hbr.DenseIndex) -> int:
    """Return how many views a rehearsed search has: four, or as many as most objects have; 0 of a single one."""
    usual = int(np.median((~index.left_out).sum(axis=1)))
    return min(VIEWS, usual) if usual > 1 else 0


def _with_what_is_known(
    rehearsed: Rehearsal, index: hbr.DenseIndex, error_rate: float, false_reject: float, *, of: int
) -> Rehearsed:
    found = hbr.rules(rehearsed, error_rate=error_rate, false_reject=false_reject)
    searches, views = rehearsed.posterior.shape
    promises = []
    if of < len(index):
        promises.append(
            f"{of} of {counted(len(index), 'object')} were looked for, among each other alone: no rate is promised; "
            "rig catalog calibrate looks for all"
        )
    usual = found.usual
    known, stranger = (one.familiarity(usual) for one in (rehearsed.known, rehearsed.stranger))
    familiar = found.familiar
    if familiar[-1] == -inf:
        least = 1 / (searches + 1)
        familiar = tuple(conformal_threshold(known[:, n], least + 1e-9) for n in range(views))
        promises.append(
            f"a false-reject rate of {false_reject:.1%} takes {ceil(1 / false_reject) - 1} rehearsed searches, and "
            f"there are {searches}: what is less familiar than all of them is called unknown, a rate of {least:.1%}"
        )
    promised = found.certainty <= 1
    certainty = found.certainty if promised else UNPROMISED
    ends = rehearsed.posterior >= certainty
    at = np.flatnonzero(ends.any(axis=1))
    first = ends[at].argmax(axis=1)
    wrong = int((~rehearsed.correct[at, first]).sum())
    if not promised:
        needed = ceil(1 / error_rate)
        why = (
            f"takes {needed} rehearsed searches, and there are {searches}"
            if searches < needed
            else "is not to be had, enrolled objects look too much alike"
        )
        promises.append(
            f"an error rate of {error_rate:.1%} {why}: a search ends at a probability of {certainty:.0%}, where "
            f"{wrong} of {len(at)} were wrong"
        )
    accepted: int | None = int((stranger[:, -1] >= familiar[-1]).sum())
    if of < 3:
        accepted = None
        promises.append("strangers cannot be rehearsed with fewer than three objects; enroll more")
    rules = replace(
        found,
        certainty=certainty,
        familiar=familiar,
        false_accept=nan if accepted is None else accepted / searches,
        promises=tuple(promises),
    )
    return Rehearsed(
        rules,
        views=views,
        ended=len(at),
        wrong=wrong,
        mean_views=float(first.mean() + 1) if len(at) else nan,
        rejected=int((known[:, -1] < familiar[-1]).sum()),
        accepted=accepted,
        taken_for=_taken_for(rehearsed, stranger[:, -1] >= familiar[-1], index.views.object_names),
    )


def _taken_for(
    rehearsed: Rehearsal, accepted: NDArray[np.bool_], names: tuple[str, ...]
) -> tuple[tuple[str, str], ...]:
    which = accepted & rehearsed.correct[:, -1]  # where it was found, it is known what was looked for
    pairs = Counter(
        zip(
            rehearsed.known.object_index[which, -1].tolist(),
            rehearsed.stranger.object_index[which, -1].tolist(),
            strict=True,
        )
    )
    return tuple((names[one], names[other]) for (one, other), _ in pairs.most_common(3))


def _alone(index: hbr.DenseIndex, error_rate: float, false_reject: float) -> Rehearsed:
    """The rules where nothing can be rehearsed against anything: one object, or objects of a single view."""
    objects = len(index.views.object_names)
    familiar, searches = -inf, 0
    if len(index) == 1 and len(index.views) > 1:
        levels, azimuth_deg = index.views.descriptors, index.views.azimuth_deg
        scores = [
            float(hbr.update_belief(levels[row], azimuth_deg[row], index.without(np.array([row]))).scores()[0])
            for row in range(len(levels))
        ]
        # as `hbr.judge` has it, whose lead over no second is the whole score
        familiar, searches = 1.5 * min(scores), len(scores)
        reason = "one object has no rival: it is found by likeness to its own views alone, and no rate is promised"
    else:
        reason = "objects of a single view cannot be rehearsed: nothing is called unknown, and no rate is promised"
    rules = hbr.Rules(
        BETA,
        UNPROMISED,
        np.zeros((objects, 1)),
        (familiar,),
        error_rate,
        false_reject,
        nan,
        searches,
        (f"{reason}; enroll more",),
    )
    return Rehearsed(rules, views=1)


@dataclass(frozen=True, eq=False)
class Stored:
    """Rules as they are kept: with the model that they were rehearsed on.

    Attributes
    ----------
    rules : hbr.Rules
        Its ``usual`` in the order of `objects`.
    objects
        Names of the objects.
    sha256
        Of the model (`digest`).
    made_utc
        When, as ISO 8601 has it.
    """

    rules: hbr.Rules
    objects: tuple[str, ...]
    sha256: str
    made_utc: str

    def adapted(self, views: hbr.Views) -> hbr.Rules:
        """Return the rules for other views: objects that they do not know count as usual ones."""
        usual = self.rules.usual
        typical = np.median(usual, axis=0)
        rows = {name: row for row, name in enumerate(self.objects)}
        return replace(
            self.rules,
            usual=np.array([usual[rows[name]] if name in rows else typical for name in views.object_names]),
        )


def digest(index: hbr.DenseIndex) -> str:
    """Return a digest of a model: its objects, their views, the descriptor's version, and the program that searches."""
    views = index.views
    kind = descriptor(views.descriptor)
    searched = [version("hbr-rig"), kind.name, kind.version, index.omega, index.power, BETA]
    found = sha256(json.dumps([searched, views.object_names], ensure_ascii=False).encode())
    for column in (views.object_index.astype("<i8"), views.azimuth_deg.astype("<f8"), views.descriptors):
        found.update(np.ascontiguousarray(column).data)
    return found.hexdigest()


def rules_of(folder: Path, index: hbr.DenseIndex) -> tuple[hbr.Rules, tuple[str, ...]]:
    """Return the rules for a model, and what a person should know of them.

    The stored ones, where they are of this model. Where the catalog has changed since, they are rehearsed anew if all
    objects can be without anybody waiting; else the stored ones go on, and objects that they do not know are taken for
    usual ones. Where none are stored, or those of another catalog, which know less than half of the objects, a quick
    rehearsal makes them.
    """
    notes: list[str] = []
    try:
        stored = read_rules(folder)
    except CatalogError as error:
        stored = None
        notes.append(f"{error.what}; {error.next_step}")
    if stored is not None and stored.sha256 == digest(index):
        return stored.rules, _unpromised(stored.rules)
    if stored is None:
        found = rehearse(index, quick=True).rules
        return found, (*notes, *_unpromised(found))
    asked, names = stored.rules, index.views.object_names
    foreign = len(set(names) & set(stored.objects)) < _KNOWN_SHARE * len(names)
    if foreign or _affordable(len(index.views), _QUICK_S) >= len(index):
        found = rehearse(index, error_rate=asked.error_rate, false_reject=asked.false_reject, quick=True).rules
        return found, (*notes, *_unpromised(found))
    changed = _changes(stored.objects, names)
    notes.append(
        f"the search rules are of {stored.made_utc[:10]}, and the catalog has changed since ({changed}): they are used "
        "as they are and promise nothing; rig catalog calibrate renews them"
    )
    return stored.adapted(index.views), tuple(notes)


def _unpromised(rules: hbr.Rules) -> tuple[str, ...]:
    if not rules.promises:
        return ()
    return (
        f"{rules.searches} rehearsed searches cannot promise at most {rules.error_rate:.1%} wrong answers and "
        f"{rules.false_reject:.1%} of the enrolled objects called unknown; rig catalog calibrate says why",
    )


def _changes(before: tuple[str, ...], now: tuple[str, ...]) -> str:
    added, gone = len(set(now) - set(before)), len(set(before) - set(now))
    parts = [f"{counted(n, 'object')} {what}" for n, what in ((added, "more"), (gone, "gone")) if n]
    return ", ".join(parts) or "other views, or another version of this program"


def rules_values(rules: hbr.Rules, index: hbr.DenseIndex, *, made_utc: str) -> dict[str, Any]:
    """Return rules as JSON values; what is not finite is null."""
    views = index.views
    kind = descriptor(views.descriptor)
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": f"hbr-rig {version('hbr-rig')}",
        "made_utc": made_utc,
        "model": {
            "descriptor": {"name": kind.name, "version": kind.version},
            "objects": len(views.object_names),
            "views": len(views),
            "sha256": digest(index),
        },
        "error_rate": rules.error_rate,
        "false_reject": rules.false_reject,
        "false_accept": _finite(rules.false_accept),
        "searches": rules.searches,
        "promises": list(rules.promises),
        "beta": rules.beta,
        "certainty": _finite(rules.certainty),
        "familiar": [_finite(least) for least in rules.familiar],
        "usual": {name: usual.tolist() for name, usual in zip(views.object_names, rules.usual, strict=True)},
    }


def write_rules(path: Path, rules: hbr.Rules, index: hbr.DenseIndex, *, made_utc: str) -> None:
    """Keep rules in a file, whole or not at all.

    Raises
    ------
    CatalogError
        The disk is full, or the folder may not be written to.
    """
    values = rules_values(rules, index, made_utc=made_utc)
    text = json.dumps(values, ensure_ascii=False, indent=1, allow_nan=False)
    try:
        write(path, (text + "\n").encode())
    except OSError as error:
        raise CatalogError(
            f"the search rules cannot be written to {path}",
            next_step="free space on the disk, or ask who owns the folder for leave to write",
            evidence={"reason": error.strerror or str(error)},
        ) from error


def read_rules(folder: Path) -> Stored | None:
    """Read the rules in a folder; None where there are none.

    Raises
    ------
    CatalogError
        The file is damaged, of a newer version, or cannot be read.
    """
    path = folder / FILE
    try:
        values = json.loads(path.read_bytes())
        if values["format"] != FORMAT or values["version"] != VERSION:
            raise ValueError(f"its format is {values['format']} {values['version']}")
        usual = {str(name): [float(score) for score in scores] for name, scores in values["usual"].items()}
        rules = hbr.Rules(
            beta=float(values["beta"]),
            certainty=_or(values["certainty"], inf),
            usual=np.array(list(usual.values()), np.float64),
            familiar=tuple(_or(least, -inf) for least in values["familiar"]),
            error_rate=float(values["error_rate"]),
            false_reject=float(values["false_reject"]),
            false_accept=_or(values["false_accept"], nan),
            searches=int(values["searches"]),
            promises=tuple(str(words) for words in values["promises"]),
        )
        if rules.usual.ndim != 2 or rules.usual.shape[1] != len(rules.familiar) or not np.isfinite(rules.usual).all():
            raise ValueError("not one usual score for each object and number of views")
        return Stored(rules, tuple(usual), str(values["model"]["sha256"]), str(values["made_utc"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CatalogError(
            f"the search rules in {path} cannot be read",
            next_step="rig catalog calibrate makes them anew",
            evidence={"reason": str(error)},
        ) from error


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else float(value)
