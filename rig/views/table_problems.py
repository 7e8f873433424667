"""Problems of an empty-table image: codes with parameters, and their texts."""

from collections.abc import Mapping
from typing import Any, Final

from hbr.segmentation.background import Issue
from rig.core.phrases import Worded, filled


class TableProblemCode(Worded):
    """Problems of an empty-table image; the texts contain their parameters."""

    OTHER_MOTION = "other-motion", "table.carries was changed after the empty-table image was taken"
    MISSING = "missing", "there is no empty-table image yet"
    UNREADABLE = "unreadable", "the empty-table image is not usable: {detail}"
    OTHER_SIZE = (
        "other-size",
        "the empty-table image has {image_px[0]} x {image_px[1]} pixels, but the camera's frames have {frame_px[0]} x "
        "{frame_px[1]}",
    )
    OTHER_CAMERA = "other-camera", "the empty-table image is from another camera: {image_camera}, not {camera}"
    OLD = "old", "it is {hours:.0f} hours old"
    FUTURE = "future", "its date is in the future: check the computer's clock"
    SETTING = "setting", "{name} was {before}, is {now}"
    SURROUNDINGS = (
        "surroundings",
        "{frames} frames in a row agree with it over at most {agreement:.0%} of their border. The table or its "
        "surroundings have changed, the camera was moved, or the object reaches the border",
    )


class TableProblem(Issue):
    """A reason not to use an empty-table image, or to take a new one; ``code`` is a `TableProblemCode`."""

    @property
    def text(self) -> str:
        """The problem in words."""
        return problem_text(self.as_json())


IN_A_ROW: Final = 3
"""Number of successive frames that must differ from the empty-table image: one or two can show the operator's arm."""


def surroundings_problem(agreement: float) -> TableProblem:
    """Return the problem that `IN_A_ROW` frames agree with the image over at most this share of their border."""
    return TableProblem(TableProblemCode.SURROUNDINGS, {"frames": IN_A_ROW, "agreement": round(agreement, 3)})


def problem_text(problem: Mapping[str, Any]) -> str:
    """Return a problem in words, from its JSON values; its code if this program does not have it."""
    values = dict(problem)
    match values:
        case {"code": "old", "hours": hours} if hours >= 48:
            return f"it is {hours / 24:.0f} days old"
        case {"code": "setting", "before": before, "now": now}:
            values |= {"before": _setting(before), "now": _setting(now)}
    try:
        return filled(TableProblemCode(values["code"]).words, **values)
    except (LookupError, ValueError):
        return str(values["code"])


def _setting(value: float | bool) -> str:
    return ("on" if value else "off") if isinstance(value, bool) else f"{value:g}"
