"""docs/how-to/add-a-descriptor.md"""

import cv2
import numpy as np
import pytest

import hbr
from hbr.descriptors import names, register, registry
from tests.docs.pages import blocks, run


@pytest.fixture
def page(monkeypatch):
    monkeypatch.setattr(registry, "_KNOWN", dict(registry._KNOWN))
    return run("\n".join(blocks("add-a-descriptor")))


def drawn(brightness: int, x: int = 64) -> np.ndarray:
    image = np.full((128, 128, 3), 255, np.uint8)
    cv2.circle(image, (x, 64), 30, (brightness,) * 3, -1)
    cv2.rectangle(image, (x - 12, 40), (x + 4, 60), (brightness // 2,) * 3, -1)
    return image


def test_new_descriptor_finds_the_object(page):
    enrolled = {"dark": [drawn(40, x) for x in (60, 64, 68)], "bright": [drawn(180, x) for x in (60, 64, 68)]}
    assert page["find"](enrolled, drawn(45)) == "dark"
    assert page["find"](enrolled, drawn(170)) == "bright"


def test_new_descriptor_keeps_the_protocol(page):
    grey = page["GreyHistogram"]()
    levels = np.array([grey.describe(drawn(b)) for b in (40, 120, 180)])
    assert (grey.unpack(grey.pack(levels[0])) == levels[0]).all()
    assert np.diag(grey.similarity(levels, levels)) == pytest.approx(1.0)
    prepared = grey.prepared(levels)
    assert prepared.among(np.array([[0, 2]]))[0] == pytest.approx(grey.similarity(levels[[0, 2]], levels[[0, 2]]))


def test_name_of_another_descriptor_is_not_replaced(page):
    register(page["GREY"])
    with pytest.raises(ValueError, match="taken"):
        register(page["GreyHistogram"](name="cedd"))
    assert names()[-1] == "grey"
    assert hbr.descriptor("cedd").length == 144
