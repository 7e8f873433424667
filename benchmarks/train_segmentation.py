"""Train the segmentation network: python -m benchmarks.train_segmentation network.onnx.

Needs PyTorch and onnx, which no other part of the project needs: pip install torch onnx. Scenes are drawn first, then
the network is trained. Model card: docs/explanation/segmentation-network.md.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from torch import nn
from torch.nn import functional

from benchmarks.training_scenes import SIDES, scene, solid
from hbr.segmentation.background import Background
from hbr.segmentation.silhouette import HEIGHT, WIDTH, planes

BATCH = 16
LEFT_OUT = 200
#: Shares of batches without a background, with the empty-table image, and learned from a few and from many views.
BACKGROUNDS = (0.25, 0.2, 0.2, 0.35)


class Layer(nn.Module):
    def __init__(self, inner: int, outer: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inner, outer, 3, stride, dilation, dilation=dilation)
        self.norm: nn.Module = nn.BatchNorm2d(outer)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.relu(self.norm(self.conv(x)))


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.full = nn.Conv2d(10, 8, 1)
        self.first = Layer(10, 16, 2)
        self.quarter = nn.Sequential(Layer(16, 24, 2), Layer(24, 24))
        self.eighth = nn.Sequential(Layer(24, 48, 2), Layer(48, 48))
        self.deep = nn.Sequential(Layer(48, 64, 2), Layer(64, 64), Layer(64, 64, dilation=2))
        self.up_eighth, self.to_eighth = nn.ConvTranspose2d(64, 48, 2, 2), Layer(48, 48)
        self.up_quarter, self.to_quarter = nn.ConvTranspose2d(48, 24, 2, 2), Layer(24, 24)
        self.up_half, self.to_half = nn.ConvTranspose2d(24, 16, 2, 2), Layer(16, 16)
        self.up_full = nn.ConvTranspose2d(16, 8, 2, 2)
        self.out = nn.Conv2d(8, 2, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        half = self.first(x)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        eighth = self.to_eighth(eighth + self.up_eighth(self.deep(eighth)))
        quarter = self.to_quarter(quarter + self.up_quarter(eighth))
        half = self.to_half(half + self.up_half(quarter))
        return self.out(functional.relu(self.full(x) + self.up_full(half)))


def started(file: Path) -> Network:
    """Return an exported network for further training. Its normalisation is part of its weights already."""
    net = Network()
    for one in net.modules():
        if isinstance(one, Layer):
            one.norm = nn.Identity()
    order: list[nn.Module] = []  # as in the file: as they are used
    convs = [one for one in net.modules() if isinstance(one, nn.Conv2d | nn.ConvTranspose2d)]
    hooks = [one.register_forward_hook(lambda module, *_: order.append(module)) for one in convs]
    net(torch.zeros(1, 10, HEIGHT, WIDTH))
    for hook in hooks:
        hook.remove()
    graph = onnx.load(str(file)).graph
    values = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    nodes = [node for node in graph.node if node.op_type in ("Conv", "ConvTranspose")]
    for module, node in zip(order, nodes, strict=True):
        module.weight.data[:] = values[node.input[1]]  # type: ignore[union-attr, index]
        module.bias.data[:] = values[node.input[2]]  # type: ignore[union-attr, index]
    return net


def scenes(rng: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
    """Return the planes without the last, as bytes, for each background, the true masks, and the numbers of views."""
    bank: list = []
    inputs = np.empty((count, 4, 10 - 3, HEIGHT, WIDTH), np.int8)
    shown = np.empty((count, 2, HEIGHT, WIDTH), np.uint8)
    trust = np.zeros((count, 4), np.float32)
    for n in range(count):
        if n % 20 == 0:  # new solids all the time
            bank = [*bank[-40:], solid(rng)] if len(bank) > 20 else [solid(rng) for _ in range(24)]
        sides = bank[int(rng.integers(len(bank)))]
        clutter = [bank[int(rng.integers(len(bank)))][int(rng.integers(SIDES))] for _ in range(4)]
        many = int(rng.integers(4, 10))
        found = scene(rng, sides, clutter, many)
        flip = rng.random() < 0.5
        frame, empty, *rotated = (_small(one, flip) for one in (found.image, found.empty, *found.rotated))
        few = [rotated[k] for k in rng.permutation(many)[: int(rng.integers(1, 4))]]
        shown[n] = _small(found.object, flip), _small(found.platter, flip)
        shape = HEIGHT, WIDTH
        backgrounds = None, Background(empty), Background.learned(few, shape), Background.learned(rotated, shape)
        for k, background in enumerate(backgrounds):
            made = planes(frame, None if background is None else background.difference(frame))
            inputs[n, k] = np.rint(127 * np.concatenate([2 * made[:3], made[5:9]])).clip(-127, 127)
            trust[n, k] = made[9, 0, 0]
        if n % 500 == 0:
            print(f"scene {n}", flush=True)
    return inputs, shown, trust


def batch(
    rng: np.random.Generator, data: tuple[np.ndarray, ...], rows: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return inputs and their true masks, with random colours, sizes and places."""
    inputs, shown, trust = data
    which = rng.choice(4, len(rows), p=BACKGROUNDS)
    made = torch.tensor(inputs[rows, which]).float() / 127
    for image in made[:, :3]:
        levels = (image + 1)[torch.tensor(rng.permutation(3))] * float(rng.uniform(0.8, 1.2)) - 1
        image[:] = levels.clip(-1, 1) / 2
        if rng.random() < 0.05:
            image[:] = image.mean(0, keepdim=True)
    wanted = torch.tensor(shown[rows]).float() / 255
    move = np.zeros((len(rows), 2, 3), np.float32)
    move[:, 0, 0] = rng.uniform(0.75, 1.15, len(rows))
    move[:, 1, 1] = move[:, 0, 0] * np.exp(rng.uniform(-0.3, 0.15, len(rows)))
    move[:, :, 2] = rng.uniform(-0.08, 0.08, (len(rows), 2))
    grid = functional.affine_grid(torch.tensor(move), [len(rows), 7, HEIGHT, WIDTH], align_corners=False)
    made = functional.grid_sample(made, grid, padding_mode="reflection", align_corners=False)
    wanted = functional.grid_sample(wanted, grid, align_corners=False)
    trusted = torch.tensor(trust[rows, which])[:, None, None, None].expand(-1, 1, HEIGHT, WIDTH)
    return torch.cat([made[:, :3], _places(len(rows)), made[:, 3:], trusted], 1), wanted


