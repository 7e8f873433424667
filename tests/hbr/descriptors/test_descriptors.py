from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import ViewIndex, Views, segment
from hbr.descriptors import Descriptor, best, descriptor, names, network
from hbr.descriptors.edges_and_colours import _histogram
from hbr.descriptors.registry import FULL, LIGHT
from hbr.kernels import without_library
from tests.fuzzing import examples

#: Those whose packages are installed.
NAMES = [name for name in names() if descriptor(name).can_describe]


@pytest.fixture(params=NAMES)
def one(request: pytest.FixtureRequest) -> Descriptor:
    return descriptor(request.param)


def photo(seed: int = 0, stripe_px: int = 6) -> np.ndarray:
    """Return an image of a coloured, striped blob before a dark background."""
    rng = np.random.default_rng(seed)
    image = np.full((120, 160, 3), 20, np.uint8)
    y, x = np.indices((120, 160))
    inside = ((y - 60) / 40) ** 2 + ((x - 80) / 30) ** 2 < 1
    image[inside] = rng.integers(60, 255, 3)
    image[inside & (x // stripe_px % 2 == 0)] = rng.integers(60, 255, 3)
    return image


def test_attributes_fit_the_levels_and_unpack_restores_packed_levels(one: Descriptor) -> None:
    levels = one.describe(photo())
    assert levels.shape == (one.length,)
    assert levels.dtype == np.uint8
    assert len(one.pack(levels)) == one.size_bytes <= 512
    assert descriptor(one.name) is one
    rows = [one.describe(photo(seed)) for seed in range(5)]
    packed = [one.pack(levels) for levels in rows]
    np.testing.assert_array_equal([one.unpack(content) for content in packed], rows)
    np.testing.assert_array_equal(one.unpack_rows(b"".join(packed)), rows)
    assert one.unpack_rows(b"").shape == (0, one.length)
    with pytest.raises(ValueError, match="bytes"):
        one.unpack(packed[0][1:])
    with pytest.raises(ValueError, match="no multiple"):
        one.unpack_rows(packed[0][1:])


def test_similarity_is_1_to_itself_symmetric_and_between_0_and_1(one: Descriptor) -> None:
    rows = np.stack([one.describe(photo(seed, 6 + 3 * seed)) for seed in range(6)])
    similar = one.similarity(rows, rows)
    assert similar.shape == (6, 6)
    np.testing.assert_allclose(np.diag(similar), 1, atol=1e-6)
    np.testing.assert_allclose(similar, similar.T, atol=1e-6)
    assert (similar >= 0).all()
    assert (similar <= 1 + 1e-12).all()
    assert similar[~np.eye(6, dtype=bool)].max() < 0.999
    np.testing.assert_allclose(one.similarity(rows[:2], rows), similar[:2], atol=1e-6)


def test_packed_rows_are_compared_as_their_levels(one: Descriptor) -> None:
    images = [*map(photo, range(5)), np.full((120, 160, 3), 90, np.uint8)]
    rows = np.stack([one.describe(image) for image in images])
    packed = np.pad(one.pack_rows(rows), ((0, 0), (3, 8)))[:, 3:-8]  # rows that do not lie side by side
    groups = np.array([[0, 1, 5], [3, 3, 2]])
    expected = one.similarity(rows, rows)
    for found in (one.prepared(rows), one.opened(packed)):
        for count in (0, 1, 6):
            np.testing.assert_allclose(found.similarity(rows[:count]), expected[:count], atol=1e-6)
        for similar, group in zip(found.among(groups), groups, strict=True):
            np.testing.assert_allclose(similar, expected[np.ix_(group, group)], atol=1e-6)
    assert one.opened(packed[:0]).similarity(rows).shape == (6, 0)
    with pytest.raises(ValueError, match="packed rows of shape"):
        one.opened(packed[:, :-1])


@pytest.mark.parametrize("name", ["cedd", "cedd-rotated", LIGHT])
def test_comparison_has_the_same_bits_without_kernels(name: str) -> None:
    kind, rows = descriptor(name), np.stack([descriptor(name).describe(photo(seed)) for seed in range(9)])
    packed = kind.pack_rows(rows)
    for count in (1, 9):
        with without_library():
            expected = kind.opened(packed).similarity(rows[:count])
        np.testing.assert_array_equal(kind.opened(packed).similarity(rows[:count]), expected)


def test_name_of_a_descriptor_is_checked_and_opens_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "open", None)
    for name in ("sift", "onnx:/dev/zero", "../network"):
        with pytest.raises(ValueError, match="is unknown; use one of cedd"):
            descriptor(name)


def test_blur_of_a_block_makes_cedd_robust_to_noise() -> None:
    rng = np.random.default_rng(0)
    noisy = np.clip(photo() + rng.normal(0, 25, (120, 160, 3)), 0, 255).astype(np.uint8)
    same = {
        name: descriptor(name).similarity(*(descriptor(name).describe(i)[None] for i in (photo(), noisy)))[0, 0]
        for name in ("cedd", "cedd-blurred")
    }
    assert same["cedd-blurred"] > 0.8 > 0.5 > same["cedd"]


def test_views_of_different_descriptors_cannot_be_mixed() -> None:
    views = [Views.of_object("a", descriptor(n).describe(photo())[None], [0.0], n) for n in ("cedd", "edges")]
    with pytest.raises(ValueError, match="views of cedd and edges cannot be compared"):
        Views.concatenate(views)
    with pytest.raises(ValueError, match="edges needs the shape"):
        Views.of_object("a", views[0].descriptors, [0.0], "edges")
    with pytest.raises(ValueError, match="the tree compares plain CEDD"):
        ViewIndex(views[1], "tree")


@pytest.mark.parametrize("name", [name for name in NAMES if "cedd" not in name])
@pytest.mark.parametrize(("gain", "exponent"), [(0.6, 1.0), (1.25, 1.0), (1.0, 1.2)])
def test_exposure_and_gamma_hardly_change_descriptors_of_the_object(name: str, gain: float, exponent: float) -> None:
    own = descriptor(name)
    image = np.where(photo(3) > 20, photo(3) * 0.75, photo(3))
    changed = (255 * (np.clip(image * gain, 0, 255) / 255) ** exponent).astype(np.uint8)
    same = own.similarity(own.describe(image.astype(np.uint8))[None], own.describe(changed)[None])
    assert same[0, 0] > 0.9


@examples(20)
@given(st.integers(0, 5), st.integers(0, 3000), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_packed_edges_are_compared_by_the_cosine_of_their_bits(
    queries: int, count: int, share: float, seed: int
) -> None:
    kind, rng = descriptor("edges"), np.random.default_rng(seed)
    asked, rows = ((rng.random((n, 512)) < share * rng.random((n, 1))).astype(np.uint8) for n in (queries, count))
    rows[: count // 5] = 0
    assert kind.size_bytes == 64
    packed = kind.pack_rows(rows)
    np.testing.assert_array_equal(kind.unpack_rows(packed.tobytes()), rows)
    similar = kind.opened(packed).similarity(asked)
    units = [kind.entries(one) for one in (asked, rows)]
    np.testing.assert_allclose(similar, units[0] @ units[1].T, atol=1e-12)
    assert ((similar >= 0) & (similar <= 1)).all()
    assert not similar[:, : count // 5].any()
    for one, unit in zip((asked, rows), units, strict=True):
        np.testing.assert_allclose(np.sqrt((unit * unit).sum(axis=1)), one.any(axis=1), atol=1e-12)


def test_edges_are_bits_of_the_strong_entries() -> None:
    for seed in range(5):
        seen = segment(photo(seed))
        levels = descriptor("edges").describe(seen)
        np.testing.assert_array_equal(levels, _histogram(seen.alone) > 0.16175)
        assert 8 < levels.sum() < 128
    with pytest.raises(ValueError, match=r"edges has levels 0\.\.1"):
        descriptor("edges").pack(levels + levels)


def test_an_object_without_edges_is_not_similar_to_any() -> None:
    kind = descriptor("edges")
    rows = np.stack([kind.describe(np.full((120, 160, 3), 90, np.uint8)), kind.describe(photo())])
    np.testing.assert_allclose(kind.similarity(rows, rows), [[0, 0], [0, 1]])


@pytest.mark.parametrize("spread", [1, 20, 300])
def test_colours_are_compared_by_a_gaussian_kernel(spread: int) -> None:
    kind, rng = descriptor("colours"), np.random.default_rng(0)
    rows = np.clip(128 + rng.normal(0, spread, (200, 32)), 0, 255).astype(np.uint8)
    apart = (rows[:, None].astype(float) - rows) * np.repeat([0.04, 0.03, 0.03], (12, 10, 10))
    expected = np.exp(-(apart * apart).sum(axis=2) / (2 * 2.5**2))
    np.testing.assert_allclose(kind.similarity(rows, rows), expected, rtol=1e-9)


def test_light_descriptor_joins_edges_colours_and_cedd_of_one_segmentation() -> None:
    kind, weights = descriptor(LIGHT), {"edges": 0.36, "colours": 0.36, "cedd": 0.28}
    assert (kind.size_bytes, kind.length, kind.whole_image) == (150, 688, False)
    seen = [segment(photo(seed)) for seed in range(4)]
    rows = np.stack([kind.describe(one) for one in seen])
    parts = {name: np.stack([descriptor(name).describe(one) for one in seen]) for name in weights}
    np.testing.assert_array_equal(rows, np.concatenate(list(parts.values()), axis=1))
    np.testing.assert_array_equal(rows[0], kind.describe(photo(0)))
    assert parts["cedd"].tolist() == [descriptor("cedd").describe(one.alone).tolist() for one in seen]
    expected = sum(weights[name] * descriptor(name).similarity(own, own) for name, own in parts.items())
    np.testing.assert_allclose(kind.similarity(rows, rows), expected, atol=1e-12)


def test_best_descriptor_uses_the_network_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "weights_file", lambda: Path("weights"))
    assert best() == FULL
    assert descriptor(FULL).size_bytes == 406
    monkeypatch.setattr(network, "weights_file", lambda: None)
    assert best() == LIGHT


def test_one_descriptor_with_weight_1_is_that_descriptor() -> None:
    assert descriptor("cedd=1") is descriptor("cedd")


def test_descriptors_with_weights_describe_a_view_as_each_does_alone() -> None:
    both = descriptor("cedd=0.25,edges+colours+cedd=0.75")
    parts = [descriptor(name) for name in ("cedd", "edges+colours+cedd")]
    images = [photo(seed) for seed in range(4)]
    rows = np.stack([both.describe(image) for image in images])
    own = [np.stack([part.describe(image) for image in images]) for part in parts]
    np.testing.assert_array_equal(rows, np.concatenate(own, axis=1))
    similar = [part.similarity(levels, levels) for part, levels in zip(parts, own, strict=True)]
    np.testing.assert_allclose(both.similarity(rows, rows), 0.25 * similar[0] + 0.75 * similar[1], atol=1e-12)
    np.testing.assert_allclose(both.similarity_of_means(rows.astype(float)), both.similarity(rows, rows), atol=1e-12)
    np.testing.assert_array_equal(both.unpack_rows(both.pack_rows(rows).tobytes()), rows)


@pytest.mark.parametrize("name", ["cedd=0.5", "cedd=0.5,edges=0.6", "cedd=1.5,edges=-0.5", "cedd=a", "cedd=0.5,edges"])
def test_weights_that_do_not_add_up_to_1_are_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="all together 1"):
        descriptor(name)


def plain_rotation(levels: np.ndarray, steps: int) -> list[int]:
    """Return CEDD levels after rotations by 45°: horizontal, 45°, vertical, 135°, and horizontal again."""
    directions = [2, 4, 3, 5]
    found = levels.tolist()
    for i, texture in enumerate(directions):
        to = directions[(i + steps) % 4]
        found[24 * to : 24 * to + 24] = levels[24 * texture : 24 * texture + 24].tolist()
    return found


def test_rotated_cedd_takes_the_most_similar_rotation() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 8, (n, 144), np.uint8) for n in (3, 5))
    kind, plain = descriptor("cedd-rotated"), descriptor("cedd")
    rotated = [np.array([plain_rotation(row, steps) for row in a], np.uint8) for steps in range(4)]
    expected = np.max([plain.similarity(one, b) for one in rotated], axis=0)
    np.testing.assert_array_equal(kind.similarity(a, b), expected)
    np.testing.assert_allclose(kind.prepared(b).similarity(a), expected, atol=1e-12)
    np.testing.assert_allclose(kind.similarity_of_means(b.astype(float)), kind.similarity(b, b), atol=1e-12)
    groups = np.array([[0, 1, 2], [4, 3, 1]])
    among = kind.prepared(b).among(groups)
    for rows, similar in zip(groups, among, strict=True):
        np.testing.assert_allclose(similar, kind.similarity(b[rows], b[rows]), atol=1e-12)


