"""Computing time of a view with a layer of a neural network, as a ratio to a guessed view without it.

`python -m benchmarks.layer_cost [--network FILE --layer NAME] [--views 40]`

Without a file, the network has the first blocks of MobileNetV2 with random weights: the time does not depend on them.
The peer is a view of 320 x 240 before another bench without a picture: segmented by a guess, and described by the
rig's own descriptor. CPU time of one thread; the two are measured in turn.
"""

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.descriptors import load_model
from hbr.descriptors.layer_embedding import fit_layer
from hbr.evaluation.changed_bench import HARD, Bench, Visit
from sim.objects.shelf import shelf
from sim.visit import seen_on_visit
from tests.networks import network, node, weights


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--network", type=Path)
    options.add_argument("--layer", default="b3")
    options.add_argument("--views", type=int, default=40)
    given = options.parse_args()
    cv2.setNumThreads(1)
    frames = [frame(number) for number in range(given.views)]
    with TemporaryDirectory() as folder:
        file, target = given.network or Path(folder) / "early.onnx", Path(folder) / "own.npz"
        if given.network is None:
            file.write_bytes(early_blocks())
        fit_layer(file, given.layer, [hbr.segment(one) for one in frames], target)
        joined = load_model(target)
    own = hbr.descriptor("edges+colours")
    seconds = np.array([[timed(one, own), timed(one, joined)] for one in frames])
    plain, with_layer = np.median(seconds, axis=0)
    print(
        json.dumps(
            {"guessed_view_ms": plain * 1e3, "with_layer_ms": with_layer * 1e3, "ratio": with_layer / plain}, indent=2
        )
    )


def timed(image: NDArray[np.uint8], kind: hbr.descriptors.Descriptor) -> float:
    """Return the CPU time to segment and describe a frame, in seconds."""
    begun = time.process_time()
    kind.describe(hbr.segment(image))
    return time.process_time() - begun


def frame(number: int) -> NDArray[np.uint8]:
    """Return an object on a changed bench, uint8 (240, 320, 3)."""
    solid = list(shelf().values())[number % len(shelf())]
    visit = Visit(Bench.drawn(np.random.default_rng(number)), HARD, np.random.default_rng(number))
    seen = seen_on_visit(visit, lambda image: solid.draw(image, 20.0 * number), 0.0)
    return cv2.resize(seen, (320, 240), interpolation=cv2.INTER_AREA).astype(np.uint8)


def early_blocks() -> bytes:
    """Return the stem and the first three blocks of MobileNetV2 (24 channels of 56 x 56) with random weights."""
    rng = np.random.default_rng(0)
    nodes, stored = [], []
    at, channels = b"x", 3
    layout = (  # name, channels, kernel, stride, groups by channel
        *(("stem", 32, 3, 2, False), ("b1d", 32, 3, 1, True), ("b1", 16, 1, 1, False)),
        *(("b2e", 96, 1, 1, False), ("b2d", 96, 3, 2, True), ("b2", 24, 1, 1, False)),
        *(("b3e", 144, 1, 1, False), ("b3d", 144, 3, 1, True), ("b3", 24, 1, 1, False)),
    )
    for name, out, side, stride, grouped in layout:
        values = rng.normal(0, 1, (out, 1 if grouped else channels, side, side)) / np.sqrt(side * side * channels)
        stored.append(weights(name.encode() + b"w", values.astype(np.float32)))
        attributes: dict[str, int | list[int]] = {
            "kernel_shape": [side, side],
            "strides": [stride, stride],
            "pads": [side // 2] * 4,
            "group": out if grouped else 1,
        }
        target = name.encode() if name in ("b1", "b2", "b3") else name.encode() + b"c"
        nodes.append(node([at, name.encode() + b"w"], target, b"Conv", **attributes))
        if target != name.encode():
            nodes.append(node([target], name.encode(), b"Relu"))
        at, channels = name.encode(), out
    nodes += [node([b"b3"], b"p", b"GlobalAveragePool"), node([b"p"], b"y", b"Flatten")]
    return network(nodes, stored, b"y", 24)


if __name__ == "__main__":
    main()
