"""The trials of an experiment: each equals its literal protocol."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

import hbr
from hbr import DenseIndex, Outcome, ViewIndex, Views, next_best_view
from hbr.dense.stopping import decide
from hbr.evaluation.protocol import METHODS, OUTCOMES, Method, Protocol, Runs, choose_methods
from hbr.evaluation.results import contests, method_results
from hbr.evaluation.trials import _Trials, run_object
from hbr.paper.hmm import CONFIDENT, PoseBelief, PoseModel, update_poses
from tests.hbr.dense.searches import belief_after

STEP = 15
ALL = choose_methods(["all"])


def world(seed: int = 0, objects: int = 6) -> tuple[Views, np.ndarray]:
    """Return objects whose levels change slowly around them, and all their views with errors as the queries."""
    rng = np.random.default_rng(seed)
    azimuth = np.arange(0, 360, STEP, dtype=float)
    rotation = np.radians(azimuth)[:, None]
    parts = []
    for j in range(objects):
        used = rng.random(144) < 0.15
        mean, swing, phase = rng.uniform(1, 5, 144), rng.uniform(0, 3, 144), rng.uniform(0, 7, 144)
        levels = np.rint(np.clip(mean + swing * np.sin(rotation + phase), 0, 7)) * used
        parts.append(Views.of_object(f"object {j}", levels.astype(np.uint8), azimuth))
    views = Views.concatenate(parts)
    errors = rng.integers(-2, 3, views.descriptors.shape) * (rng.random(views.descriptors.shape) < 0.3)
    return views, np.clip(views.descriptors + errors, 0, 7).astype(np.uint8)


VIEWS, QUERIES = world()
PROTOCOL = Protocol(trials=3, max_views=5, near_deg=20)


def trials_of(j: int, protocol: Protocol) -> _Trials:
    return _Trials(j, QUERIES[VIEWS.of(j)], VIEWS, protocol, lambda: 0)


def run(j: int, methods: tuple[Method, ...] = ALL, protocol: Protocol = PROTOCOL) -> Runs:
    return run_object(j, QUERIES[VIEWS.of(j)], VIEWS, methods, protocol)


# -- each expected number comes from the functions of hbr on a model without the removed views --


RING = np.arange(24)
J, OWN = 2, VIEWS.of(2)


def away_deg(angle_deg: float) -> float:
    return float(abs((angle_deg + 180) % 360 - 180))


def always(protocol: Protocol) -> np.ndarray:
    """Return which of an object's views are enrolled in all trials."""
    return RING % 3 == 0 if protocol.enrolled else RING >= 0


def kept(protocol: Protocol, seen: list[int]) -> np.ndarray:
    """Return which of the searched object's views stay enrolled after some queries."""
    gone = {
        "near": [i for i in RING if min(away_deg((i - s) * STEP) for s in seen) < protocol.near_deg],
        "paper79": [i for s in seen for i in (s, (s + 1) % 24)],
        "queries": seen,
    }[protocol.removal]
    return always(protocol) & ~np.isin(RING, gone)


def model_of(keep: np.ndarray, protocol: Protocol) -> Views:
    mask = np.tile(always(protocol), 6)
    mask[OWN] = keep
    return VIEWS.select(mask)


Expected = tuple[dict[str, Any], float | None]
"""The recorded values by name, and the planned rotation."""


def by_paper(method: Method, protocol: Protocol, seen: list[int], measured_deg: np.ndarray, coin: bool) -> Expected:
    index = ViewIndex(model_of(kept(protocol, seen), protocol))
    settings = {"omega": method.omega, "list_length": method.list_length, "extension": method.extension}
    queries = QUERIES[OWN[seen]]
    ranking = hbr.retrieve(queries, measured_deg, index, **settings)  # type: ignore[arg-type]
    found: dict[str, Any] = {"rank": 0, "margin": pytest.approx(hbr.score_margin(ranking, queries) / len(seen))}
    if J in ranking.object_index:
        place = ranking.object_index.tolist().index(J)
        found |= {"rank": place + 1, "pose_error_deg": away_deg(ranking.pose_deg[place] - seen[-1] * STEP)}
    if method.active and len(seen) > 1:
        side = None if method.name != "coin" else "left" if coin else "right"
        return found, hbr.next_view(ranking, side=side).rotation_deg  # type: ignore[arg-type]
    return found, 90.0 if method.name in ("sweep-90", "ahbr-90") else None


