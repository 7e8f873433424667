"""Sources of a camera that are device files."""

import pytest

from rig.core.camera_node import camera_node


@pytest.mark.parametrize(
    ("source", "node"),
    [
        (0, "/dev/video0"),
        ("2", "/dev/video2"),
        ("/dev/v4l/by-id/usb-camera", "/dev/v4l/by-id/usb-camera"),
        ("/dev/shm/frames/img_%03d.png", None),
        ("recording.avi", None),
        ("rtsp://camera/stream", None),
        ("picamera2:1", None),
    ],
)
def test_recordings_and_streams_are_no_device_files(source, node):
    assert camera_node(source) == node
