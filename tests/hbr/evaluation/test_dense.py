"""Trials of the dense filter: fewer enrolled views, unknown objects, and its own strategies."""

from dataclasses import replace

import numpy as np
import pytest

from hbr import DenseIndex, Outcome, next_best_view
from hbr.core.angles import wrap180
from hbr.dense.stopping import decide
from hbr.evaluation.protocol import METHODS, OUTCOMES, Protocol, Runs, choose_methods
from hbr.evaluation.results import contests, method_results
from hbr.evaluation.trials import _Trials, run_object
from tests.hbr.dense.searches import belief_after
from tests.hbr.evaluation.test_protocol import QUERIES, STEP, VIEWS

PROTOCOL = Protocol(trials=3, max_views=4, enrolled=8, removal="queries")


def run(name: str, j: int = 2, protocol: Protocol = PROTOCOL) -> Runs:
    return run_object(j, QUERIES[VIEWS.of(j)], VIEWS, choose_methods(name.split(",")), protocol)


@pytest.mark.parametrize(
    ("name", "protocol"),
    [
        *((name, PROTOCOL) for name in ("dense", "dense-90", "dense-random", "dense-coin")),
        ("dense", Protocol(trials=2, max_views=4, near_deg=20)),
    ],
)
def test_trial_equals_the_literal_protocol(name: str, protocol: Protocol) -> None:
    j = 2
    own = VIEWS.of(j)
    runs = run(name, j, protocol)
    trials = _Trials(j, QUERIES[own], VIEWS, protocol, lambda: 0)
    ring = np.arange(24)
    kept = ring % 3 == 0 if protocol.enrolled else ring >= 0
    for t in range(protocol.trials):
        draws = trials.draw(t)
        seen = [int(draws.order[0])]
        for n in range(protocol.max_views):
            angles = np.array(seen) * STEP
            mine = kept.copy()
            if not protocol.enrolled:
                mine &= [min(abs((i * STEP - a + 180) % 360 - 180) for a in angles) >= 20 for i in ring]
            mask = np.tile(kept, 6)
            whole = DenseIndex(VIEWS.select(mask), omega=METHODS[name].omega)
            gone = own[kept & ~mine]
            index = whole.without(np.searchsorted(np.flatnonzero(mask), gone))
            belief = belief_after(QUERIES[own[seen]], angles + draws.error_deg[: n + 1], index)
            ranking = belief.ranking()
            assert runs.rank[0, 0, t, n] == ranking.object_index.tolist().index(j) + 1
            assert runs.score[0, 0, t, n] == ranking.scores[0]
            decision = decide(belief, last=n == 3)
            assert OUTCOMES[runs.outcome[0, 0, t, n]] is decision.outcome
            best = next_best_view(belief, not_enrolled=decision.not_enrolled)
            match name:
                case "dense":
                    step = best.rotation_deg
                case "dense-coin":
                    step = abs(best.rotation_deg) * (1 if draws.coins[len(seen) % 4] else -1)
                case "dense-90":
                    step = 90.0
                case _:
                    step = wrap180(float(draws.order[(n + 1) % 4] * STEP - angles[-1]))
            left = [i for i in ring if i not in seen and not (protocol.enrolled and kept[i])]
            seen.append(min(left, key=lambda i: abs((i * STEP - angles[-1] - step + 180) % 360 - 180)))


def test_queries_are_views_that_are_not_enrolled() -> None:
    trials = _Trials(1, QUERIES[VIEWS.of(1)], VIEWS, PROTOCOL, lambda: 0)
    for t in range(20):
        assert (trials.draw(t).order % 3 != 0).all()
    following = [trials._next(trials.draw(0), [1], rotation, 4) for rotation in np.arange(0, 360, 7.0)]
    assert (np.array(following) % 3 != 0).all()
    with pytest.raises(ValueError, match="16 views; for 16 queries"):
        run("dense-90", protocol=replace(PROTOCOL, max_views=16))


def test_oracle_has_a_larger_margin_than_a_fixed_step() -> None:
    margins = {
        name: np.mean([run(name, j).margin[0, 0, :, 1].mean() for j in range(6)])
        for name in ("dense-oracle", "dense-90")
    }
    assert margins["dense-oracle"] > margins["dense-90"]


def test_dense_searches_end_by_the_stopping_rule_and_methods_are_compared() -> None:
    methods = choose_methods(["dense", "dense-90", "dense-mutual", "hbr"])
    runs = Runs.concatenate([run("dense,dense-90,dense-mutual,hbr", j) for j in range(6)])
    runs.named[0] = True
    runs.outcome[0] = [OUTCOMES.index(Outcome.CONTINUE)] * 2 + [OUTCOMES.index(Outcome.FOUND)] * 2
    runs.outcome[0, 0, :, 2:] = OUTCOMES.index(Outcome.UNKNOWN)
    runs.outcome[0, 1, :, 2:] = OUTCOMES.index(Outcome.AMBIGUOUS)  # the right object leads, but was not found
    stopping = method_results(runs, methods, margin=10.0)[0]["stopping"]
    assert (stopping["views_mean"], stopping["ended_early"]) == (3, 1.0)
    rates = [stopping[f"{name}_rate"] for name in ("hit", "unknown", "ambiguous", "wrong")]
    assert rates == pytest.approx([4 / 6, 1 / 6, 1 / 6, 0])
    runs.named[0, 2, 0, 2] = False  # the ranking does not count: the fit of the pixels may name another object
    assert method_results(runs, methods, margin=10.0)[0]["stopping"]["wrong_rate"] == pytest.approx(1 / 18)
    assert method_results(runs, methods, margin=10.0)[3]["stopping"]["views_mean"] == 4
    asked = {(c["first"], c["first_views"], c["second"]) for c in contests(runs, methods, np.random.default_rng(0))}
    assert {("dense", 3, "dense-90"), ("dense", 2, "dense-mutual")} <= asked
