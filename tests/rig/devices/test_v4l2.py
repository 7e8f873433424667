"""Modes of a camera, as its driver lists them, and the choice among them."""

import errno
import struct
from pathlib import Path

import pytest

from rig.devices import v4l2
from rig.devices.v4l2 import VideoMode, choose_mode

C920 = {
    b"YUYV": {(640, 480): [(1, 30), (1, 15)], (1920, 1080): [(1, 5)]},
    b"H264": {(1920, 1080): [(1, 30)]},
    b"MJPG": {(640, 480): [(1, 30)], (1920, 1080): [(1, 30), (1, 24)]},
}


def driver(formats, *, stepwise=False, controls=None):
    """Return the ``ioctl`` of a camera driver, after linux/videodev2.h; ``controls`` have smallest, largest, step."""

    def answer(_file, request, argument):
        index = int.from_bytes(argument[:4], "little")
        number = lambda at: int.from_bytes(argument[at : at + 4], "little")  # noqa: E731
        words = lambda *values: b"".join(value.to_bytes(4, "little") for value in values)  # noqa: E731
        try:
            match request:
                case 0xC0405602 if number(4) == 1:
                    return argument[:44] + list(formats)[index] + argument[48:]
                case 0xC02C564A:
                    width, height = list(formats[argument[4:8]])[index]
                    if stepwise:
                        return argument[:8] + words(2, 16, width, 16, 16, height, 16, 0, 0)
                    return argument[:8] + words(1, width, height, *(0,) * 6)
                case 0xC0445624:
                    return argument[:40] + words(*controls[number(0)]) + argument[52:]
                case 0xC034564B:
                    numerator, denominator = formats[argument[4:8]][number(8), number(12)][index]
                    return argument[:16] + words(1, numerator, denominator, *(0,) * 6)
        except (IndexError, KeyError):
            pass
        raise OSError(errno.EINVAL, "no more")

    return answer


@pytest.mark.parametrize("stepwise", [False, True])
def test_modes_are_those_that_opencv_converts(monkeypatch, tmp_path, stepwise):
    node = tmp_path / "video0"
    node.touch()
    monkeypatch.setattr(v4l2, "ioctl", driver(C920, stepwise=stepwise))
    assert v4l2.modes(node) == (
        VideoMode("YUYV", 640, 480, 30.0),
        VideoMode("YUYV", 1920, 1080, 5.0),
        VideoMode("MJPG", 640, 480, 30.0),
        VideoMode("MJPG", 1920, 1080, 30.0),
    )
    assert v4l2.modes(Path("/nowhere")) == ()


def test_uncompressed_mode_is_chosen_if_it_is_fast_enough(monkeypatch, tmp_path):
    node = tmp_path / "video0"
    node.touch()
    monkeypatch.setattr(v4l2, "ioctl", driver(C920))
    offered = v4l2.modes(node)
    assert choose_mode(offered, 640, 480, 30).fourcc == "YUYV"
    assert choose_mode(offered, 1920, 1080, 30).fourcc == "MJPG"
    assert choose_mode(offered, 1920, 1080, 5).fourcc == "YUYV"
    assert str(choose_mode(offered, 800, 600, 30, "MJPG")) == "640x480 at 30 frames/s (MJPG)"
    fast, slow, silent = (VideoMode(name, 640, 480, fps) for name, fps in (("MJPG", 30), ("YUYV", 26), ("YUYV", 0)))
    assert [choose_mode([fast, slow], 640, 480, fps) for fps in (30, 28)] == [fast, slow]  # a tenth less is enough
    assert choose_mode([fast, silent], 640, 480, 30) is silent  # its rate is not known
    assert choose_mode([slow, VideoMode("YUYV", 640, 480, 5)], 640, 480, 30) is slow
    assert choose_mode((), 640, 480, 30) is None
    assert choose_mode([VideoMode("H264", 640, 480, 30)], 640, 480, 30) is None


def test_controls_are_listed_with_their_ranges_and_values(monkeypatch, tmp_path):
    node = tmp_path / "video0"
    node.touch()
    offered = {
        0x98_0001: (6, b"User Controls", 0, 0, 0, 0, 0),  # the title of a class
        0x98_0900: (1, b"Brightness", -64, 64, 1, 0, 0),
        0x98_0901: (1, b"Disabled", 0, 1, 1, 0, 1),
        0x9A_0902: (1, b"Exposure Time, Absolute", 3, 2047, 1, 250, 0x10),
    }

    def answer(_file, request, argument):
        if request == 0xC008561B:
            number, _ = struct.unpack("Ii", argument)
            return struct.pack("Ii", number, 7)
        assert request == 0xC0445624
        before = int.from_bytes(argument[:4], "little") & 0x7FFFFFFF
        following = next((number for number in offered if number > before), None)
        if following is None:
            raise OSError(errno.EINVAL, "no more")
        kind, name, *numbers = offered[following]
        return struct.pack("II32s4iI8x", following, kind, name, *numbers)

    monkeypatch.setattr(v4l2, "ioctl", answer)
    assert v4l2.controls(node) == (
        v4l2.VideoControl(0x98_0900, "Brightness", -64, 64, 1, 0, 7),
        v4l2.VideoControl(0x9A_0902, "Exposure Time, Absolute", 3, 2047, 1, 250, 7),
    )
    assert v4l2.controls(Path("/nowhere")) == ()
