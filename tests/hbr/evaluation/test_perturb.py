"""Queries that differ from the enrolled views in place, light and surroundings."""

import numpy as np
import pytest

from hbr import describe, descriptor
from hbr.drawing.bench import HEIGHT, WIDTH
from hbr.drawing.noise import Noise
from hbr.evaluation.condition import Condition
from hbr.evaluation.perturb import STRENGTHS, Perturbations, other_bench, plain_bench
from hbr.evaluation.photographs import object_mask


def ball() -> np.ndarray:
    """Return a ball of two colours before a dark background, 128 x 128."""
    y, x = np.indices((128, 128))
    inside = (y - 64) ** 2 + (x - 64) ** 2 < 40**2
    image = np.full((128, 128, 3), 20, np.uint8)
    image[inside] = (60, 80, 200)
    image[inside & (x > 64)] = (200, 180, 60)
    return image


def captured(text: str, seed: int = 0, bench: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    image = ball()
    return Perturbations.parse(text).photograph(image, object_mask(image), np.random.default_rng(seed), bench)


def differs(text: str) -> float:
    """Return the mean change of the grey levels over some draws."""
    return float(np.mean([np.abs(captured(text, seed)[0].astype(int) - ball()).mean() for seed in range(12)]))


@pytest.mark.parametrize("kind", [kind for kind in STRENGTHS if kind != "shadow"])
def test_stronger_perturbation_changes_the_image_more(kind: str) -> None:
    changes = [differs(f"{kind}:{strength}") for strength in (1, 2, 3)]
    assert 0.05 < changes[0] < changes[1] < changes[2]


def test_none_keeps_the_photograph_and_equal_seeds_give_equal_images() -> None:
    np.testing.assert_array_equal(captured("none")[0], ball())
    np.testing.assert_array_equal(captured("all:2", 5)[0], captured("all:2", 5)[0])
    assert (captured("all:2", 5)[0] != captured("all:2", 6)[0]).any()


def test_shift_and_scale_have_the_stated_size() -> None:
    places, sizes = [], []
    for seed in range(60):
        mask = object_mask(captured("shift:2+scale:2", seed)[0])
        y, x = np.nonzero(mask)
        places.append([(x.mean() - 63.5) / 128, (y.mean() - 63.5) / 128])
        sizes.append(np.sqrt(mask.sum() / object_mask(ball()).sum()))
    assert 0.05 < np.abs(places).max() < 0.066
    assert 0.88 < min(sizes) < 0.93
    assert 1.07 < max(sizes) < 1.12


def test_empty_table_image_has_the_light_of_the_image() -> None:
    bench = plain_bench(np.random.default_rng(0))
    picture, empty = captured("gain:3+white-balance:3+gradient:3", 1, bench)
    assert empty is not None
    assert picture.shape == empty.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(picture[:40], empty[:40])
    assert np.abs(empty.astype(int) - bench).mean() > 5
    assert np.abs(picture.astype(int) - empty)[100:180, 120:200].mean() > 20


def test_cast_shadow_darkens_the_bench_and_not_the_object() -> None:
    bench = plain_bench(np.random.default_rng(0))
    with_shadow, _ = captured("shadow:3", 3, bench)
    without, _ = captured("none", 3, bench)
    change = with_shadow.astype(int) - without
    assert change.min() < -15
    assert change.max() <= 1
    assert np.abs(change[110:150, 150:170]).max() <= 2


def test_benches_differ_from_each_other() -> None:
    benches = [other_bench(np.random.default_rng(seed)) for seed in range(3)]
    assert all(np.abs(a - b).mean() > 15 for a, b in ((benches[0], benches[1]), (benches[1], benches[2])))
    assert plain_bench(np.random.default_rng(1)).std(axis=(0, 1)).max() < min(b.std(axis=(0, 1)).max() for b in benches)


@pytest.mark.parametrize("text", ["fog", "gain:4", "gain:x", "gain+gain", "all:0", "", "shift:2+"])
def test_invalid_perturbation_is_rejected(text: str) -> None:
    assert str(Perturbations.parse("gain:")) == "gain:2"
    with pytest.raises(ValueError, match=r"unknown|strength|once"):
        Perturbations.parse(text)


def test_perturbations_round_trip_as_text() -> None:
    for text in ("none", "gain:1", "shift:2+scale:3", "all:3"):
        assert Perturbations.parse(str(Perturbations.parse(text))) == Perturbations.parse(text)


def test_edges_and_colours_are_robust_to_another_bench_and_cedd_is_not() -> None:
    """The test runs all steps of `rig eval --background other-bench`."""
    conditions = {
        name: Condition(background="other-bench", perturbations=Perturbations.parse("shift:1+gain:2"), descriptor=name)
        for name in ("cedd", "edges=0.5,colours=0.5")
    }
    similar = {}
    for name, condition in conditions.items():
        enrolled, query = condition.enrolled(ball()), condition.query(ball(), np.random.default_rng(4))
        levels = [describe(image, descriptor=name, empty_table=empty) for image, empty in (enrolled, query)]
        plain = [describe(image, descriptor=name) for image, _ in (enrolled, query)]
        similar[name] = [float(descriptor(name).similarity(a[None], b[None])[0, 0]) for a, b in (levels, plain)]
    assert similar["edges=0.5,colours=0.5"][0] > 0.85
    assert similar["cedd"][1] < 0.5


@pytest.mark.parametrize("setting", [{"rotation_deg": 10}, {"background": "uniform"}])
def test_conflicting_conditions_are_rejected(setting: dict) -> None:
    with pytest.raises(ValueError, match="leave out one of them"):
        Condition(perturbations=Perturbations.parse("gain"), **setting)


def test_queries_on_another_bench_have_the_requested_empty_table_image() -> None:
    images = {}
    for reference in ("own", "enrollment", "none"):
        condition = Condition(background="other-bench", reference=reference)  # type: ignore[arg-type]
        enrolled, query = condition.enrolled(ball()), condition.query(ball(), np.random.default_rng(4))
        images[reference] = query
        assert (enrolled.empty is None) == (reference == "none")
        if reference == "enrollment":
            assert query.empty is not None
            assert enrolled.empty is not None
            np.testing.assert_array_equal(query.empty, enrolled.empty)
    np.testing.assert_array_equal(images["own"].image, images["none"].image)
    assert images["own"].empty is not None
    assert images["none"].empty is None
    border = np.s_[:40, :, :]
    np.testing.assert_array_equal(images["own"].empty[border], images["own"].image[border])
    with pytest.raises(ValueError, match="reference 'some'"):
        Condition(reference="some")  # type: ignore[arg-type]


def test_enrolled_views_can_have_their_own_noise() -> None:
    condition = Condition(enrolled_noise=Noise(gaussian_variance=0.012))
    image = np.full((64, 64, 3), 128, np.uint8)
    first, second = (condition.enrolled(image, np.random.default_rng(seed)).image for seed in (0, 1))
    assert first.std() == pytest.approx(255 * 0.012**0.5, rel=0.05)
    assert (first != second).any()
    np.testing.assert_array_equal(condition.query(image, np.random.default_rng(0)).image, image)