def by_hmm(method: Method, protocol: Protocol, seen: list[int], measured_deg: np.ndarray, _coin: bool) -> Expected:
    model = model_of(kept(protocol, seen), protocol)
    belief: PoseModel | PoseBelief = PoseModel(model)
    for query, deg in zip(hbr.tanimoto(QUERIES[OWN[seen]], model.descriptors), measured_deg.tolist(), strict=True):
        belief = update_poses(query, deg, belief)
    assert isinstance(belief, PoseBelief)
    objects, log_probability, pose_deg = belief.ranking()
    probability, place = np.exp(log_probability), objects.tolist().index(J)
    outcome = Outcome.FOUND if probability[0] >= CONFIDENT else Outcome.CONTINUE
    found = {
        "rank": place + 1,
        "pose_error_deg": away_deg(pose_deg[place] - seen[-1] * STEP),
        "score": pytest.approx(probability[0]),
        "margin": pytest.approx(probability[0] - probability[1]),
        "outcome": OUTCOMES.index(outcome),
    }
    return found, belief.next_view().rotation_deg if method.name == "hmm" else None


def by_dense(method: Method, protocol: Protocol, seen: list[int], measured_deg: np.ndarray, coin: bool) -> Expected:
    mask, keep = np.tile(always(protocol), 6), kept(protocol, seen)
    gone = np.searchsorted(np.flatnonzero(mask), OWN[always(protocol) & ~keep])
    index = DenseIndex(VIEWS.select(mask), omega=method.omega).without(gone)
    belief = belief_after(QUERIES[OWN[seen]], measured_deg, index)
    ranking, decision = belief.ranking(), decide(belief, last=len(seen) == protocol.max_views)
    place = ranking.object_index.tolist().index(J)
    found = {"rank": place + 1, "score": ranking.scores[0], "outcome": OUTCOMES.index(decision.outcome)}
    best_deg = next_best_view(belief, not_enrolled=decision.not_enrolled).rotation_deg
    planned = {"dense": best_deg, "dense-coin": abs(best_deg) * (1 if coin else -1), "dense-90": 90.0}
    return found, planned.get(method.name)


FEW = Protocol(trials=3, max_views=4, enrolled=8, removal="queries")
DRIFT = replace(PROTOCOL, drift_deg=1.0)


@pytest.mark.parametrize(
    ("name", "protocol"),
    [
        *((name, DRIFT) for name in ("hbr", "hbr-visual", "hbr-0-orient", "ahbr", "ahbr-90", "coin", "sweep-90")),
        *((name, replace(DRIFT, removal=removal)) for name, removal in (("hbr", "paper79"), ("ahbr", "queries"))),
        *((name, DRIFT) for name in ("hmm", "hmm-random")),
        *((name, FEW) for name in ("dense", "dense-90", "dense-random", "dense-coin")),
        ("dense", Protocol(trials=2, max_views=4, near_deg=30)),  # views at exactly 30° stay
    ],
)
def test_trial_equals_the_literal_protocol(name: str, protocol: Protocol) -> None:
    method = METHODS[name]
    expected_of = by_dense if method.dense else by_hmm if method.hmm else by_paper
    runs, trials = run(J, (method,), protocol), trials_of(J, protocol)
    for t in range(protocol.trials):
        draws = trials.draw(t)
        seen, travelled_deg = [int(draws.order[0])], 0.0
        for n in range(protocol.max_views):
            measured_deg = np.array(seen) * STEP + draws.error_deg[: n + 1]
            following = (n + 1) % protocol.max_views
            expected, planned_deg = expected_of(method, protocol, seen, measured_deg, bool(draws.coins[following]))
            for key, value in (expected | {"travelled_deg": travelled_deg}).items():
                assert getattr(runs, key)[0, 0, t, n] == value, (key, t, n)
            wanted_deg = draws.order[following] * STEP if planned_deg is None else seen[-1] * STEP + planned_deg
            left = [i for i in RING if i not in seen and not (protocol.enrolled and always(protocol)[i])]
            seen.append(min(left, key=lambda i: away_deg(i * STEP - wanted_deg)))
            travelled_deg += away_deg((seen[-1] - seen[-2]) * STEP)
    assert not (runs.alike_error_deg > runs.pose_error_deg).any()