def stripes(angle_deg: float) -> np.ndarray:
    """Return stripes of two colours along a direction, counter-clockwise from the right."""
    y, x = np.indices((480, 480))
    across = x * np.sin(np.radians(angle_deg)) + y * np.cos(np.radians(angle_deg))
    return np.where((across // 27 % 2 == 0)[:, :, None], [40, 40, 200], [200, 120, 40]).astype(np.uint8)


@pytest.mark.parametrize(("angle_deg", "texture"), [(0, 2), (45, 4), (90, 3), (135, 5)])
def test_a_rotation_moves_edges_to_the_next_class(angle_deg: float, texture: int) -> None:
    levels = descriptor("cedd-rotated").describe(stripes(angle_deg)).reshape(6, 24).sum(axis=1)
    assert 2 + levels[2:].argmax() == texture


def test_an_image_that_is_rotated_by_90_degrees_is_the_same_for_rotated_cedd() -> None:
    image = np.full((240, 240, 3), 30, np.uint8)
    image[:, 40:120] = 90, 160, 220
    image[60:90, 100:] = 200, 60, 40
    rows = [descriptor("cedd").describe(one)[None] for one in (image, np.ascontiguousarray(np.rot90(image)))]
    assert descriptor("cedd-rotated").similarity(*rows)[0, 0] == 1 > descriptor("cedd").similarity(*rows)[0, 0]
