"""Error rates for unknown objects: shares of accepted unknown objects and of rejected enrolled objects."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from hbr.core.arrays import BoolArray
from hbr.dense.fitting import conformal_threshold, rule_from_searches
from hbr.dense.index import DenseIndex
from hbr.dense.leave_one_out import LeaveOneOut, fitting_searches
from hbr.dense.stopping import Leaders, StoppingRule, usual_scores
from hbr.evaluation.condition import query_levels
from hbr.evaluation.experiment import Experiment, Kind
from hbr.evaluation.photographs import Dataset
from hbr.evaluation.protocol import METHODS, Protocol, Runs, generator, views_of_trial
from hbr.evaluation.statistics import wilson
from hbr.evaluation.trials import all_views, enroll, run_object
from hbr.model.views import Views

#: Nominal shares of enrolled objects that may be called unknown, and draws of left-out objects.
_NOMINAL: Final = (0.005, 0.01, 0.02, 0.05)
_DRAWS: Final = 5  # more: narrower intervals, at one evaluation each


@dataclass(frozen=True)
class UnknownObjects:
    """Results after ``views`` views, over all draws of objects that were left out.

    If ``fitted``, the thresholds are those of the stopping rule that a bench fits to the enrolled views.
    Otherwise the first third of the enrolled objects' trials gives the usual scores, the second third the thresholds,
    and the last third the false rejects.
    """

    fitted: bool
    views: int
    nominal: float
    known_trials: int
    false_rejects: int
    unknown_trials: int
    false_accepts: int


def left_out(protocol: Protocol, names: tuple[str, ...], count: int, draws: int) -> tuple[Protocol, ...]:
    """Return `draws` protocols with `count` absent objects, drawn at random; each draw has its own trials.

    Raises
    ------
    ValueError
        Fewer than two objects would be left.
    """
    if not 1 <= count <= len(names) - 2:
        raise ValueError(f"{count} of {len(names)} objects cannot be left out; at least two must stay enrolled")
    drawn = []
    for draw in range(draws):
        # "strangers" seeds the draws of the published figures: another word would draw other objects.
        absent = generator(protocol.seed, "strangers", "trial", draw).choice(len(names), count, replace=False)
        chosen = tuple(names[j] for j in sorted(absent.tolist()))
        drawn.append(replace(protocol, absent=chosen, seed=protocol.seed + draw))
    return tuple(drawn)


def unknown_objects(
    parts: Sequence[tuple[Runs, BoolArray]], false_reject: float, rules: Sequence[StoppingRule] = ()
) -> tuple[UnknownObjects, ...]:
    """Count false rejects and false accepts at a nominal false-reject rate.

    Parameters
    ----------
    parts : sequence of (Runs, bool array (objects,))
        For each draw, the runs of all objects with one method of the dense filter, and which objects were absent.
    false_reject : float
        Share of enrolled objects that may be called unknown.
    rules : sequence of StoppingRule, optional
        For each draw, the rule that was fitted for this rate; default: thresholds come from trials.
    """
    views = parts[0][0].score.shape[-1]
    counts = np.zeros((views, 4), int)
    for d, (runs, absent) in enumerate(parts):
        unknown = _leaders(runs, absent, slice(None))
        if rules:
            known = _leaders(runs, ~absent, slice(None))
            last = np.minimum(np.arange(views), len(rules[d].open_set_thresholds) - 1)
            usual, thresholds = rules[d].usual_scores[:, last], np.array(rules[d].open_set_thresholds)[last]
        else:
            third = runs.score.shape[2] // 3
            first, second, known = (
                _leaders(runs, ~absent, slice(start, end))
                for start, end in ((0, third), (third, 2 * third), (2 * third, None))
            )
            correct = first.object_index == np.repeat(np.flatnonzero(~absent), third)[:, None]
            usual = usual_scores(first, correct, len(absent))
            measured = second.open_set_score(usual)
            thresholds = np.array([conformal_threshold(measured[:, n], false_reject) for n in range(views)])
        rejected, accepted = known.open_set_score(usual) < thresholds, unknown.open_set_score(usual) >= thresholds
        for column, counted in enumerate((rejected, accepted)):
            counts[:, 2 * column] += len(counted)
            counts[:, 2 * column + 1] += counted.sum(axis=0)
    return tuple(UnknownObjects(bool(rules), n + 1, false_reject, *row) for n, row in enumerate(counts.tolist()))


def _leaders(runs: Runs, objects: BoolArray, trials: slice) -> Leaders:
    """Return the leaders of these objects' trials, (objects * trials, views)."""
    parts = (part[0, objects][:, trials] for part in (runs.best, runs.score, runs.margin))
    return Leaders(*(part.reshape(-1, part.shape[-1]) for part in parts))


class _FittedModel(NamedTuple):
    """All views, and for each draw its protocol, and the fitted rules by nominal rate."""

    views: Views
    protocols: tuple[Protocol, ...]
    rules: dict[float, list[StoppingRule]]


def _model(experiment: Experiment, dataset: Dataset, enrolled: list[Any]) -> _FittedModel:
    views = all_views(experiment, dataset, enrolled)
    protocols = left_out(experiment.protocol, views.object_names, experiment.left_out, _DRAWS)
    searches = [_searches(views, protocol) for protocol in protocols]
    rules = {rate: [rule_from_searches(one, false_reject=rate) for one in searches] for rate in _NOMINAL}
    return _FittedModel(views, protocols, rules)


def _searches(views: Views, protocol: Protocol) -> LeaveOneOut:
    searches = fitting_searches(DenseIndex(views.select(views_of_trial(views, protocol))))
    if searches is None:
        raise ValueError(
            "objects with a single enrolled view are too few for a stopping rule; enroll more views of each"
        )
    return searches


def _search(
    experiment: Experiment, dataset: Dataset, model: _FittedModel, _now_ns: Callable[[], int], j: int
) -> list[Runs]:
    queries = query_levels(dataset, j, experiment.condition, experiment.protocol.seed).levels
    draws = zip(model.protocols, model.rules[_NOMINAL[0]], strict=True)
    return [run_object(j, queries, model.views, (METHODS["dense"],), one, rule=rule) for one, rule in draws]


def _results(experiment: Experiment, dataset: Dataset, model: _FittedModel, found: list[list[Runs]]) -> dict[str, Any]:
    names = np.array(model.views.object_names)
    parts = [
        (Runs.concatenate([runs[draw] for runs in found]), np.isin(names, protocol.absent))
        for draw, protocol in enumerate(model.protocols)
    ]
    rows = []
    for rate in _NOMINAL:
        for row in (*unknown_objects(parts, rate), *unknown_objects(parts, rate, model.rules[rate])):
            low, high = wilson(row.false_accepts, row.unknown_trials)
            rows.append({**asdict(row), "false_accepts_low": low, "false_accepts_high": high})
    return {"settings": experiment.settings(dataset), "rows": rows}


UNKNOWN_OBJECTS: Final = Kind(enroll, _model, _search, _results)
