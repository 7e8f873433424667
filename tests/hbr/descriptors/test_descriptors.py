import os
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from hbr import DenseIndex, ViewIndex, Views, update_belief
from hbr.descriptors import Descriptor, descriptor, load_descriptor, load_model, loaded_models, names
from hbr.descriptors.embedding import MAX_MODEL_BYTES
from tests.networks import means_network


@pytest.fixture(params=names())
def one(request: pytest.FixtureRequest) -> Descriptor:
    return descriptor(request.param)


def photo(seed: int = 0) -> np.ndarray:
    """Return an image of a coloured, striped blob before a dark background."""
    rng = np.random.default_rng(seed)
    image = np.full((120, 160, 3), 20, np.uint8)
    y, x = np.indices((120, 160))
    inside = ((y - 60) / 40) ** 2 + ((x - 80) / 30) ** 2 < 1
    image[inside] = rng.integers(60, 255, 3)
    image[inside & (x // 6 % 2 == 0)] = rng.integers(60, 255, 3)
    return image


def test_attributes_fit_the_levels_and_unpack_restores_packed_levels(one: Descriptor) -> None:
    levels = one.describe(photo())
    assert levels.shape == (one.length,)
    assert levels.dtype == np.uint8
    assert len(one.pack(levels)) == one.size_bytes <= 160
    assert descriptor(one.name) is one
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


def test_embedding_of_a_neural_network_is_a_descriptor(tmp_path: Path) -> None:
    file = tmp_path / "means.onnx"
    file.write_bytes(means_network())
    own = load_descriptor(f"onnx:{file}")
    assert (own.length, own.size_bytes) == (3, 3)
    assert own.name == f"onnx:{sha256(means_network()).hexdigest()}"
    assert descriptor(own.name) is load_descriptor(own.name) is load_model(file) is own
    assert own in loaded_models()
    red, blue = (np.full((60, 60, 3), colour, np.uint8) for colour in ((20, 20, 220), (220, 20, 20)))
    levels = np.stack([own.describe(image) for image in (red, blue)])
    assert levels[0].argmax() == 0  # R, G, B
    assert levels[1].argmax() == 2
    similar = own.similarity(levels, levels)
    np.testing.assert_allclose(np.diag(similar), 1, atol=1e-6)
    assert similar[0, 1] < 0.5
    np.testing.assert_array_equal(own.unpack(own.pack(levels[0])), levels[0])
    index = DenseIndex(Views(levels, [0.0, 0.0], np.array([0, 1]), ("red", "blue"), own.name))  # type: ignore[arg-type]
    assert update_belief(levels[1], 0.0, index).ranking().object_index[0] == 1


def test_unusable_model_is_rejected_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        load_model(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ValueError, match="no model that OpenCV can run"):
        load_model(tmp_path / "text.onnx")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(ValueError, match="not a regular file"):
            load_model(path)
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate(MAX_MODEL_BYTES + 1)
    with pytest.raises(ValueError, match="larger than"):
        load_model(tmp_path / "large.onnx")


def test_name_of_a_descriptor_is_checked_and_opens_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "means.onnx"
    file.write_bytes(means_network())
    monkeypatch.setattr(Path, "open", None)
    for name in (f"onnx:{file}", "onnx:", f"onnx:{'0' * 64}"):
        with pytest.raises(ValueError, match="is not loaded"):
            descriptor(name)
    with pytest.raises(ValueError, match="'sift' is unknown; use one of cedd"):
        descriptor("sift")


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


@pytest.mark.parametrize("name", [name for name in names() if not name.startswith("cedd")])
@pytest.mark.parametrize(("gain", "exponent"), [(0.6, 1.0), (1.25, 1.0), (1.0, 1.2)])
def test_exposure_and_gamma_hardly_change_descriptors_of_the_object(name: str, gain: float, exponent: float) -> None:
    own = descriptor(name)
    image = np.where(photo(3) > 20, photo(3) * 0.75, photo(3))
    changed = (255 * (np.clip(image * gain, 0, 255) / 255) ** exponent).astype(np.uint8)
    same = own.similarity(own.describe(image.astype(np.uint8))[None], own.describe(changed)[None])
    assert same[0, 0] > 0.9


@pytest.mark.parametrize("name", names())
def test_unpack_rows_equals_unpack_of_each_row(name: str) -> None:
    kind, rng = descriptor(name), np.random.default_rng(0)
    images = rng.integers(0, 256, (5, 64, 64, 3), np.uint8)
    packed = [kind.pack(kind.describe(image)) for image in images]
    rows = kind.unpack_rows(b"".join(packed))
    np.testing.assert_array_equal(rows, [kind.unpack(one) for one in packed])
    assert kind.unpack_rows(b"").shape == (0, kind.length)
    with pytest.raises(ValueError, match="no multiple"):
        kind.unpack_rows(packed[0][1:])
