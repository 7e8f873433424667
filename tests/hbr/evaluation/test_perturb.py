"""Queries that differ from the enrolled views in place, light and surroundings."""

import numpy as np
import pytest

from hbr.drawing.noise import Noise
from hbr.evaluation.condition import Condition
from hbr.evaluation.perturb import STRENGTHS, Perturbations
from hbr.evaluation.photographs import object_mask


def ball() -> np.ndarray:
    """Return a ball of two colours before a dark background, 128 x 128."""
    y, x = np.indices((128, 128))
    inside = (y - 64) ** 2 + (x - 64) ** 2 < 40**2
    image = np.full((128, 128, 3), 20, np.uint8)
    image[inside] = (60, 80, 200)
    image[inside & (x > 64)] = (200, 180, 60)
    return image


def captured(text: str, seed: int = 0) -> np.ndarray:
    image = ball()
    return Perturbations.parse(text).photograph(image, object_mask(image), np.random.default_rng(seed))


def differs(text: str) -> float:
    """Return the mean change of the grey levels over some draws."""
    return float(np.mean([np.abs(captured(text, seed).astype(int) - ball()).mean() for seed in range(12)]))


@pytest.mark.parametrize("kind", STRENGTHS)
def test_stronger_perturbation_changes_the_image_more(kind: str) -> None:
    changes = [differs(f"{kind}:{strength}") for strength in (1, 2, 3)]
    assert 0.05 < changes[0] < changes[1] < changes[2]


def test_none_keeps_the_photograph_and_equal_seeds_give_equal_images() -> None:
    np.testing.assert_array_equal(captured("none"), ball())
    np.testing.assert_array_equal(captured("all:2", 5), captured("all:2", 5))
    assert (captured("all:2", 5) != captured("all:2", 6)).any()


def test_shift_and_scale_have_the_stated_size() -> None:
    places, sizes = [], []
    for seed in range(60):
        mask = object_mask(captured("shift:2+scale:2", seed))
        y, x = np.nonzero(mask)
        places.append([(x.mean() - 63.5) / 128, (y.mean() - 63.5) / 128])
        sizes.append(np.sqrt(mask.sum() / object_mask(ball()).sum()))
    assert 0.05 < np.abs(places).max() < 0.066
    assert 0.88 < min(sizes) < 0.93
    assert 1.07 < max(sizes) < 1.12


@pytest.mark.parametrize("text", ["fog", "gain:4", "gain:x", "gain+gain", "all:0", "", "shift:2+"])
def test_invalid_perturbation_is_rejected(text: str) -> None:
    assert str(Perturbations.parse("gain:")) == "gain:2"
    with pytest.raises(ValueError, match=r"unknown|strength|once"):
        Perturbations.parse(text)
    with pytest.raises(ValueError, match="strength 4"):
        Perturbations((("gain", 4),))


def test_perturbations_round_trip_as_text() -> None:
    for text in ("none", "gain:1", "shift:2+scale:3", "all:3"):
        assert Perturbations.parse(str(Perturbations.parse(text))) == Perturbations.parse(text)


@pytest.mark.parametrize("setting", [{"rotation_deg": 10}, {"background": "uniform"}])
def test_conflicting_conditions_are_rejected(setting: dict) -> None:
    with pytest.raises(ValueError, match="leave out one of them"):
        Condition(perturbations=Perturbations.parse("gain"), **setting)


def test_enrolled_views_can_have_their_own_noise() -> None:
    condition = Condition(enrolled_noise=Noise(gaussian_variance=0.012))
    image = np.full((64, 64, 3), 128, np.uint8)
    first, second = (condition.enrolled(image, np.random.default_rng(seed)) for seed in (0, 1))
    assert first.std() == pytest.approx(255 * 0.012**0.5, rel=0.05)
    assert (first != second).any()
    np.testing.assert_array_equal(condition.query(image, np.random.default_rng(0)), image)
