import numpy as np
import pytest

from hbr.descriptors import Descriptor, descriptor, names


@pytest.fixture(params=names())
def one(request: pytest.FixtureRequest) -> Descriptor:
    return descriptor(request.param)


def photo(seed: int = 0, size: tuple[int, int] = (120, 160)) -> np.ndarray:
    """A coloured blob with stripes before a dark ground."""
    rng = np.random.default_rng(seed)
    image = np.full((*size, 3), 20, np.uint8)
    y, x = np.indices(size)
    inside = ((y - size[0] / 2) / 40) ** 2 + ((x - size[1] / 2) / 30) ** 2 < 1
    image[inside] = rng.integers(60, 255, 3)
    image[inside & (x // 6 % 2 == 0)] = rng.integers(60, 255, 3)
    return image


def test_what_it_says_of_itself_holds(one: Descriptor) -> None:
    levels = one.describe(photo())
    assert levels.shape == (one.length,)
    assert levels.dtype == np.uint8
    assert len(one.pack(levels)) == one.size_bytes <= 160
    assert descriptor(one.name) is one


def test_packing_loses_nothing(one: Descriptor) -> None:
    for seed in range(5):
        levels = one.describe(photo(seed))
        np.testing.assert_array_equal(one.unpack(one.pack(levels)), levels)
    with pytest.raises(ValueError, match="bytes"):
        one.unpack(bytes(one.size_bytes - 1))


def test_similarity_is_1_to_itself_symmetric_and_between_0_and_1(one: Descriptor) -> None:
    rows = np.stack([one.describe(photo(seed)) for seed in range(6)])
    similar = one.similarity(rows, rows)
    assert similar.shape == (6, 6)
    np.testing.assert_allclose(np.diag(similar), 1, atol=1e-6)
    np.testing.assert_allclose(similar, similar.T, atol=1e-6)
    assert (similar >= 0).all()
    assert (similar <= 1 + 1e-12).all()
    assert similar[~np.eye(6, dtype=bool)].max() < 0.999
    np.testing.assert_allclose(one.similarity(rows[:2], rows), similar[:2], atol=1e-6)


def test_an_unknown_name_is_answered_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="'sift' is unknown; use one of cedd"):
        descriptor("sift")