def test_queries_are_views_that_are_not_enrolled() -> None:
    trials = trials_of(1, FEW)
    for t in range(20):
        assert (trials.draw(t).order % 3 != 0).all()
    following = [trials._next(trials.draw(0), [1], rotation, 4) for rotation in np.arange(0, 360, 7.0)]
    assert (np.array(following) % 3 != 0).all()
    with pytest.raises(ValueError, match="16 views; for 16 queries"):
        run(1, (METHODS["dense-90"],), replace(FEW, max_views=16))


def test_oracle_has_a_larger_margin_than_a_fixed_step() -> None:
    oracle, fixed = (
        np.mean([run(j, (METHODS[name],), FEW).margin[0, 0, :, 1].mean() for j in range(6)])
        for name in ("dense-oracle", "dense-90")
    )
    assert oracle > fixed


def test_dense_searches_end_by_the_stopping_rule_and_methods_are_compared() -> None:
    methods = choose_methods(["dense", "dense-90", "dense-mutual", "hbr"])
    runs = Runs.concatenate([run(j, methods, FEW) for j in range(6)])
    assert ((~np.isnan(runs.stated[:3, ..., 0])).sum(axis=-1) == 1).all()  # each search states its poses once
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


def test_methods_have_the_same_trials_in_any_selection() -> None:
    together, alone = run(1), run(1, (METHODS["ahbr"],))
    m = [method.name for method in ALL].index("ahbr")
    np.testing.assert_array_equal(together.rank[m], alone.rank[0])
    np.testing.assert_array_equal(together.pose_error_deg[m], alone.pose_error_deg[0])
    by_name = {method.name: together.rank[i] for i, method in enumerate(ALL)}
    for name in ("hbr", "ahbr", "sweep-45"):  # all begin with the same view
        np.testing.assert_array_equal(by_name[name][..., 0], by_name["coin"][..., 0])
    np.testing.assert_array_equal(by_name["hbr"][..., 1], by_name["ahbr"][..., 1])
    np.testing.assert_array_equal(by_name["single"][..., 0], by_name["hbr-visual"][..., 0])
    assert (by_name["single"][..., 1:] == -1).all()


def test_the_tree_gives_the_same_results() -> None:
    paper = tuple(method for method in ALL if not method.hmm and not method.dense)
    flat, tree = (run(1, paper, replace(PROTOCOL, index=index)) for index in ("flat", "tree"))
    np.testing.assert_array_equal(flat.rank, tree.rank)
    np.testing.assert_array_equal(flat.margin, tree.margin)


def test_trials_draw_views_and_errors_for_each_object_alone() -> None:
    """The drawn values depend on seed, trial and name of the object, and not on the other objects."""
    protocol = replace(PROTOCOL, sigma_deg=3.0, drift_deg=10.0)
    trials = trials_of(0, protocol)
    few = Views.concatenate([VIEWS.select(VIEWS.of(j)) for j in (4, 0)])
    alone = _Trials(few.object_names.index("object 0"), QUERIES[:24], few, protocol, lambda: 0)
    measured = trials_of(0, replace(protocol, rotation_errors_deg=(3.0,)))
    for t in range(3):
        for name in ("order", "error_deg", "coins"):
            np.testing.assert_array_equal(getattr(trials.draw(t), name), getattr(alone.draw(t), name))
        np.testing.assert_array_equal(trials.draw(t).order, measured.draw(t).order)
        np.testing.assert_array_equal(trials.draw(t).coins, measured.draw(t).coins)
        # measured errors of rotations add up
        np.testing.assert_allclose(measured.draw(t).error_deg, [3, 6, 9, 12, 15])
    other = trials_of(0, replace(protocol, seed=1))
    assert len({tuple(draw.order.tolist()) for draw in (trials.draw(0), trials.draw(1), other.draw(0))}) == 3
    errors = np.array([trials.draw(t).error_deg for t in range(500)]) - 10.0 * np.arange(5)
    assert errors.mean() == pytest.approx(0, abs=0.2)
    assert errors.std() == pytest.approx(3, rel=0.05)


