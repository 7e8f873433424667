"""Problems of an empty-table image: codes with parameters, and their texts."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from hbr.segmentation.background import Issue
from rig.core.phrases import filled


class TableProblemCode(StrEnum):
    """Problems of an empty-table image. The parameters are listed with each code."""

    CAMERA_MOVES = "camera-moves"
    """The bench rotates its camera, and no image is needed."""
    MISSING = "missing"
    UNREADABLE = "unreadable"
    """``detail``: the message of the error."""
    OTHER_SIZE = "other-size"
    """``image_px`` and ``frame_px``, (width, height)."""
    OTHER_CAMERA = "other-camera"
    """``image_camera`` and ``camera``, their names."""
    OLD = "old"
    """``hours`` since the image was taken."""
    FUTURE = "future"
    """``hours`` until the date of the image."""
    SETTING = "setting"
    """A camera setting has changed: ``name``, ``before``, ``now``."""
    SURROUNDINGS = "surroundings"
    """The border of ``frames`` frames in a row had at most this ``agreement`` with the image, 0..1."""


class TableProblem(Issue):
    """A reason not to use an empty-table image, or to take a new one; ``code`` is a `TableProblemCode`."""

    @property
    def text(self) -> str:
        """The problem in words."""
        return problem_text(self.as_json())


_TEXTS: Mapping[str, str] = {
    TableProblemCode.CAMERA_MOVES: "the camera moves around the object, so every view has another background",
    TableProblemCode.MISSING: "there is no empty-table image yet",
    TableProblemCode.UNREADABLE: "the empty-table image is not usable: {detail}",
    TableProblemCode.OTHER_SIZE: "the empty-table image has {image_px[0]} x {image_px[1]} pixels, "
    "but the camera's frames have {frame_px[0]} x {frame_px[1]}",
    TableProblemCode.OTHER_CAMERA: "the empty-table image is from another camera: {image_camera}, not {camera}",
    TableProblemCode.FUTURE: "its date is in the future: check the computer's clock",
    TableProblemCode.SURROUNDINGS: "{frames} frames in a row agree with it over at most {agreement:.0%} of their "
    "border. The table or its surroundings have changed, the camera was moved, or the object reaches the border",
}


def problem_text(problem: Mapping[str, Any]) -> str:
    """Return a problem in words, from its JSON values."""
    match problem:
        case {"code": "old", "hours": hours}:
            return f"it is {hours:.0f} hours old" if hours < 48 else f"it is {hours / 24:.0f} days old"
        case {"code": "setting", "name": name, "before": before, "now": now}:
            return f"{name} was {_setting(before)}, is {_setting(now)}"
    try:
        return filled(_TEXTS[problem["code"]], **problem)
    except LookupError:  # a code or a parameter that this program does not have
        return str(problem["code"])


def _setting(value: float | bool) -> str:
    return ("on" if value else "off") if isinstance(value, bool) else f"{value:g}"
