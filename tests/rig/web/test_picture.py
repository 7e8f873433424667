"""The live picture: its age tells that the camera gives no new one."""

import asyncio
from base64 import b64encode

import numpy as np

from rig.web.picture import LivePicture
from sim.clock import VirtualClock


def test_age_grows_until_the_next_frame():
    clock = VirtualClock()
    picture = LivePicture(clock)
    assert picture.age_s is None
    assert picture.jpeg() is None
    image = np.zeros((48, 64, 3), np.uint8)
    picture.show(image)
    clock.sleep(12.0)
    assert picture.age_s == 12.0
    first = picture.jpeg()
    assert first is not None
    picture.show(image)
    assert picture.age_s == 0.0
    assert picture.jpeg()[0] == first[0] + 1


def test_idle_camera_is_asked_only_while_a_page_looks():
    clock = VirtualClock()
    picture = LivePicture(clock)
    assert not picture.wanted
    picture.want()
    assert picture.wanted
    clock.sleep(6.0)
    assert not picture.wanted


def test_frame_that_is_known_already_is_shown_without_being_sent_again(served, monkeypatch):
    monkeypatch.setattr("rig.web.server.PICTURE_S", 0.0)
    answers = iter([{"number": 1, "jpeg": b64encode(b"frame").decode(), "age_s": 0.1}, {"jpeg": "", "age_s": 0.4}])
    monkeypatch.setattr(served.server.bench, "call", lambda *_, **__: next(answers))
    assert [asyncio.run(served.server.picture()) for _ in range(2)] == [(b"frame", 0.1), (b"frame", 0.4)]