def train(net: Network, data: tuple[np.ndarray, ...], steps: int, seed: int, rate: float) -> Network:
    """Return the trained network; the first scenes are left out."""
    rng = np.random.default_rng(seed)
    optimiser = torch.optim.AdamW(net.parameters(), weight_decay=1e-3)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1, (step + 1) / 100) * (1 + np.cos(np.pi * step / steps)) + 1e-5
        inputs, wanted = batch(rng, data, rng.integers(LEFT_OUT, len(data[0]), BATCH))
        logits = net(inputs)
        found = torch.sigmoid(logits)
        overlap = 1 - (2 * (found * wanted).sum((2, 3)) + 1) / ((found + wanted).sum((2, 3)) + 1)
        weighted = (overlap * torch.tensor([1.0, 0.3])).mean()
        loss = 2 * functional.binary_cross_entropy_with_logits(logits, wanted) + weighted
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 2.0)
        optimiser.step()
        if (step + 1) % 200 == 0:
            print(f"step {step + 1}: loss {loss.item():.3f}; {check(net.eval(), data)}", flush=True)
            net.train()
    return net.eval()


def check(net: Network, data: tuple[np.ndarray, ...]) -> str:
    """Return the mean overlap in the scenes that were left out, for each kind of background."""
    words = []
    with torch.no_grad():
        for which, name in enumerate(("none", "image", "few", "many")):
            rows = np.arange(LEFT_OUT)
            made = torch.tensor(data[0][rows, which]).float() / 127
            trusted = torch.tensor(data[2][rows, which])[:, None, None, None].expand(-1, 1, HEIGHT, WIDTH)
            inputs = torch.cat([made[:, :3] / 2, _places(LEFT_OUT), made[:, 3:], trusted], 1)
            found, true = net(inputs)[:, 0] > 0, torch.tensor(data[1][rows, 0]) > 127
            overlap = (found & true).sum((1, 2)) / (found | true).sum((1, 2)).clip(1)
            words.append(f"{name} {overlap.mean():.3f}")
    return ", ".join(words)


def _small(image: np.ndarray, flip: bool) -> np.ndarray:
    made = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return made[:, ::-1].copy() if flip else made


def _places(count: int) -> torch.Tensor:
    y, x = np.meshgrid(np.linspace(-1, 1, HEIGHT), np.linspace(-1, 1, WIDTH), indexing="ij")
    return torch.tensor(np.stack([x, y])[None], dtype=torch.float32).expand(count, -1, -1, -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    parser.add_argument("--scenes", type=int, default=6000)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--start", type=Path, help="an exported network to train further")
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="files that keep drawn scenes for other runs")
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(given.seed)
    sets = []
    for file in given.data or [None]:
        if file is not None and file.exists():
            with np.load(file) as loaded:
                sets.append([loaded[name] for name in loaded.files])
            continue
        sets.append(list(scenes(np.random.default_rng(given.seed), given.scenes)))
        if file is not None:
            np.savez(file, *sets[-1])
    data = tuple(np.concatenate(parts) for parts in zip(*sets, strict=True))
    net = train(started(given.start) if given.start else Network(), data, given.steps, given.seed, given.rate)
    example = torch.zeros(1, 10, HEIGHT, WIDTH)
    names = {"input_names": ["x"], "output_names": ["y"]}
    torch.onnx.export(net, (example,), given.out, opset_version=13, dynamo=False, **names)


if __name__ == "__main__":
    main()
