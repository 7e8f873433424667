"""Train the segmentation network: python -m benchmarks.train_segmentation network.onnx.

Needs PyTorch and onnx, which no other part of the project needs: pip install torch onnx. Scenes are drawn first, then
the network is trained. Model card: docs/explanation/segmentation-network.md.
"""

import argparse

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from benchmarks.training_scenes import CutOut, scene, shape, simulated
from hbr.segmentation.background import Background
from hbr.segmentation.network import COLOURED, EVENLY, HEIGHT, LEARNED, WIDTH

BATCH = 16
LEFT_OUT = 200
#: Shares of batches without a background, with the empty-table image, with one and with three other views.
BACKGROUNDS = (0.42, 0.23, 0.13, 0.22)


class Layer(nn.Module):
    def __init__(self, inner: int, outer: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inner, outer, 3, stride, dilation, dilation=dilation, bias=False)
        self.norm = nn.BatchNorm2d(outer)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.relu(self.norm(self.conv(x)))


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.half = Layer(8, 16, 2)
        self.quarter = nn.Sequential(Layer(16, 24, 2), Layer(24, 24))
        self.eighth = nn.Sequential(Layer(24, 48, 2), Layer(48, 48))
        self.deep = nn.Sequential(Layer(48, 64, 2), Layer(64, 64), Layer(64, 64, dilation=2))
        self.up_eighth, self.to_eighth = nn.ConvTranspose2d(64, 48, 2, 2), Layer(48, 48)
        self.up_quarter, self.to_quarter = nn.ConvTranspose2d(48, 24, 2, 2), Layer(24, 24)
        self.up_half, self.to_half = nn.ConvTranspose2d(24, 16, 2, 2), Layer(16, 16)
        self.out = nn.ConvTranspose2d(16, 2, 2, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        half = self.half(x)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        eighth = self.to_eighth(eighth + self.up_eighth(self.deep(eighth)))
        quarter = self.to_quarter(quarter + self.up_quarter(eighth))
        return self.out(self.to_half(half + self.up_half(quarter)))


def sides(rng: np.random.Generator, drawn: list[list[CutOut]]) -> list[CutOut]:
    """Return an object from four sides."""
    if rng.random() < 0.4:
        own = drawn[int(rng.integers(len(drawn)))]
        first = int(rng.integers(len(own)))
        return [own[(first + n * len(own) // 4) % len(own)] for n in range(4)]
    seed = int(rng.integers(2**31))
    found = [shape(np.random.default_rng(seed)) for _ in range(4)]
    if rng.random() < 0.3:
        return found
    for n in range(1, 4):
        image, share = found[n]
        if n == 2:
            image, share = image[:, ::-1], share[:, ::-1]
        if rng.random() < 0.6:
            image = 0.3 * image + 0.7 * cv2.resize(shape(rng).image, share.shape[::-1])
        if n != 2 and rng.random() < 0.6:
            size = max(8, int(share.shape[1] * rng.uniform(0.5, 1))), share.shape[0]
            image, share = (cv2.resize(np.ascontiguousarray(part), size) for part in (image, share))
        found[n] = CutOut(np.ascontiguousarray(image, np.float32), np.ascontiguousarray(share, np.float32))
    return found


def scenes(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frames, their true masks, and their differences from the empty table and from other views."""
    drawn = simulated(12)
    frames = np.empty((count, HEIGHT, WIDTH, 3), np.uint8)
    shown = np.empty((count, 2, HEIGHT, WIDTH), np.uint8)
    apart = np.empty((count, 3, 2, HEIGHT, WIDTH), np.float16)
    for n in range(count):
        found = scene(rng, sides(rng, drawn), [sides(rng, drawn)[0] for _ in range(4)])
        frames[n], *rotated, empty = (_small(part) for part in (found.image, *found.rotated, found.empty))
        shown[n] = _small(found.object), _small(found.platter)
        median = np.median(rotated, axis=0).astype(np.uint8)
        for k, behind in enumerate((empty, rotated[int(rng.integers(3))], median)):
            difference = Background.learned(behind, (HEIGHT, WIDTH)).difference(frames[n])
            apart[n, k, 0] = np.clip(difference.evenly / EVENLY, -1, 1)
            apart[n, k, 1] = np.clip(difference.coloured / COLOURED, 0, 1)
        if rng.random() < 0.5:
            frames[n], shown[n], apart[n] = (
                frames[n, :, ::-1].copy(),
                shown[n, ..., ::-1].copy(),
                apart[n, ..., ::-1].copy(),
            )
    return frames, shown, apart


def batch(
    rng: np.random.Generator, data: tuple[np.ndarray, ...], rows: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return inputs and their true masks, with random colours, sizes and places."""
    frames, shown, apart = data
    colours = frames[rows].astype(np.float32)
    for image in colours:
        image[:] = image[..., rng.permutation(3)] * rng.uniform(0.8, 1.2)
        if rng.random() < 0.1:
            image[:] = image.mean(axis=-1, keepdims=True)
    which = rng.choice(4, len(rows), p=BACKGROUNDS)
    trust = np.array([0, 1, LEARNED, LEARNED], np.float32)[which][:, None, None, None]
    difference = apart[rows, np.maximum(which - 1, 0)].astype(np.float32) * (trust > 0)
    planes = [
        np.clip(colours, 0, 255).transpose(0, 3, 1, 2) / 255 - 0.5,
        difference,
        np.broadcast_to(trust, difference[:, :1].shape),
    ]
    inputs = torch.tensor(np.concatenate(planes, axis=1), dtype=torch.float32)
    wanted = torch.tensor(shown[rows]).float() / 255
    move = np.zeros((len(rows), 2, 3), np.float32)
    move[:, 0, 0] = rng.uniform(0.75, 1.1, len(rows))
    move[:, 1, 1] = move[:, 0, 0] * rng.uniform(0.9, 1.1, len(rows))
    move[:, :, 2] = rng.uniform(-0.08, 0.08, (len(rows), 2))
    grid = functional.affine_grid(torch.tensor(move), [len(rows), 6, HEIGHT, WIDTH], align_corners=False)
    inputs = functional.grid_sample(inputs, grid, padding_mode="reflection", align_corners=False)
    wanted = functional.grid_sample(wanted, grid, align_corners=False)
    return torch.cat([inputs[:, :3], _places(len(rows)), inputs[:, 3:]], 1), wanted


def train(data: tuple[np.ndarray, ...], steps: int, seed: int) -> Network:
    """Return the trained network; the first scenes are left out."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    net = Network()
    optimiser = torch.optim.AdamW(net.parameters(), weight_decay=1e-3)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 2e-3 * min(1, (step + 1) / 100) * (1 + np.cos(np.pi * step / steps)) + 1e-5
        inputs, wanted = batch(rng, data, rng.integers(LEFT_OUT, len(data[0]), BATCH))
        logits = net(inputs)
        found = torch.sigmoid(logits)
        overlap = 1 - (2 * (found * wanted).sum((2, 3)) + 1) / ((found + wanted).sum((2, 3)) + 1)
        weighted = (overlap * torch.tensor([1.0, 0.3])).mean()
        loss = 2 * functional.binary_cross_entropy_with_logits(logits, wanted) + weighted
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if (step + 1) % 200 == 0:
            print(f"step {step + 1}: loss {loss.item():.3f}", flush=True)
    return net.eval()


def _small(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def _places(count: int) -> torch.Tensor:
    y, x = np.meshgrid(np.linspace(-1, 1, HEIGHT), np.linspace(-1, 1, WIDTH), indexing="ij")
    return torch.tensor(np.stack([x, y])[None], dtype=torch.float32).expand(count, -1, -1, -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    parser.add_argument("--scenes", type=int, default=7400)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    net = train(scenes(np.random.default_rng(given.seed), given.scenes), given.steps, given.seed)
    example = torch.zeros(1, 8, HEIGHT, WIDTH)
    names = {"input_names": ["x"], "output_names": ["y"]}
    torch.onnx.export(net, (example,), given.out, opset_version=13, dynamo=False, **names)


if __name__ == "__main__":
    main()
