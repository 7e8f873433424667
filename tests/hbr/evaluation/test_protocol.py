from dataclasses import fields, replace

import numpy as np
import pytest

import hbr
from hbr import ViewIndex, Views
from hbr.evaluation.protocol import METHODS, OUTCOMES, Method, Protocol, Removal, Runs, choose_methods
from hbr.evaluation.trials import _Trials, run_object
from hbr.paper.hmm import CONFIDENT, PoseBelief, PoseModel, update_poses

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


@pytest.mark.parametrize(
    ("name", "removal"),
    [
        *((name, "near") for name in ("hbr", "hbr-visual", "hbr-0-orient", "ahbr", "ahbr-90", "coin", "sweep-90")),
        ("hbr", "paper79"),
        ("ahbr", "queries"),
    ],
)
def test_trial_equals_the_literal_protocol(name: str, removal: Removal) -> None:
    """Each expected number comes from `retrieve`, `lead` and `next_view` on a model without the removed views."""
    method, protocol = METHODS[name], replace(PROTOCOL, removal=removal, drift_deg=1.0)
    j = 2
    own = VIEWS.of(j)
    runs = run(j, (method,), protocol)
    trials = trials_of(j, protocol)
    for t in range(protocol.trials):
        draws = trials.draw(t)
        seen, travelled = [int(draws.order[0])], 0.0
        for n in range(protocol.max_views):
            angles = np.array(seen) * STEP
            gone = {
                "near": [i for i in range(24) if min(abs((i * STEP - a + 180) % 360 - 180) for a in angles) < 20],
                "paper79": [i for s in seen for i in (s, (s + 1) % 24)],
                "queries": seen,
            }[removal]
            model = VIEWS.select(np.setdiff1d(np.arange(len(VIEWS)), own[gone]))
            ranking = hbr.retrieve(
                QUERIES[own[seen]],
                angles + draws.error_deg[: n + 1],
                ViewIndex(model),
                omega=method.omega,
                list_length=method.list_length,
                extension=method.extension,
            )
            place = ranking.object_index.tolist().index(j) if j in ranking.object_index else -1
            assert runs.rank[0, 0, t, n] == place + 1
            assert runs.margin[0, 0, t, n] == pytest.approx(hbr.score_margin(ranking, QUERIES[own[seen]]) / (n + 1))
            assert runs.travelled_deg[0, 0, t, n] == travelled
            if place >= 0:
                error = abs((ranking.pose_deg[place] - angles[-1] + 180) % 360 - 180)
                assert runs.pose_error_deg[0, 0, t, n] == error
                assert runs.alike_error_deg[0, 0, t, n] <= error
            if name in ("ahbr", "ahbr-90", "coin") and n > 0:
                side = None if name != "coin" else ("left" if draws.coins[n + 1 :][:1].any() else "right")
                wanted = angles[-1] + hbr.next_view(ranking, side=side).rotation_deg  # type: ignore[arg-type]
            elif name in ("sweep-90", "ahbr-90"):
                wanted = angles[-1] + 90
            else:
                wanted = draws.order[(n + 1) % protocol.max_views] * STEP
            left = [i for i in range(24) if i not in seen]
            following = min(left, key=lambda i: abs((i * STEP - wanted + 180) % 360 - 180)) if n < 4 else seen[0]
            travelled += abs((following * STEP - angles[-1] + 180) % 360 - 180)
            seen.append(following)


@pytest.mark.parametrize("name", ["hmm", "hmm-random"])
def test_trial_of_the_hidden_markov_model_equals_the_literal_protocol(name: str) -> None:
    """Each expected number comes from `update_poses` and `next_view` on a model without the removed views."""
    j, protocol = 2, replace(PROTOCOL, drift_deg=1.0)
    own = VIEWS.of(j)
    runs = run(j, (METHODS[name],), protocol)
    trials = trials_of(j, protocol)
    for t in range(protocol.trials):
        draws = trials.draw(t)
        seen, travelled = [int(draws.order[0])], 0.0
        for n in range(protocol.max_views):
            angles = np.array(seen) * STEP
            gone = [i for i in range(24) if min(abs((i * STEP - a + 180) % 360 - 180) for a in angles) < 20]
            model = VIEWS.select(np.setdiff1d(np.arange(len(VIEWS)), own[gone]))
            similar = hbr.tanimoto(QUERIES[own[seen]], model.descriptors)
            belief: PoseModel | PoseBelief = PoseModel(model)
            for query, measured in zip(similar, (angles + draws.error_deg[: n + 1]).tolist(), strict=True):
                belief = update_poses(query, measured, belief)
            assert isinstance(belief, PoseBelief)
            objects, log_probability, pose_deg = belief.ranking()
            probability = np.exp(log_probability)
            place = objects.tolist().index(j)
            assert runs.rank[0, 0, t, n] == place + 1
            assert runs.pose_error_deg[0, 0, t, n] == abs((pose_deg[place] - angles[-1] + 180) % 360 - 180)
            assert runs.score[0, 0, t, n] == pytest.approx(probability[0])
            assert runs.margin[0, 0, t, n] == pytest.approx(probability[0] - probability[1])
            assert runs.outcome[0, 0, t, n] == OUTCOMES.index(
                hbr.Outcome.FOUND if probability[0] >= CONFIDENT else hbr.Outcome.CONTINUE
            )
            assert runs.travelled_deg[0, 0, t, n] == travelled
            wanted = draws.order[(n + 1) % protocol.max_views] * STEP
            if name == "hmm":
                wanted = angles[-1] + belief.next_view().rotation_deg
            left = [i for i in range(24) if i not in seen]
            following = min(left, key=lambda i: abs((i * STEP - wanted + 180) % 360 - 180))
            travelled += abs((following * STEP - angles[-1] + 180) % 360 - 180)
            seen.append(following)


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
