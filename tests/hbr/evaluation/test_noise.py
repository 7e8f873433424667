from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from hbr.drawing.noise import Noise, gaussian, motion_kernel
from hbr.evaluation.condition import Condition, _levels
from hbr.evaluation.photographs import object_mask
from tests.fuzzing import examples


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
    grey = np.full((200, 200, 3), 128, np.uint8)
    noisy = gaussian(grey, 0.012, np.random.default_rng(1)).astype(float)
    assert noisy.std() == pytest.approx(255 * 0.012**0.5, rel=0.01)
    assert noisy.mean() == pytest.approx(128, abs=0.5)
    black = gaussian(np.zeros((100, 100, 3), np.uint8), 0.012, np.random.default_rng(1))
    assert (black == 0).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("text", ["none", "gn:0.012", "mb:15:20", "gn:0.05+mb:9:45", "gn:0.012+mb:15:20"])
def test_noise_is_read_from_its_own_text(text: str) -> None:
    assert str(Noise.parse(text)) == text
    assert Noise.parse("gn+mb") == Noise(0.012, 15, 20)  # the numbers of the paper
    assert str(Noise.parse("mb:7")) == "mb:7:20"


@pytest.mark.parametrize("text", ["", "GN", "gn:x", "gn:1:2", "mb:1:2:3", "gn+gn", "gn:-1", "mb:nan", "none+gn"])
def test_invalid_noise_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"noise|motion"):
        Noise.parse(text)


def ball(size: int = 64) -> np.ndarray:
    """Return a bright ball with a black pupil, on a dark ground with some noise."""
    y, x = np.indices((size, size)) - (size - 1) / 2
    image = np.random.default_rng(0).integers(0, 20, (size, size, 3), dtype=np.uint8)
    image[np.hypot(x, y) < size / 3] = (40, 90, 220)
    image[np.hypot(x, y) < size / 10] = 0
    return image


def test_mask_includes_the_dark_parts_of_the_object() -> None:
    y, x = np.indices((64, 64)) - 31.5
    np.testing.assert_array_equal(object_mask(ball()), np.hypot(x, y) < 64 / 3)


@pytest.mark.parametrize("background", ["uniform", "textured"])
def test_background_changes_only_pixels_behind_the_object(background: str) -> None:
    image = ball()
    query = Condition(background=background).query(image, np.random.default_rng(2))  # type: ignore[arg-type]
    mask = object_mask(image)
    np.testing.assert_array_equal(query[mask], image[mask])
    behind = query[~mask].astype(float)
    assert (behind.std(axis=0).max() == 0) == (background == "uniform")
    assert np.abs(behind - image[~mask]).mean() > 20


def test_rotated_query_shows_the_object_rotated() -> None:
    image = np.zeros((65, 65, 3), np.uint8)
    image[28:37, 10:55] = 200
    query = Condition(rotation_deg=180).query(image, np.random.default_rng(3))
    y, x = np.nonzero(query[:, :, 0] > 100)
    spread = np.linalg.eigvalsh(np.cov(x, y)) ** 0.5
    np.testing.assert_allclose(spread, [9 / 12**0.5, 45 / 12**0.5], rtol=0.06)
    direction = np.degrees(np.arctan2(*np.linalg.eigh(np.cov(x, -y))[1][::-1, 1])) % 180
    assert direction == pytest.approx(np.random.default_rng(3).uniform(-180, 180) % 180, abs=1.5)


def test_size_and_prefilter_apply_to_all_images_and_noise_to_queries_only() -> None:
    condition = Condition(size_px=96, noise=Noise.parse("gn"), prefilter_px=2.0)
    image = ball()
    enrolled, query = condition.enrolled(image), condition.query(image, np.random.default_rng(0))
    assert enrolled.shape == query.shape == (96, 96, 3)
    rough = Condition(size_px=96).enrolled(image)
    assert np.abs(np.diff(enrolled.astype(int), axis=0)).max() < np.abs(np.diff(rough.astype(int), axis=0)).max() / 2
    assert (enrolled != query).any()


@pytest.mark.parametrize(
    "setting",
    [{"size_px": 1}, {"rotation_deg": 181}, {"background": "sea"}, {"prefilter_px": -1}, {"rotation_deg": np.nan}],
)
def test_invalid_condition_is_rejected(setting: dict) -> None:
    with pytest.raises(ValueError, match=r"pixels|rotation|background"):
        Condition(**setting)


@pytest.mark.parametrize(("number", "low", "high"), [(1, 0.3, 0.4), (3, 0.25, 0.35), (8, 0.2, 0.3), (26, 0.1, 0.9)])
def test_mask_excludes_the_dark_surroundings_of_a_photograph(
    rig_test_data: Path, number: int, low: float, high: float
) -> None:
    image = cv2.imread(str(rig_test_data / f"coil-100/obj{number}__0.png"))
    assert image is not None
    mask = object_mask(image)  # type: ignore[arg-type]
    assert low < mask.mean() < high
    assert not mask[[2, 2, -3, -3], [2, -3, 2, -3]].any()  # the outermost pixel of some is bright


def disc(size: int = 96) -> np.ndarray:
    image = np.zeros((size, size, 3), np.uint8)
    cv2.circle(image, (size // 2, size // 2), size // 4, (40, 160, 220), -1)
    return image


@pytest.mark.parametrize("background", ["uniform", "textured"])
def test_enrolled_views_get_a_background_of_their_own(background: str) -> None:
    condition = Condition(enrolled_background=background)  # type: ignore[arg-type]
    shown = [condition.enrolled(disc(), np.random.default_rng(seed)) for seed in (1, 2)]
    for image in shown:
        np.testing.assert_array_equal(image[48, 48], [40, 160, 220])
    assert np.abs(shown[0][:8].astype(int) - shown[1][:8]).mean() > 10


def test_cut_out_object_is_described_before_an_even_grey() -> None:
    image = np.where(disc() > 0, disc(), np.uint8(200))
    (levels,) = _levels([image], Condition(cut_out=True))
    np.testing.assert_array_equal(levels, hbr.describe(hbr.segment(image).alone))
    assert (levels != hbr.describe(image)).any()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"enrolled_background": "striped"}, "use one of same, uniform, textured"),
        ({"descriptor": "edges+colours+cedd", "cut_out": True}, "leave cut_out out"),
    ],
)
def test_conditions_that_exclude_each_other_are_rejected(keys: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Condition(**keys)  # type: ignore[arg-type]
