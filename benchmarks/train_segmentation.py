# mypy: ignore-errors
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

from benchmarks.training_scenes import SIDES, bench_scene, scene, simulated, solid
from hbr.segmentation.background import Background
from hbr.segmentation.silhouette import HEIGHT, WIDTH, _planes

BATCH = 16
LEFT_OUT = 100
PLANES = 13
#: Shares of batches without a background, with the empty-table image, and learned from a few and from many views.
BACKGROUNDS = (0.2, 0.2, 0.2, 0.4)
#: Share of the scenes on the drawn benches of the package, with other seeds than the benchmarks.
ON_BENCHES = 0.4
#: Share of the other scenes that are on plain ground and cloth, with larger objects.
ON_CLOTH = 0.4


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
        self.full = nn.Conv2d(PLANES, 8, 1)
        self.first = Layer(PLANES, 16, 2)
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


class Fourfold(nn.Module):
    """The same function; the last layers compute four pixels at once, as convolutions."""

    def __init__(self, net: Network) -> None:
        super().__init__()
        self.full, self.up = nn.Conv2d(PLANES, 32, 2, 2), nn.Conv2d(16, 32, 1)
        self.out = nn.Conv2d(32, 8, 3, padding=1)
        self.first, self.quarter, self.eighth, self.deep = net.first, net.quarter, net.eighth, net.deep
        self.up_eighth, self.to_eighth, self.up_quarter = net.up_eighth, net.to_eighth, net.up_quarter
        self.to_quarter, self.up_half, self.to_half = net.to_quarter, net.up_half, net.to_half
        with torch.no_grad():
            for one in (self.full, self.up, self.out):
                one.weight.zero_()
                one.bias.zero_()  # type: ignore[union-attr]
            for down, across in np.ndindex(2, 2):
                pixel = slice(2 * down + across, None, 4)
                self.full.weight[pixel, :, down, across] = net.full.weight[:, :, 0, 0]
                self.full.bias[pixel] = net.full.bias + net.up_full.bias  # type: ignore[index, operator]
                self.up.weight[pixel, :, 0, 0] = net.up_full.weight[:, :, down, across].T
                self.out.bias[pixel] = net.out.bias  # type: ignore[index]
                for y, x in np.ndindex(3, 3):
                    to_y, to_x = down + y - 1, across + x - 1
                    of = slice(2 * (to_y % 2) + to_x % 2, None, 4)
                    self.out.weight[pixel, of, to_y // 2 + 1, to_x // 2 + 1] += net.out.weight[:, :, y, x]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        half = self.first(x)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        eighth = self.to_eighth(eighth + self.up_eighth(self.deep(eighth)))
        quarter = self.to_quarter(quarter + self.up_quarter(eighth))
        half = self.to_half(half + self.up_half(quarter))
        return self.out(functional.relu(self.full(x) + self.up(half)))


def started(file: Path) -> Network:
    """Return an exported network for further training. Its normalisation is part of its weights already.

    Also the former one before plain backgrounds, which did not see how a pixel differs from each other view.
    """
    net = Network()
    for one in net.modules():
        if isinstance(one, Layer):
            one.norm = nn.Identity()
    graph = onnx.load(str(file)).graph
    values = {one.name: torch.tensor(onnx.numpy_helper.to_array(one)) for one in graph.initializer}
    if "up.weight" in values:  # as `Fourfold`
        up, out = values.pop("up.weight"), values.pop("out.weight")
        values.pop("up.bias")
        values["full.weight"] = values["full.weight"][::4, :, :1, :1]
        values["full.bias"], values["up_full.bias"] = values["full.bias"][::4], torch.zeros(8)
        values["up_full.weight"] = torch.stack([up[k::4, :, 0, 0].T for k in range(4)], 2).reshape(16, 8, 2, 2)
        own = values["out.weight"] = torch.zeros(2, 8, 3, 3)
        for y, x in np.ndindex(3, 3):
            pixel = slice(2 * ((y - 1) % 2) + (x - 1) % 2, None, 4)
            own[:, :, y, x] = out[::4, pixel, (y - 1) // 2 + 1, (x - 1) // 2 + 1]
        values["out.bias"] = values["out.bias"][::4]
    for name in ("full.weight", "first.conv.weight"):
        if values[name].shape[1] == PLANES - 3:  # of the former network
            blank = torch.zeros(len(values[name]), 3, *values[name].shape[2:])
            values[name] = torch.cat([values[name][:, :9], blank, values[name][:, 9:]], 1)
    net.load_state_dict(values)
    return net


def scenes(rng: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
    """Return the planes without place and trust, as bytes, for each background, the true masks, and the trust."""
    bank: list = []
    simulators = simulated()
    inputs = np.empty((count, 4, PLANES - 3, HEIGHT, WIDTH), np.int8)
    shown = np.empty((count, 2, HEIGHT, WIDTH), np.uint8)
    trust = np.zeros((count, 4), np.float32)
    for n in range(count):
        if n % 12 == 0:  # new solids all the time
            bank = [*bank[-40:], solid(rng)] if len(bank) > 20 else [solid(rng) for _ in range(24)]
        sides = bank[int(rng.integers(len(bank)))]
        many = int(rng.integers(4, 10))
        if rng.random() < ON_BENCHES:
            found = bench_scene(rng, sides, many)
        else:
            clutter = [bank[int(rng.integers(len(bank)))][int(rng.integers(SIDES))] for _ in range(4)]
            if rng.random() < 0.1:
                sides = simulators[int(rng.integers(len(simulators)))]
            found = scene(rng, sides, clutter, many, cloth=rng.random() < ON_CLOTH)
        flip, blur = rng.random() < 0.5, rng.random() < 0.7
        frame, empty, *rotated = (_small(one, flip, blur) for one in (found.image, found.empty, *found.rotated))
        few = [rotated[k] for k in rng.permutation(many)[: int(rng.integers(1, 4))]]
        shown[n] = _small(found.object, flip, False), _small(found.platter, flip, False)
        shape = HEIGHT, WIDTH
        backgrounds = None, Background(empty), Background.learned(few, shape), Background.learned(rotated, shape)
        for k, background in enumerate(backgrounds):
            made = _planes(frame, None if background is None else background.difference(frame))[0]
            inputs[n, k] = np.rint(127 * np.concatenate([2 * made[:3], made[5:12]])).clip(-127, 127)
            trust[n, k] = made[12, 0, 0]
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
    move[:, 0, 0] = rng.uniform(0.7, 1.15, len(rows))
    move[:, 1, 1] = move[:, 0, 0] * np.exp(rng.uniform(-0.3, 0.15, len(rows)))
    move[:, :, 2] = rng.uniform(-0.08, 0.08, (len(rows), 2))
    grid = functional.affine_grid(torch.tensor(move), [len(rows), PLANES - 3, HEIGHT, WIDTH], align_corners=False)
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


def _small(image: np.ndarray, flip: bool, blur: bool) -> np.ndarray:
    made = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    made = cv2.GaussianBlur(made, (5, 5), 0.8) if blur else made
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
    example = torch.zeros(1, PLANES, HEIGHT, WIDTH)
    names = {"input_names": ["x"], "output_names": ["y"]}
    torch.onnx.export(Fourfold(net).eval(), (example,), given.out, opset_version=13, dynamo=False, **names)


if __name__ == "__main__":
    main()
