"""The device file of a camera."""

from pathlib import Path


def camera_node(source: int | str | Path) -> str | None:
    """Return the path of a camera's device file; None if the source is a file, a stream or no camera of V4L2."""
    path = f"/dev/video{source}" if str(source).isdigit() else str(source)
    # /dev/shm contains ordinary files
    return path if path.startswith("/dev/") and not path.startswith("/dev/shm/") else None
