"""docs/how-to/join-a-neural-network.md"""

import cv2
import numpy as np
import pytest

import hbr
from tests.docs.pages import blocks, run
from tests.networks import early_network


def drawn(brightness: int, side_deg: float, hue: int) -> np.ndarray:
    image = np.full((128, 128, 3), 255, np.uint8)
    cv2.circle(image, (64, 64), 34, (brightness, hue, 60), -1)
    x = round(64 + 22 * np.sin(np.deg2rad(side_deg)))
    cv2.rectangle(image, (x - 8, 48), (x + 8, 72), (hue, brightness, 200), -1)
    return image


def test_steps_of_the_page_find_objects_and_measure_the_open_set_score(tmp_path):
    page = run("\n".join(blocks("join-a-neural-network")))
    network, target = tmp_path / "net.onnx", tmp_path / "own.npz"
    network.write_bytes(early_network())
    assert page["layers_of"](network) == ("c", "early", "p", "y")
    sides = np.arange(0, 360, 45.0)
    enrolled = {f"object-{n}": [drawn(30 + 50 * n, side, 200 - 45 * n) for side in sides] for n in range(4)}
    page["fit"](network, "early", [image for images in enrolled.values() for image in images], target)
    kind, index, rule = page["model_of"](target, enrolled)
    assert len(kind.parts) == 2
    assert kind.length == 512 + 32 + kind.parts[1].length
    assert rule.searches > 0
    name, outcome = page["search"](kind, index, rule, [drawn(80, side + 4, 155) for side in sides[:4]], 45.0)
    assert (name, outcome) == ("object-1", hbr.Outcome.FOUND)


def test_damaged_files_are_rejected(tmp_path):
    page = run("\n".join(blocks("join-a-neural-network")))
    network, target = tmp_path / "net.onnx", tmp_path / "own.npz"
    network.write_bytes(early_network())
    images = [drawn(60, side, 90) for side in (0.0, 60.0, 250.0)]
    with pytest.raises(ValueError, match="no layer 'late'; it has c, early"):
        page["fit"](network, "late", images, target)
    with pytest.raises(ValueError, match="at least 4 x 4"):
        page["fit"](network, "p", images, target)
    with pytest.raises(ValueError, match="at least 2"):
        page["fit"](network, "early", images[:1], target)
    page["fit"](network, "early", images, target)
    content = target.read_bytes()
    for damaged in (content[:200], content[:-30], content.replace(b"mean", b"main")):
        target.write_bytes(damaged)
        with pytest.raises(ValueError, match="is no descriptor that fit_layer has written"):
            page["load_model"](target)
    with pytest.raises(ValueError, match="no ONNX model"):
        network.write_bytes(b"\x3a\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff")
        page["layers_of"](network)
