"""Images of queries and of enrolled views: noise, rotation, background."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from hbr.drawing.noise import Noise, gaussian, motion_kernel
from hbr.evaluation.condition import Condition, levels_of
from hbr.evaluation.perturb import STRENGTHS, Perturbations
from hbr.evaluation.photographs import Dataset, Photograph, PhotographedObject, object_mask
from tests.fuzzing import examples


def ball(size: int = 128) -> np.ndarray:
    """Return a ball of two colours with a black pupil, on a dark ground with some noise."""
    y, x = np.indices((size, size)) - (size - 1) / 2
    image = np.random.default_rng(0).integers(0, 20, (size, size, 3), dtype=np.uint8)
    image[np.hypot(x, y) < size / 3] = (60, 80, 200)
    image[(np.hypot(x, y) < size / 3) & (x > 0)] = (200, 180, 60)
    image[np.hypot(x, y) < size / 10] = 0
    return image


BALL = ball()


def test_motion_kernel_equals_matlab() -> None:
    expected = [[0, 0.0754, 0.1883], [0.0754, 0.3215, 0.0754], [0.1883, 0.0754, 0]]
    np.testing.assert_allclose(motion_kernel(3, 45), expected, atol=5e-5)


@examples(10)
@given(st.floats(1, 40), st.floats(-720, 720))
def test_motion_kernel_is_a_symmetric_mean_along_its_direction(length: float, angle: float) -> None:
    kernel = motion_kernel(length, angle)
    assert kernel.sum() == pytest.approx(1)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)
    assert all(side % 2 for side in kernel.shape)
    assert max(kernel.shape) <= length + 2
    if length > 4:
        up, right = np.indices(kernel.shape)
        right, up = right - right.mean(), up.mean() - up
        across = right * np.sin(np.radians(angle)) - up * np.cos(np.radians(angle))
        assert (kernel * across**2).sum() < 0.5  # of a pixel's triangle: 1/6


def test_impulse_is_smeared_counter_clockwise_and_borders_are_replicated() -> None:
    image = np.zeros((31, 31, 3), np.uint8)
    image[15, 15] = 255
    smeared = Noise.parse("mb:9:30").apply(image, np.random.default_rng(0))[:, :, 0]
    assert smeared[:15, 16:].sum() > 4 * smeared[16:, 16:].sum()  # up and right
    flat = np.full((8, 8, 3), 77, np.uint8)
    assert (Noise.parse("mb").apply(flat, np.random.default_rng(0)) == 77).all()


def test_gaussian_noise_has_the_variance_of_intensities_and_is_clipped() -> None:
    noisy = gaussian(np.full((200, 200, 3), 128, np.uint8), 0.012, np.random.default_rng(1)).astype(float)
    assert noisy.std() == pytest.approx(255 * 0.012**0.5, rel=0.01)
    assert noisy.mean() == pytest.approx(128, abs=0.5)
    black = gaussian(np.zeros((100, 100, 3), np.uint8), 0.012, np.random.default_rng(1))
    assert (black == 0).mean() == pytest.approx(0.5, abs=0.02)


def test_noise_is_read_from_its_own_text() -> None:
    for text in ("none", "gn:0.012", "mb:15:20", "gn:0.05+mb:9:45"):
        assert str(Noise.parse(text)) == text
    assert Noise.parse("gn+mb") == Noise(0.012, 15, 20)  # the numbers of the paper
    assert str(Noise.parse("mb:7")) == "mb:7:20"


@pytest.mark.parametrize("text", ["", "GN", "gn:x", "gn:1:2", "mb:1:2:3", "gn+gn", "gn:-1", "mb:nan", "none+gn"])
def test_invalid_noise_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"noise|motion"):
        Noise.parse(text)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"size_px": 1}, "pixels"),
        ({"rotation_deg": 181}, "rotation"),
        ({"rotation_deg": np.nan}, "rotation"),
        ({"prefilter_px": -1}, "pixels"),
        ({"descriptor": "edges+colours+cedd", "cut_out": True}, "leave cut_out out"),
        ({"perturbations": Perturbations.parse("gain"), "rotation_deg": 10}, "leave out one of them"),
        ({"perturbations": Perturbations.parse("gain"), "background": "uniform"}, "leave out one of them"),
    ],
)
def test_invalid_conditions_are_rejected(setting: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Condition(**setting)


def test_mask_includes_the_dark_parts_of_the_object() -> None:
    y, x = np.indices((128, 128)) - 63.5
    np.testing.assert_array_equal(object_mask(BALL), np.hypot(x, y) < 128 / 3)


@pytest.mark.parametrize(("number", "low", "high"), [(1, 0.3, 0.4), (8, 0.2, 0.3), (26, 0.1, 0.9)])
def test_mask_excludes_the_dark_surroundings_of_a_photograph(
    rig_test_data: Path, number: int, low: float, high: float
) -> None:
    mask = object_mask(cv2.imread(str(rig_test_data / f"coil-100/obj{number}__0.png")))  # type: ignore[arg-type]
    assert low < mask.mean() < high
    assert not mask[[2, 2, -3, -3], [2, -3, 2, -3]].any()  # the outermost pixel of some is bright


@pytest.mark.parametrize("background", ["uniform", "textured"])
def test_background_changes_only_pixels_behind_the_object(background: str) -> None:
    mask = object_mask(BALL)
    query = Condition(background=background).query(BALL, np.random.default_rng(2))  # type: ignore[arg-type]
    own = Condition(enrolled_background=background)  # type: ignore[arg-type]
    enrolled = [own.enrolled(BALL, np.random.default_rng(seed)) for seed in (1, 2)]
    for image in (query, *enrolled):
        np.testing.assert_array_equal(image[mask], BALL[mask])
        behind = image[~mask].astype(float)
        assert (behind.std(axis=0).max() == 0) == (background == "uniform")
        assert np.abs(behind - BALL[~mask]).mean() > 20
    assert np.abs(enrolled[0][:8].astype(int) - enrolled[1][:8]).mean() > 10  # each has its own


def test_rotated_query_shows_the_object_rotated() -> None:
    image = np.zeros((65, 65, 3), np.uint8)
    image[28:37, 10:55] = 200
    query = Condition(rotation_deg=180).query(image, np.random.default_rng(3))
    y, x = np.nonzero(query[:, :, 0] > 100)
    spread = np.linalg.eigvalsh(np.cov(x, y)) ** 0.5
    np.testing.assert_allclose(spread, [9 / 12**0.5, 45 / 12**0.5], rtol=0.06)
    direction = np.degrees(np.arctan2(*np.linalg.eigh(np.cov(x, -y))[1][::-1, 1])) % 180
    assert direction == pytest.approx(np.random.default_rng(3).uniform(-180, 180) % 180, abs=1.5)


def test_size_and_prefilter_apply_to_all_images_and_each_noise_to_its_own() -> None:
    condition = Condition(size_px=96, noise=Noise.parse("gn"), prefilter_px=2.0)
    enrolled, query = condition.enrolled(BALL), condition.query(BALL, np.random.default_rng(0))
    assert enrolled.shape == query.shape == (96, 96, 3)
    rough = Condition(size_px=96).enrolled(BALL)
    assert np.abs(np.diff(enrolled.astype(int), axis=0)).max() < np.abs(np.diff(rough.astype(int), axis=0)).max() / 2
    assert (enrolled != query).any()
    noisy, grey = Condition(enrolled_noise=Noise(gaussian_variance=0.012)), np.full((64, 64, 3), 128, np.uint8)
    shown = [noisy.shown(grey, "a", number) for number in (0, 1)]
    shown += [Condition(noise=Noise.parse("gn")).shown(grey, "a", number, seed) for number, seed in ((0, 0), (1, 0))]
    for image in shown:
        assert image.std() == pytest.approx(255 * 0.012**0.5, rel=0.05)
    assert len({image.tobytes() for image in shown}) == 4  # each has its own
    np.testing.assert_array_equal(noisy.query(grey, np.random.default_rng(0)), grey)


def test_cut_out_object_is_described_before_an_even_grey(tmp_path: Path) -> None:
    image = np.where(BALL > 20, BALL, np.uint8(200))
    assert cv2.imwrite(str(tmp_path / "ball.png"), image)
    item = PhotographedObject("a", (Photograph(tmp_path / "ball.png", 0.0),))
    dataset = Dataset("two", (item, PhotographedObject("b", item.photographs)))
    (levels,) = levels_of(dataset, 0, Condition(cut_out=True))
    np.testing.assert_array_equal(levels, hbr.describe(hbr.segment(image).alone))
    assert (levels != hbr.describe(image)).any()


def captured(text: str, seed: int = 0) -> np.ndarray:
    return Perturbations.parse(text).photograph(BALL, object_mask(BALL), np.random.default_rng(seed))


@pytest.mark.parametrize("kind", STRENGTHS)
def test_stronger_perturbation_changes_the_image_more(kind: str) -> None:
    changes = [
        np.mean([np.abs(captured(f"{kind}:{strength}", seed).astype(int) - BALL).mean() for seed in range(12)])
        for strength in (1, 2, 3)
    ]
    assert 0.05 < changes[0] < changes[1] < changes[2]


def test_no_perturbation_keeps_the_photograph_and_equal_seeds_give_equal_images() -> None:
    np.testing.assert_array_equal(captured("none"), BALL)
    np.testing.assert_array_equal(captured("all:2", 5), captured("all:2", 5))
    assert (captured("all:2", 5) != captured("all:2", 6)).any()
    perturbed = Condition(perturbations=Perturbations.parse("shift:2")).query(BALL, np.random.default_rng(0))
    assert (perturbed != BALL).any()