def test_paper79_leaves_79_percent_of_72_views() -> None:
    azimuth = np.arange(0, 360, 5.0)
    views = Views.of_object("a", np.ones((72, 144), np.uint8), azimuth)
    trials = _Trials(0, views.descriptors, views, Protocol(removal="paper79"), lambda: 0)
    left = [trials._keep(trials.draw(t).order).mean() for t in range(400)]
    assert np.mean(left) == pytest.approx(0.79, abs=0.005)


def test_symmetric_object_has_a_pose_error_but_no_error_of_appearance() -> None:
    """An object that looks the same from four sides: poses are 0, 90, 180 or 270 degrees off."""
    rng = np.random.default_rng(5)
    quarter = rng.integers(0, 8, (6, 144)) * (rng.random((6, 144)) < 0.3)
    box = Views.of_object("box", np.tile(quarter, (4, 1)).astype(np.uint8), np.arange(0, 360, 15.0))
    views = Views.concatenate([box, *(VIEWS.select(VIEWS.of(j)) for j in range(3))])
    runs = run_object(0, box.descriptors, views, (METHODS["hbr-visual"],), replace(PROTOCOL, trials=20, near_deg=10))
    assert (runs.rank == 1).all()
    assert np.median(runs.pose_error_deg) >= 90
    assert (runs.alike_error_deg == 0).all()


def test_time_of_a_step_comes_from_the_timer() -> None:
    ticks = iter(range(0, 10**9, 7))
    runs = run_object(0, QUERIES[:24], VIEWS, ALL[:2], PROTOCOL, now_ns=lambda: next(ticks))
    assert (runs.step_ns[1, :, 0] == 7).all()
    assert (runs.step_ns[1, :, 1:] == 0).all()
    assert (run(0, ALL[:1]).step_ns == 0).all()


def test_shared_retrieval_lists_change_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    for protocol in (PROTOCOL, replace(PROTOCOL, removal="queries"), replace(PROTOCOL, enrolled=12)):
        shared = run_object(0, QUERIES[:24], VIEWS, ALL, protocol)
        with monkeypatch.context() as patch:
            patch.setattr(_Trials, "_share_lists", lambda *_: None)
            searched = run_object(0, QUERIES[:24], VIEWS, ALL, protocol)
        for item in fields(Runs):
            np.testing.assert_array_equal(getattr(shared, item.name), getattr(searched, item.name), item.name)


def test_impossible_runs_are_rejected() -> None:
    with pytest.raises(ValueError, match="object 0 has 24 views; for 24 queries"):
        run(0, ALL[:1], Protocol(max_views=24))
    with pytest.raises(ValueError, match="no view of object 0 is left"):
        run(0, ALL[4:5], Protocol(near_deg=180))
    with pytest.raises(ValueError, match="23 queries for the 24 views"):
        run_object(0, QUERIES[:23], VIEWS, ALL, PROTOCOL)


@pytest.mark.parametrize(
    "setting",
    [
        *({"trials": 0}, {"max_views": 0}, {"near_deg": 0}, {"sigma_deg": -1}, {"seed": -1}, {"enrolled": 0}),
        {"rotation_errors_deg": (0.1, float("nan"))},
    ],
)
def test_invalid_protocol_is_rejected(setting: dict) -> None:
    with pytest.raises(ValueError, match=r"trials|near_deg|seed|enrolled|not a finite number"):
        Protocol(**setting)


def test_methods_are_chosen_by_name_and_group() -> None:
    assert [m.name for m in choose_methods(["ahbr", "hbr", "ahbr"])] == ["ahbr", "hbr"]
    assert [m.omega for m in choose_methods(["omega-sweep"])][:3] == [0, 0.125, 0.25]
    assert {m.list_length for m in choose_methods(["list-sweep", "hbr"])} >= {1, 10, 100}
    with pytest.raises(ValueError, match="'best' is unknown; use some of all"):
        choose_methods(["best"])
    with pytest.raises(ValueError, match="no method"):
        choose_methods([])
